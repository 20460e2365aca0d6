"""The same Gaussian with its axes in another order."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lod_cloud.lod_tree import Float32

Float64 = NDArray[np.float64]

_HALF = math.sqrt(0.5)
# by (axis of the largest scale, axis of the second): the rotation whose columns are those axes, up
# to their signs
_TURNS = np.zeros((3, 3, 4))
_TURNS[0, 1] = 1, 0, 0, 0
_TURNS[0, 2] = _HALF, _HALF, 0, 0
_TURNS[1, 0] = _HALF, 0, 0, _HALF
_TURNS[2, 1] = _HALF, 0, -_HALF, 0
_TURNS[1, 2] = 0.5, 0.5, 0.5, 0.5
_TURNS[2, 0] = 0.5, -0.5, -0.5, -0.5


def sorted_axes(scales: Float32, quaternions: Float32) -> tuple[Float64, Float64]:
    """[N, 3] scales, largest first, and [N, 4] rotations to match; exact but for float64."""
    order = np.argsort(-scales, axis=1, kind="stable")
    w, x, y, z = quaternions.astype(np.float64).T
    a, b, c, d = _TURNS[order[:, 0], order[:, 1]].T
    turned = np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=1,
    )
    return np.take_along_axis(scales, order, axis=1).astype(np.float64), turned
