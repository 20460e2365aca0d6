"""EWA projection as the textbooks write it: matrices, float64, one Gaussian at a time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.cameras import StereoRig
from gaussians.scene import Scene

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class TextbookSplat:
    """Centre in the eye's window, image covariance with dilation, depth."""

    centre: Float64  # [2] px
    covariance: Float64  # [2, 2] px^2
    depth: float


def project_one(scene: Scene, number: int, rig: StereoRig, eye: str) -> TextbookSplat:
    """J W Sigma W^T J^T + 0.3 of one Gaussian; the Jacobian at the clamped direction."""
    display = rig.display
    position = rig.left_position if eye == "left" else rig.right_position
    cx = display.cx_left if eye == "left" else display.cx_right
    world_to_camera = rig.pose.rotation.T
    x, y, z = world_to_camera @ (scene.means[number].astype(np.float64) - position)
    limit_x, limit_y = rig.jacobian_limits
    tx, ty = np.clip(x / z, -limit_x, limit_x), np.clip(y / z, -limit_y, limit_y)
    jacobian = np.diag([display.fx, display.fy]) @ np.array([[1, 0, -tx], [0, 1, -ty]]) / z
    axes = rotation_matrix(scene.quaternions[number]) @ np.diag(
        scene.scales[number].astype(np.float64)
    )
    to_image = jacobian @ world_to_camera @ axes
    centre = np.array([display.fx * x / z + cx, display.fy * y / z + display.cy])
    return TextbookSplat(centre, to_image @ to_image.T + 0.3 * np.eye(2), z)


def rotation_matrix(quaternion: NDArray[np.floating]) -> Float64:
    """Columns are the images of the axes: v -> q v q* by the cross-product formula."""
    w, *imaginary = quaternion.astype(np.float64)
    q = np.array(imaginary)
    columns = []
    for axis in np.eye(3):
        twice = 2 * np.cross(q, axis)
        columns.append(axis + w * twice + np.cross(q, twice))
    return np.stack(columns, axis=1)
