"""Quaternions, matrices, angles and level frames."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.cameras import look_at
from gaussians.errors import InputError
from gaussians.rotations import (
    UP_AXES,
    level_rotation,
    quaternions_from_rotations,
    rotations_from_angles,
    rotations_from_quaternions,
    slerp,
    up_vector,
)


@settings(deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_quaternion_and_matrix_are_inverse(values):
    quaternion = np.array([values]) / np.linalg.norm(values)
    matrix = rotations_from_quaternions(quaternion)
    assert np.abs(matrix[0] @ matrix[0].T - np.eye(3)).max() < 1e-14
    back = quaternions_from_rotations(matrix)
    assert abs(abs(float((back * quaternion).sum())) - 1) < 1e-14
    assert np.abs(rotations_from_quaternions(back) - matrix).max() < 1e-14


def test_rotation_signs():
    angle, zero = np.array([0.1]), np.zeros(1)
    forward, right = np.array([0, 0, 1.0]), np.array([1.0, 0, 0])
    assert (rotations_from_angles(angle, zero, zero)[0] @ forward)[0] > 0.09  # turns right
    assert (rotations_from_angles(zero, angle, zero)[0] @ forward)[
        1
    ] < -0.09  # looks up (y is down)
    assert (rotations_from_angles(zero, zero, angle)[0] @ right)[1] > 0.09  # right ear sinks
    quarter = rotations_from_quaternions(np.array([[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]]))[0]
    assert np.allclose(quarter @ [1, 0, 0], [0, 1, 0])


@pytest.mark.parametrize("up", UP_AXES)
def test_level_rotation_agrees_with_look_at(up):
    rotation = level_rotation(up)
    assert np.allclose(rotation[:, 1], -up_vector(up))
    pose = look_at(np.zeros(3), rotation[:, 2], up_vector(up))
    assert np.allclose(rotation, pose.rotation, atol=1e-15)
    assert abs(np.linalg.det(rotation) - 1) < 1e-15
    with pytest.raises(InputError, match="must not be parallel to the up axis"):
        level_rotation(up, up_vector(up))


def test_slerp_takes_the_shorter_arc_at_constant_speed():
    half = np.array([0.0, 0.2, 0.5, 0.9, 1.0]) * 0.35
    first, second = (
        np.tile([1.0, 0, 0, 0], (5, 1)),
        np.tile([np.cos(0.35), 0, np.sin(0.35), 0], (5, 1)),
    )
    for sign in (1, -1):
        result = slerp(first, sign * second, half / 0.35)
        assert np.allclose(np.abs(result[:, [0, 2]]), np.stack([np.cos(half), np.sin(half)], 1))
    assert np.array_equal(slerp(first, first, half), first)
