import math

import numpy as np
import pytest

from gaussians.cameras import DISPLAYS, Display, StereoRig, look_at
from gaussians.errors import InputError


def test_look_at_puts_up_at_the_top_and_the_target_ahead():
    pose = look_at(np.array([0.0, 0, 1.6]), np.array([10.0, 0, 1.6]), np.array([0.0, 0, 1]))
    right, down, forward = pose.rotation.T
    assert np.allclose(forward, [1, 0, 0]) and np.allclose(down, [0, 0, -1])
    assert np.allclose(right, [0, -1, 0])
    assert math.isclose(np.linalg.det(pose.rotation), 1.0)


def test_look_at_refuses_a_view_without_direction():
    zero, up = np.zeros(3), np.array([0.0, 0, 1])
    with pytest.raises(InputError, match="eye and look-at point must not coincide"):
        look_at(zero, zero, up)
    with pytest.raises(InputError, match="must not be parallel to the up axis"):
        look_at(zero, 3 * up, up)


def test_eyes_are_a_baseline_apart_along_camera_x():
    pose = look_at(np.array([1.0, 2, 3]), np.array([4.0, 9, 2]), np.array([0.0, 0, 1]))
    rig = StereoRig(DISPLAYS["quest3"], pose, baseline_m=0.064)
    assert np.allclose(rig.right_position - rig.left_position, 0.064 * pose.rotation[:, 0])
    assert np.allclose((rig.right_position + rig.left_position) / 2, pose.position)
    in_camera = rig.world_to_left[:, :3] @ rig.left_position + rig.world_to_left[:, 3]
    assert np.abs(in_camera).max() < 1e-6
    assert rig.world_to_left.dtype == np.float32


def test_display_presets_match_the_stated_focal_lengths():
    assert round(DISPLAYS["quest3"].fx) == 723
    assert DISPLAYS["prototype"].fx == 929.2
    assert math.isclose(math.degrees(2 * math.atan(1032 / 929.2)), 96.0, abs_tol=0.1)


def test_half_angles_give_mirrored_windows_sixteen_pixels_apart():
    display, rounding_deg = Display.from_half_angles(2064, 2208, 0.942, 0.698, 0.733, 0.942)
    assert display.window_offset_px % 16 == 0
    assert abs(display.window_offset_px - 500) < 16  # measured on a published Quest Pro frustum
    assert display.cx_left + display.cx_right == 2064
    assert 0 <= rounding_deg < math.degrees(8 / display.fx / 2) + 1e-9
    assert math.isclose(display.cy / display.fy, math.tan(0.733))


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((0, 8, 1.0, 1.0, 0.0, 0.0, 0.0), "display width must be an integer from 1"),
        ((8, 8, -1.0, 1.0, 0.0, 0.0, 0.0), "display fx must be a positive number"),
        ((8, 8, 1.0, 1.0, 8.0, 0.0, 0.0), "must be a multiple of 16 px, not 8"),
    ],
)
def test_display_refuses(arguments, message):
    with pytest.raises(InputError, match=message):
        Display(*arguments)


def test_rig_refuses_a_near_plane_of_zero_and_a_negative_baseline():
    pose = look_at(np.zeros(3), np.ones(3), np.array([0.0, 0, 1]))
    with pytest.raises(InputError, match="near plane must be a positive distance"):
        StereoRig(DISPLAYS["quest3"], pose, near_m=0.0)
    with pytest.raises(InputError, match="baseline must be >= 0 m, not -1"):
        StereoRig(DISPLAYS["quest3"], pose, baseline_m=-1)
