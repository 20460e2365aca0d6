"""Turned scenes look the same to a camera turned with them; crops keep what they say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.cameras import Display, Pose, StereoRig, look_at
from gaussians.constants import SH_C0, SH_C1, SH_C2, SH_C3
from gaussians.errors import InputError
from gaussians.placement import auto_view
from gaussians.render import render_mono
from gaussians.rotations import UP_AXES, rotations_from_quaternions, up_vector
from gaussians.scene import Scene, normalised_quaternions
from gaussians.transforms import (
    Box,
    crop,
    parse_box,
    sh_rotation,
    transformed,
    up_rotation,
    with_sh_degree,
)

SEEDS = st.integers(0, 2**32 - 1)


def random_scene(rng: np.random.Generator, count: int, degree: int) -> Scene:
    """Small blobs in a ball of radius 1, bright enough that no colour reaches 0."""
    sh = rng.uniform(-0.12, 0.12, (count, (degree + 1) ** 2, 3))
    sh[:, 0] = rng.uniform(2.0, 4.0, (count, 3))
    return Scene(
        means=(rng.normal(size=(count, 3)) * 0.4).astype(np.float32),
        quaternions=normalised_quaternions(rng.normal(size=(count, 4))),
        scales=np.exp(rng.uniform(-5, -2.5, (count, 3))).astype(np.float32),
        opacities=rng.uniform(0.05, 0.95, count).astype(np.float32),
        sh=sh.astype(np.float32),
    )


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    q = rng.normal(size=(1, 4))
    return rotations_from_quaternions(q / np.linalg.norm(q))[0]


def colour(sh: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """[N, 3] the formula of conventions.md, one direction, float64, before the maximum with 0."""
    x, y, z = direction
    terms = [SH_C0, -SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    terms += [SH_C2[0] * x * y, SH_C2[1] * y * z, SH_C2[2] * (2 * z * z - x * x - y * y)]
    terms += [SH_C2[3] * x * z, SH_C2[4] * (x * x - y * y), SH_C3[0] * y * (3 * x * x - y * y)]
    terms += [SH_C3[1] * x * y * z, SH_C3[2] * y * (4 * z * z - x * x - y * y)]
    terms += [SH_C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y)]
    terms += [SH_C3[4] * x * (4 * z * z - x * x - y * y), SH_C3[5] * z * (x * x - y * y)]
    terms += [SH_C3[6] * x * (x * x - 3 * y * y)]
    values = np.array([float(t) for t in terms[: sh.shape[1]]])
    return 0.5 + np.einsum("k,nkc->nc", values, sh.astype(np.float64))


# ---------------------------------------------------------------- rotation


@settings(max_examples=40)
@given(SEEDS)
def test_harmonic_matrices_are_a_representation(seed: int) -> None:
    """Orthogonal up to the float32 constants, products like the rotations, transposed inverse."""
    rng = np.random.default_rng(seed)
    first, second = random_rotation(rng), random_rotation(rng)
    joined = sh_rotation(first @ second, 3)
    for a, b, both in zip(sh_rotation(first, 3), sh_rotation(second, 3), joined, strict=True):
        assert np.abs(a @ b - both).max() < 1e-13
        assert np.abs(a @ a.T - np.eye(len(a))).max() < 1e-6
    for block in sh_rotation(np.eye(3), 3):
        assert np.abs(block - np.eye(len(block))).max() < 1e-14


@settings(max_examples=40)
@given(SEEDS, st.integers(0, 3))
def test_turned_colours_are_the_colours_seen_from_the_turned_direction(seed, degree) -> None:
    rng = np.random.default_rng(seed)
    scene, rotation = random_scene(rng, 20, degree), random_rotation(rng)
    turned = transformed(scene, rotation)
    for direction in rng.normal(size=(10, 3)):
        direction /= np.linalg.norm(direction)
        error = colour(turned.sh, rotation @ direction) - colour(scene.sh, direction)
        assert np.abs(error).max() < 1e-6


@settings(max_examples=20)
@given(SEEDS)
def test_covariances_turn(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene, rotation = random_scene(rng, 30, 0), random_rotation(rng)

    def covariances(s: Scene) -> np.ndarray:
        axes = rotations_from_quaternions(s.quaternions.astype(np.float64))
        axes = axes * s.scales.astype(np.float64)[:, None, :]
        return axes @ axes.transpose(0, 2, 1)

    turned = covariances(transformed(scene, rotation, scale=2.5, translation=(1.0, -2.0, 3.0)))
    expected = 2.5**2 * rotation @ covariances(scene) @ rotation.T
    assert np.abs(turned - expected).max() < 2e-6 * np.abs(expected).max()


PIXELS = 96 * 80
DEGREES = (slice(1, 4), slice(4, 9), slice(9, 16))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_scene_and_camera_turned_together_give_the_same_image(degree: int) -> None:
    """Of 7 680 pixels per rotation all agree within 2e-4, but at most two whose splats sit on a
    threshold (alpha of 1/255, end of a pixel).
    """
    rng = np.random.default_rng(degree)
    display = Display.from_fov(96, 80, 60.0)
    for _ in range(5):
        scene, rotation = random_scene(rng, 300, degree), random_rotation(rng)
        offset = rng.normal(size=3) * 0.5
        eye = rng.normal(size=3)
        pose = look_at(eye * 2.2 / np.linalg.norm(eye), np.zeros(3), np.array([0.3, -1.0, 0.2]))
        turned_pose = Pose(rotation @ pose.position + offset, rotation @ pose.rotation)
        turned_scene = transformed(scene, rotation, translation=tuple(offset))
        here, _ = render_mono(scene, StereoRig(display, pose, 0.0, 0.2))
        there, _ = render_mono(turned_scene, StereoRig(display, turned_pose, 0.0, 0.2))
        difference = np.abs(here - there).max(axis=2)
        assert here.max() > 0.5 and np.count_nonzero(here.max(axis=2)) > 0.3 * PIXELS
        assert np.count_nonzero(difference > 2e-4) <= 2
        assert difference.max() < 0.02
        if degree:  # the harmonics matter in this image
            flat, _ = render_mono(with_sh_degree(scene, 0), StereoRig(display, pose, 0.0, 0.2))
            assert np.abs(flat - here).max() > 0.02


@pytest.mark.parametrize("old", UP_AXES)
@pytest.mark.parametrize("new", UP_AXES)
def test_a_change_of_the_up_axis_is_exact_and_keeps_the_front(old: str, new: str) -> None:
    rotation = up_rotation(old, new)
    assert np.array_equal(np.abs(rotation).sum(axis=0), [1, 1, 1])  # a signed permutation
    assert np.array_equal(rotation @ up_vector(old), up_vector(new))
    for between in UP_AXES:
        assert np.array_equal(up_rotation(between, new) @ up_rotation(old, between), rotation)
    scene = random_scene(np.random.default_rng(1), 50, 3)
    turned = transformed(scene, rotation)
    back = transformed(turned, up_rotation(new, old))
    assert np.array_equal(back.means, scene.means)
    assert np.array_equal(turned.scales, scene.scales)
    assert np.abs(back.sh - scene.sh).max() < 2e-7
    assert np.abs(np.abs((back.quaternions * scene.quaternions).sum(axis=1)) - 1).max() < 3e-7
    eye, target = auto_view(scene, old)
    assert np.allclose(auto_view(turned, new), [rotation @ eye, rotation @ target], atol=1e-12)


def test_absent_harmonics_stay_absent() -> None:
    """An axis change takes -y and y z to one other coefficient each, and 0 to 0 exactly."""
    scene = random_scene(np.random.default_rng(2), 10, 3)
    scene.sh[:, 1:] = 0
    scene.sh[:, 1] = scene.sh[:, 5] = 1
    turned = transformed(scene, up_rotation("-y", "+x"))
    assert np.array_equal(turned.sh[:, 0], scene.sh[:, 0])
    assert [np.count_nonzero(turned.sh[0, part, 0]) for part in DEGREES] == [1, 1, 0]


@pytest.mark.parametrize(
    ("rotation", "message"),
    [
        (np.diag([1.0, 1.0, -1.0]), "right-handed: off by 0, determinant -1"),
        (1.001 * np.eye(3), "must be orthonormal"),
        (np.full((3, 3), np.nan), "finite 3 x 3"),
        (np.eye(4), r"of shape \(4, 4\)"),
    ],
)
def test_what_is_no_rotation_is_refused(rotation, message) -> None:
    scene = random_scene(np.random.default_rng(0), 2, 1)
    with pytest.raises(InputError, match=message):
        transformed(scene, rotation)
    with pytest.raises(InputError, match=message):
        sh_rotation(rotation, 1)


def test_scale_and_translation_are_checked() -> None:
    scene = random_scene(np.random.default_rng(0), 2, 0)
    for scale in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="scale must be a positive number"):
            transformed(scene, np.eye(3), scale=scale)
    with pytest.raises(InputError, match="translation must be three finite numbers"):
        transformed(scene, np.eye(3), translation=(0.0, np.inf, 0.0))
    with pytest.raises(InputError, match="transformed scene: means must be finite"):
        transformed(scene, np.eye(3), scale=1e39)


# ---------------------------------------------------------------- crop, degree


def test_a_box_holds_its_faces() -> None:
    box = parse_box("-1,0,0.5:1,0,2")
    points = np.array([[-1, 0, 0.5], [1, 0, 2], [0, 0, 2.0001], [0, 1e-6, 1], [0, 0, 1]])
    assert box.ids(points.astype(np.float32)).tolist() == [0, 1, 4]


def test_a_crop_keeps_order_and_bits() -> None:
    scene = random_scene(np.random.default_rng(3), 200, 2)
    kept = crop(scene, Box((-0.4, -9.0, -9.0), (9.0, 0.2, 9.0)))
    ids = [i for i, (x, y, _) in enumerate(scene.means) if x >= -0.4 and y <= 0.2]
    assert 20 < len(ids) < 180
    for field in vars(scene):
        assert np.array_equal(getattr(kept, field), getattr(scene, field)[ids])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,2,3", "must be X0,Y0,Z0:X1,Y1,Z1, not '1,2,3'"),
        ("0,0,0:1,1", "must be X0,Y0,Z0:X1,Y1,Z1"),
        ("0,0,0:1,1,1:2,2,2", "must be X0,Y0,Z0:X1,Y1,Z1"),
        ("0,0,a:1,1,1", "must be X0,Y0,Z0:X1,Y1,Z1"),
        ("0,0,nan:1,1,1", "finite numbers"),
        ("0,0,0:1,-1,1", r"no coordinate of \(0.0, 0.0, 0.0\) may exceed"),
    ],
)
def test_a_bad_box_is_refused(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_box(text)


def test_harmonics_are_dropped_from_above() -> None:
    scene = random_scene(np.random.default_rng(4), 5, 3)
    for degree in range(4):
        assert np.array_equal(with_sh_degree(scene, degree).sh, scene.sh[:, : (degree + 1) ** 2])
        assert with_sh_degree(scene, degree).sh_degree == degree
    with pytest.raises(InputError, match=r"SH degree must lie in 0\.\.1 of the scene, not 2"):
        with_sh_degree(with_sh_degree(scene, 1), 2)
