"""Displays, poses and the rectified stereo rig (axes and signs: conventions.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.constants import FRUSTUM_CLAMP
from gaussians.errors import InputError

Float64 = NDArray[np.float64]

WINDOW_STEP_PX = 16  # window offsets are rounded to this, so that tiles of both eyes line up


@dataclass(frozen=True)
class Display:
    """Pixels and focal lengths of one eye; both eyes look through one image plane.

    ``cx_left`` and ``cx_right`` are the principal points in the two windows; they differ by a
    multiple of 16 px on off-axis headsets and are equal otherwise.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx_left: float
    cx_right: float
    cy: float

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if not isinstance(value, int) or not 1 <= value <= 16384:
                raise InputError(
                    f"display {name} must be an integer from 1 to 16384 px, not {value}"
                )
        for name in ("fx", "fy"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"display {name} must be a positive number of pixels, not {value}")
        if self.window_offset_px % WINDOW_STEP_PX:
            raise InputError(
                f"display cx_left - cx_right must be a multiple of {WINDOW_STEP_PX} px, "
                f"not {self.window_offset_px}"
            )

    @property
    def window_offset_px(self) -> float:
        """Right-window column + this = left-window column of the same ray direction."""
        return self.cx_left - self.cx_right

    @classmethod
    def from_fov(cls, width: int, height: int, fov_deg: float) -> Display:
        """On-axis display with square pixels and this horizontal field of view in degrees."""
        if not 1 <= fov_deg <= 170:
            raise InputError(f"field of view must lie in 1..170 degrees, not {fov_deg}")
        focal = 0.5 * width / math.tan(math.radians(fov_deg) / 2)
        return cls(width, height, focal, focal, 0.5 * width, 0.5 * width, 0.5 * height)

    @classmethod
    def from_half_angles(
        cls, width: int, height: int, outer: float, inner: float, up: float, down: float
    ) -> tuple[Display, float]:
        """Off-axis display from positive half-angles in radians; also the rounding in degrees.

        ``outer`` is the temporal and ``inner`` the nasal half-angle of both (mirrored) eyes. The
        window offset is rounded to 16 px; the second value is the angle by which that turns it.
        """
        for name, angle in (("outer", outer), ("inner", inner), ("up", up), ("down", down)):
            if not 0.01 <= angle <= 1.5:
                raise InputError(f"half-angle {name} must lie in 0.01..1.5 rad, not {angle}")
        fx = width / (math.tan(outer) + math.tan(inner))
        fy = height / (math.tan(up) + math.tan(down))
        exact = fx * (math.tan(outer) - math.tan(inner))
        offset = WINDOW_STEP_PX * round(exact / WINDOW_STEP_PX)
        cx_left = 0.5 * (width + offset)
        rounding = math.degrees(abs(offset - exact) / 2 / fx)
        return cls(width, height, fx, fy, cx_left, width - cx_left, fy * math.tan(up)), rounding


DISPLAYS = {
    # 2064 x 2208 per eye (paper Sec. 6); "prototype" is the focal length of the measured facts
    "prototype": Display(2064, 2208, 929.2, 929.2, 1032.0, 1032.0, 1104.0),
    "quest3": Display.from_fov(2064, 2208, 110.0),
}


@dataclass(frozen=True)
class Pose:
    """Head pose: the point midway between the eyes and the orientation of both cameras."""

    position: Float64  # [3] metres, world
    rotation: Float64  # [3, 3] camera-to-world; columns are the camera's right, down, forward axes


def look_at(eye: Float64, target: Float64, up: Float64) -> Pose:
    """Pose at ``eye`` looking at ``target`` with ``up`` (world) pointing up in the image.

    Raises InputError when eye and target coincide or the view runs along ``up``.
    """
    eye, target, up = (np.asarray(v, np.float64) for v in (eye, target, up))
    forward = target - eye
    if not np.linalg.norm(forward) > 0:
        raise InputError("view: eye and look-at point must not coincide")
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6 * np.linalg.norm(up):
        raise InputError("view: the direction of view must not be parallel to the up axis")
    right = right / np.linalg.norm(right)
    return Pose(eye, np.stack([right, np.cross(forward, right), forward], axis=1))


@dataclass(frozen=True)
class StereoRig:
    """Two parallel cameras of one display, ``baseline_m`` apart along the camera x axis.

    The left eye is at ``pose.position - baseline/2 * right``. Both eyes share y and z; the right
    eye's camera coordinate is fl(x_left - baseline).
    """

    display: Display
    pose: Pose
    baseline_m: float = 0.06
    near_m: float = 0.2

    def __post_init__(self) -> None:
        if not (math.isfinite(self.near_m) and self.near_m > 0):
            raise InputError(f"near plane must be a positive distance in metres, not {self.near_m}")
        if not (math.isfinite(self.baseline_m) and self.baseline_m >= 0):
            raise InputError(f"baseline must be >= 0 m, not {self.baseline_m}")

    @property
    def left_position(self) -> Float64:
        """[3] left eye, world metres, float64."""
        return self.pose.position - 0.5 * self.baseline_m * self.pose.rotation[:, 0]

    @property
    def right_position(self) -> Float64:
        """[3] right eye, world metres, float64."""
        return self.pose.position + 0.5 * self.baseline_m * self.pose.rotation[:, 0]

    @property
    def world_to_left(self) -> NDArray[np.float32]:
        """[3, 4] rotation | translation of the left camera, computed in float64, rounded once."""
        rotation = self.pose.rotation.T
        translation = -rotation @ self.left_position
        return np.column_stack([rotation, translation]).astype(np.float32)

    @property
    def jacobian_limits(self) -> tuple[float, float]:
        """|x/z| and |y/z| in the Jacobian are clamped to these, 1.3 tan(half field of view).

        One pair for both eyes: the wider side of the wider window.
        """
        d = self.display
        half_width = max(d.cx_left, d.width - d.cx_left, d.cx_right, d.width - d.cx_right)
        half_height = max(d.cy, d.height - d.cy)
        return FRUSTUM_CLAMP * half_width / d.fx, FRUSTUM_CLAMP * half_height / d.fy
