"""Placement, views, and traces anchored in a scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from gaussians.cameras import Pose, look_at
from gaussians.errors import InputError
from gaussians.placement import Placement, anchor, auto_view, parse_view
from gaussians.poses import HeadTrace, generate_trace
from gaussians.rotations import UP_AXES, level_rotation, rotations_from_angles, up_vector
from gaussians.scene import Scene

VIEW = ((1.5, -1.0, 1.5), (0.0, -0.3, 0.0))


def scene_at(means: np.ndarray, scale: float = 0.0) -> Scene:
    count = len(means)
    return Scene(
        means.astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full((count, 3), scale, np.float32),
        np.ones(count, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )


def trace_of(positions: np.ndarray, rotations: np.ndarray, up: str) -> HeadTrace:
    times = np.arange(len(positions)) / 90.0
    return HeadTrace("t", times, np.asarray(positions, float), rotations, up=up)


# views


def test_parse_view():
    assert parse_view("1.5,-1,1.5:0,-.3,0") == VIEW
    for text in ("", "1,2,3", "1,2:3,4", "1,2,3:4,5", "1,2,3:4,5,6:7,8,9", "a,b,c:1,2,3"):
        with pytest.raises(InputError, match="view must be EX,EY,EZ:LX,LY,LZ"):
            parse_view(text)
    with pytest.raises(InputError, match="finite"):
        parse_view("1,2,inf:0,0,0")
    with pytest.raises(InputError, match="must not coincide"):
        parse_view("1,2,3:1,2,3")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"up": "up"}, "up axis must be one of"),
        ({"units_per_metre": 0.0}, "units_per_metre must be a positive number, not 0"),
        ({"near_m": float("nan")}, "near_m must be a positive number, not nan"),
        ({"view": ((0.0, 0.0, np.inf), (0.0, 0.0, 0.0))}, "two finite points"),
        ({"view": ((0.0, 0.0, 0.0), (0.0, 2.0, 0.0))}, "must not be parallel to the up axis"),
        ({"view": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))}, "must not coincide"),
    ],
)
def test_impossible_placements_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        replace(Placement(up="-y"), **changes)


def test_view_pose_is_in_metres():
    scene = scene_at(np.zeros((1, 3)))
    pose = Placement("-y", units_per_metre=4.0, view=VIEW).view_pose(scene)
    assert np.allclose(pose.position, np.array(VIEW[0]) / 4)
    expected = look_at(np.array(VIEW[0]), np.array(VIEW[1]), np.array([0, -1.0, 0]))
    assert np.allclose(pose.rotation, expected.rotation, atol=1e-15)


@pytest.mark.parametrize("up", UP_AXES)
@settings(deadline=None)
@given(seed=st.integers(0, 10_000), flatness=st.sampled_from([0.0, 1e-3, 1.0, 30.0]))
def test_auto_view_frames_the_bulk_with_a_level_horizon(up, seed, flatness):
    rng = np.random.default_rng(seed)
    extents = rng.permutation([1.0, 2.0, flatness])
    means = rng.uniform(-1, 1, (300, 3)) * extents + rng.normal(size=3) * 10
    means[0] = 1e6  # an outlier
    scene = scene_at(means, scale=0.01)
    eye, target = (np.array(point) for point in auto_view(scene, up))
    pose = look_at(eye, target, up_vector(up))
    assert abs(pose.rotation[:, 0] @ up_vector(up)) < 1e-12  # level
    assert pose.rotation[:, 2] @ up_vector(up) == pytest.approx(-np.sin(np.radians(20)))
    inside = scene.means.astype(float)
    low, high = np.percentile(inside, [1, 99], axis=0)
    inside = inside[((inside >= low) & (inside <= high)).all(axis=1)]
    camera = (inside - eye) @ pose.rotation
    tangents = np.abs(camera[:, :2]) / camera[:, 2:]
    assert (camera[:, 2] > 0).all()
    assert tangents.max() <= 0.8
    assert np.linalg.norm(eye - inside.mean(axis=0)) < 5 * np.ptp(inside, axis=0).max()


def test_auto_view_of_one_splat_and_of_nothing():
    eye, target = auto_view(scene_at(np.ones((1, 3)), scale=0.1), "+z")
    assert target == (1, 1, 1)
    assert 0.3 < np.linalg.norm(np.subtract(eye, target)) < 2
    with pytest.raises(InputError, match="no extent to frame"):
        auto_view(scene_at(np.ones((1, 3))), "+z")
    with pytest.raises(InputError, match="empty scene"):
        auto_view(scene_at(np.ones((0, 3))), "+z")


# anchoring

angles = st.floats(-3, 3)
tilts = st.floats(-1.4, 1.4)
ups = st.sampled_from(UP_AXES)


@settings(deadline=None)
@given(ups, ups, angles, tilts, angles, angles, tilts)
def test_first_pose_is_the_view(trace_up, scene_up, yaw, pitch, roll, view_yaw, view_pitch):
    count = 5
    rng = np.random.default_rng(0)
    turns = rotations_from_angles(
        yaw + rng.normal(size=count), np.full(count, pitch), roll + rng.normal(size=count)
    )
    trace = trace_of(rng.normal(size=(count, 3)), level_rotation(trace_up) @ turns, trace_up)
    view = placed(scene_up, view_yaw, view_pitch)
    anchored = anchor(trace, view, scene_up)
    assert np.abs(anchored.positions[0] - view.position).max() <= 1e-12
    assert np.abs(anchored.rotations[0] - view.rotation).max() <= 1e-12
    steps, new_steps = np.diff(trace.positions, axis=0), np.diff(anchored.positions, axis=0)
    assert np.allclose(np.linalg.norm(new_steps, axis=1), np.linalg.norm(steps, axis=1))
    for old, new in zip(trace.rotations, anchored.rotations, strict=True):
        turn, new_turn = old @ trace.rotations[0].T, new @ anchored.rotations[0].T
        assert np.trace(new_turn) == pytest.approx(np.trace(turn))
    assert anchored.up == scene_up


def placed(up: str, yaw: float, pitch: float) -> Pose:
    """A view at (1, 2, 3), turned from the standard front by yaw and pitch."""
    one = np.ones(1)
    rotation = level_rotation(up) @ rotations_from_angles(yaw * one, pitch * one, 0 * one)[0]
    return look_at(np.array([1.0, 2, 3]), np.array([1.0, 2, 3]) + rotation[:, 2], up_vector(up))


@settings(deadline=None)
@given(ups, ups, angles, tilts, angles, tilts)
def test_vertical_motion_stays_vertical_and_forward_stays_forward(
    trace_up, scene_up, yaw, pitch, view_yaw, view_pitch
):
    one = np.ones(3)
    rotations = level_rotation(trace_up) @ rotations_from_angles(yaw * one, pitch * one, 0 * one)
    ahead = level_rotation(trace_up, rotations[0, :, 2])[:, 2]
    positions = np.stack([0 * ahead, 0.3 * up_vector(trace_up), 2.0 * ahead]) + 5.0
    view = placed(scene_up, view_yaw, view_pitch)
    anchored = anchor(trace_of(positions, rotations, trace_up), view, scene_up)
    moved = anchored.positions - view.position
    assert np.abs(moved[1] - 0.3 * up_vector(scene_up)).max() < 1e-12
    view_ahead = level_rotation(scene_up, view.rotation[:, 2])[:, 2]
    assert np.abs(moved[2] - 2.0 * view_ahead).max() < 1e-12


@settings(deadline=None)
@given(ups, ups, tilts, tilts, angles, st.floats(-0.7, 0.7))
def test_yaw_turns_about_the_vertical_and_pitch_adds_up(
    trace_up, scene_up, pitch, view_pitch, turn, nod
):
    assume(abs(view_pitch + nod) < 1.5)
    yaw = np.array([0.4, 0.4 + turn])
    rotations = level_rotation(trace_up) @ rotations_from_angles(
        yaw, np.array([pitch, pitch + nod]), np.zeros(2)
    )
    view = placed(scene_up, 1.0, view_pitch)
    anchored = anchor(trace_of(np.zeros((2, 3)), rotations, trace_up), view, scene_up)
    expected = placed(scene_up, 1.0 + turn, view_pitch + nod).rotation
    assert np.abs(anchored.rotations[1] - expected).max() < 1e-9  # and the horizon stays level


def test_a_generated_walk_can_be_anchored():
    trace = generate_trace("walk", 90, np.random.default_rng(1))
    view = Placement("-y", view=VIEW).view_pose(scene_at(np.zeros((1, 3))))
    anchored = anchor(trace, view, "-y")
    assert len(anchored) == 90
    assert np.abs(anchored.positions[:, 1] - view.position[1]).max() < 0.05  # bob only


def test_looking_straight_down_cannot_be_anchored():
    down = np.stack([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], axis=1)
    trace = trace_of(np.zeros((1, 3)), down[None], "+y")
    with pytest.raises(InputError, match="must not be parallel to the up axis"):
        anchor(trace, placed("+y", 0.0, 0.0), "+y")
