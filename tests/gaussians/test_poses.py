"""Head traces: generated and resampled."""

from __future__ import annotations

import numpy as np
import pytest

from gaussians.errors import InputError
from gaussians.poses import HeadTrace, generate_trace, resample
from gaussians.rotations import UP_AXES, level_rotation, rotations_from_angles

KINDS = ("stand", "walk", "flight", "teleport")


def generate(kind: str, frames: int, up: str = "+y", seed: int = 5) -> HeadTrace:
    return generate_trace(kind, frames, np.random.default_rng(seed), up)


def local_offsets(trace: HeadTrace) -> np.ndarray:
    """[F, 3] metres along the start's right, down, forward."""
    return trace.positions @ level_rotation(trace.up)


# generated traces


@pytest.mark.parametrize("up", UP_AXES)
@pytest.mark.parametrize("kind", KINDS)
def test_generated_trace_starts_level_at_the_origin(kind, up):
    trace = generate(kind, 200, up)
    assert len(trace) == 200
    assert trace.up == up
    assert not trace.positions[0].any()
    assert np.abs(trace.rotations[0] - level_rotation(up)).max() < 1e-15
    assert np.allclose(np.diff(trace.times_s), 1 / 90)
    assert np.abs(trace.rotations - trace.rotations[0]).max() > 0.01  # the head turns
    assert np.array_equal(trace.positions, generate(kind, 200, up).positions)
    assert not np.array_equal(trace.positions, generate(kind, 200, up, seed=6).positions)


@pytest.mark.parametrize("kind", ["stand", "walk", "flight"])
def test_a_longer_trace_continues_a_shorter_one(kind):
    short, long = generate(kind, 50), generate(kind, 900)
    assert np.allclose(long.positions[:50], short.positions, atol=1e-12)
    assert np.allclose(long.rotations[:50], short.rotations, atol=1e-12)


def test_stand_stays_within_centimetres():
    offsets = local_offsets(generate("stand", 2700))
    assert 0.005 < np.abs(offsets[:, [0, 2]]).max() < 0.016 + 1e-9
    assert np.abs(offsets[:, 1]).max() < 0.004 + 1e-9


@pytest.mark.parametrize(("kind", "speed", "height"), [("walk", 1.4, 0.04), ("flight", 30.0, 20.0)])
def test_speed_and_height(kind, speed, height):
    trace = generate(kind, 5401)  # one minute
    offsets = local_offsets(trace)
    ground = np.linalg.norm(np.diff(offsets[::90, [0, 2]], axis=0), axis=1)
    assert abs(ground.mean() / speed - 1) < 0.01
    assert abs(np.ptp(offsets[:, 1]) / height - 1) < 0.02
    forward = (trace.rotations[:-1, :, 2] * np.diff(trace.positions, axis=0)).sum(axis=1)
    assert (forward > 0).all()  # looks, by and large, where it goes
    if kind == "flight":
        assert offsets[:, 1].max() <= 0  # never below the start


@pytest.mark.parametrize(
    ("frames", "expected"), [(1, []), (2, [1]), (12, [6]), (450, [225]), (1000, [450, 900])]
)
def test_teleport_jumps(frames, expected):
    steps = np.linalg.norm(np.diff(generate("teleport", frames).positions, axis=0), axis=1)
    jumps = np.flatnonzero(steps > 1)
    assert (jumps + 1).tolist() == expected
    assert ((steps[jumps] > 149) & (steps[jumps] < 251)).all()


def test_unknown_kinds_and_counts_are_refused():
    with pytest.raises(InputError, match="one of stand, walk, flight, teleport, not 'swim'"):
        generate("swim", 10)
    with pytest.raises(InputError, match="frames must be at least 1, not 0"):
        generate("walk", 0)
    with pytest.raises(InputError, match="up axis must be one of"):
        generate("walk", 1, "z")


# the container


def still(frames: int, **changes: object) -> HeadTrace:
    fields: dict[str, object] = {
        "times_s": np.arange(frames) / 10.0,
        "positions": np.zeros((frames, 3)),
        "rotations": np.tile(np.eye(3), (frames, 1, 1)),
        **changes,
    }
    return HeadTrace("t", **fields)  # type: ignore[arg-type] # heterogeneous on purpose


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"times_s": np.zeros(0)}, "at least one pose"),
        ({"times_s": np.array([0, 1, 1.0])}, "times must increase; frame 2 does not"),
        ({"times_s": np.array([0, np.nan, 1.0])}, "times_s must be finite"),
        ({"positions": np.zeros((3, 2))}, r"positions must be float64 of shape \(3, 3\)"),
        ({"positions": np.zeros((3, 3), np.float32)}, "not float32"),
        ({"rotations": np.zeros((3, 3, 3))}, "orthonormal"),
        ({"rotations": np.tile(np.diag([1.0, 1, -1]), (3, 1, 1))}, "right-handed"),
        ({"up": "y"}, "up axis must be one of"),
    ],
)
def test_impossible_traces_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        still(3, **changes)


def test_pose_by_frame():
    trace = still(3, positions=np.arange(9.0).reshape(3, 3))
    assert trace.pose(2).position.tolist() == [6, 7, 8]
    for frame in (-1, 3):
        with pytest.raises(InputError, match=rf"frame must lie in 0\.\.2, not {frame}"):
            trace.pose(frame)


# resampling


def test_resampling_interpolates_between_samples():
    yaw = np.array([0.0, 0.2, 0.2, -0.4])
    zero = np.zeros(4)
    trace = still(
        4,
        times_s=np.array([7.0, 7.1, 7.3, 7.4]),
        positions=np.array([[0.0, 0, 0], [1, 0, 0], [1, 2, 0], [1, 2, 3]]),
        rotations=rotations_from_angles(yaw, zero, zero),
        half_angles=(0.9, 0.7, 0.7, 0.9),
        up="-z",
    )
    result = resample(trace, 20.0, 9)
    assert np.allclose(result.times_s, np.arange(9) / 20)
    times = np.array([0, 0.1, 0.3, 0.4])
    for axis in range(3):
        expected = np.interp(result.times_s, times, trace.positions[:, axis])
        assert np.allclose(result.positions[:, axis], expected, atol=1e-12)
    angle = np.arctan2(result.rotations[:, 0, 2], result.rotations[:, 2, 2])
    assert np.allclose(angle, np.interp(result.times_s, times, yaw), atol=1e-12)
    assert (result.name, result.up, result.half_angles) == ("t", "-z", (0.9, 0.7, 0.7, 0.9))
    with pytest.raises(InputError, match=r"lasts 0\.400 s, which gives at most 9 frames at 20 Hz"):
        resample(trace, 20.0, 10)


def test_resampling_at_its_own_rate_keeps_the_trace():
    trace = generate("walk", 40)
    result = resample(trace, 90.0, 40)
    assert np.allclose(result.positions, trace.positions, atol=1e-13)
    assert np.abs(result.rotations - trace.rotations).max() < 1e-14
    assert len(resample(generate("walk", 1), 72.0, 1)) == 1
    for rate in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match="rate must be a positive number of Hz"):
            resample(trace, rate, 1)
    with pytest.raises(InputError, match="frames must be at least 1"):
        resample(trace, 90.0, 0)
