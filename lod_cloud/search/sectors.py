"""Directions in sectors, and how far a path can have led into each of them.

The unit sphere is cut into cells of a cube map; cell j lies in the cap of half angle ``alpha_j``
about its axis. For a step D of the camera and any unit vector w of the cap

    w . D <= |D| cos(max(0, angle(axis_j, D) - alpha_j)),

the support function of the cap, so a running sum of the right side bounds how far the camera has
come in any direction of the sector. Rounding is paid for by widening the caps and rounding up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

SIDE = 6  # cells along an edge of a cube face
SECTORS = 6 * SIDE * SIDE
_WIDENED = 4e-6  # radians; what is lost when a direction is computed and assigned
_BEND = 0.2732  # makes cells of a face more alike
_BEND_32, _RISE_32 = np.float32(_BEND), np.float32(1 + _BEND)
_SIDE_32, _HALF_SIDE, _LAST = np.float32(SIDE), np.float32(SIDE / 2), np.float32(SIDE - 1)
_ZERO, _ONE, _TWO, _FOUR = np.float32(0), np.float32(1), np.float32(2), np.float32(4)
_LEAST = np.float32(1e-30)


class SectorTable(NamedTuple):
    """Axis and cap of every sector."""

    axes: Float64  # [SECTORS, 3]
    cosines: Float64  # [SECTORS] of alpha
    sines: Float64  # [SECTORS]


def sector_table() -> SectorTable:
    """Axes and caps of all sectors. Cells are spherical polygons: their corners are farthest."""
    edges = _unbent(np.linspace(-1.0, 1.0, SIDE + 1))
    middles = _unbent((np.arange(SIDE) + 0.5) * 2 / SIDE - 1)
    axes = np.empty((6, SIDE, SIDE, 3))
    alphas = np.zeros((6, SIDE, SIDE))
    for face in range(6):
        axes[face] = _directions(face, *np.meshgrid(middles, middles, indexing="ij"))
        for i in (slice(None, -1), slice(1, None)):
            for j in (slice(None, -1), slice(1, None)):
                corners = _directions(face, *np.meshgrid(edges[i], edges[j], indexing="ij"))
                cosines = np.clip((corners * axes[face]).sum(axis=-1), -1, 1)
                alphas[face] = np.maximum(alphas[face], np.arccos(cosines))
    alphas = alphas.reshape(-1) + _WIDENED
    return SectorTable(axes.reshape(-1, 3), np.cos(alphas), np.sin(alphas))


def _unbent(values: Float64) -> Float64:
    """Inverse of ``x (1 + b - b |x|)`` on -1..1."""
    rise = 1 + _BEND
    return (
        np.sign(values) * (rise - np.sqrt(rise * rise - 4 * _BEND * np.abs(values))) / (2 * _BEND)
    )


def _directions(face: int, first: Float64, second: Float64) -> Float64:
    axis, sign = face >> 1, 1.0 - 2.0 * (face & 1)
    out = np.empty((*first.shape, 3))
    out[..., axis] = sign
    out[..., (axis + 1) % 3] = first
    out[..., (axis + 2) % 3] = second
    return out / np.linalg.norm(out, axis=-1, keepdims=True)


@njit(forceinline=True)
def _cell(value):  # type: ignore[no-untyped-def]
    bent = value * (_RISE_32 - _BEND_32 * abs(value))
    return min(_LAST, max(_ZERO, np.floor((bent + _ONE) * _HALF_SIDE)))


@njit(forceinline=True)
def sector_of(x, y, z):  # type: ignore[no-untyped-def]
    """Sector of a direction of any length, in float32; any sector for length 0.

    Without branches, so that it can be computed for many directions at once.
    """
    ax, ay, az = abs(x), abs(y), abs(z)
    is_x = (ax >= ay) & (ax >= az)
    is_y = ay >= az
    along = x if is_x else (y if is_y else z)
    first = y if is_x else (z if is_y else x)
    second = z if is_x else (x if is_y else y)
    face = _ZERO if is_x else (_TWO if is_y else _FOUR)
    face += _ONE if along < _ZERO else _ZERO
    inverse = _ONE / max(abs(along), _LEAST)
    return np.int32((face * _SIDE_32 + _cell(first * inverse)) * _SIDE_32 + _cell(second * inverse))


@njit
def reach(axis_cosine, cosine, sine):  # type: ignore[no-untyped-def]
    """Support function of a cap: from the cosine between its axis and a unit vector."""
    beside = axis_cosine * cosine + np.sqrt(max(0.0, 1.0 - axis_cosine * axis_cosine)) * sine
    return 1.0 if axis_cosine >= cosine else beside
