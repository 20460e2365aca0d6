"""Fills the interior nodes of a tree: merged Gaussians and node spheres, bottom up.

Children i with opacity o_i, means m_i, covariances C_i, surfaces S = s0 s1 + s0 s2 + s1 s2:

    w_i = o_i S_i            W = sum w_i
    m   = sum w_i m_i / W    C = sum w_i (C_i + (m_i - m)(m_i - m)^T) / W
    SH  = sum w_i SH_i / W   o = W / S(C)                               (may exceed 1; kept)

Where W = 0 (transparent children, or points and lines, which have no surface) all children weigh
the same and o is the mean of their opacities; where only S(C) = 0, o is their weighted mean.
Everything is float64, from the children's float32 values, rounded once per stored number; a merge
depends on nothing but the children, so the order in which nodes of a level are computed cannot
matter.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.parallel import run_chunks
from gaussians.scene import Scene
from lod_cloud.lod_tree import Int32

_SWEEPS = 8  # cyclic Jacobi on 3 x 3 converges in 4 to 6
_NEGLIGIBLE = 1e-36  # squared ratio of an off-diagonal entry to its diagonal ones


def merge_nodes(
    gaussians: Scene,
    first_child: Int32,
    child_count: Int32,
    level_offsets: Int32,
    radius: NDArray[np.float32],
    extent: NDArray[np.float32],
    margin: float,
) -> None:
    """Write the interior rows of ``gaussians`` and all of ``radius`` and ``extent``, in place.

    ``margin`` is the factor by which a node's R and e exceed its children's.
    """
    harmonics = gaussians.sh.reshape(len(gaussians), -1)
    for level in range(len(level_offsets) - 2, -1, -1):
        run_chunks(
            _merge_range,
            int(level_offsets[level + 1] - level_offsets[level]),
            int(level_offsets[level]),
            first_child,
            child_count,
            gaussians.means,
            gaussians.quaternions,
            gaussians.scales,
            gaussians.opacities,
            harmonics,
            radius,
            extent,
            margin,
        )


@njit(cache=True, error_model="numpy", nogil=True)
def _merge_range(  # type: ignore[no-untyped-def]
    begin, end, offset, first_child, child_count, means, quaternions, scales, opacities, sh,
    radius, extent, margin,
):  # fmt: skip
    c = np.empty(6, np.float64)
    colour = np.empty(sh.shape[1], np.float64)
    for node in range(offset + begin, offset + end):
        first, number = first_child[node], child_count[node]
        if number:
            _merge_children(
                node, first, number, means, quaternions, scales, opacities, sh, c, colour
            )
        _covariance(quaternions, scales, node, c)
        half = 3.0 * math.sqrt(c[0] + c[3] + c[5])
        side = 6.0 * math.sqrt(max(c[0], c[3], c[5]))
        for child in range(first, first + number):
            gap = 0.0
            for axis in range(3):
                d = np.float64(means[child, axis]) - np.float64(means[node, axis])
                gap += d * d
            half = max(half, (np.float64(radius[child]) + math.sqrt(gap)) * margin)
            side = max(side, np.float64(extent[child]) * margin)
        radius[node] = _rounded_up(half)
        extent[node] = _rounded_up(side)


@njit
def _rounded_up(value):  # type: ignore[no-untyped-def]
    """Smallest float32 >= value, for finite value >= 0."""
    nearest = np.float32(value)
    if np.float64(nearest) < value:
        return np.int32(nearest.view(np.int32) + np.int32(1)).view(np.float32)
    return nearest


@njit
def _surface(scales, node):  # type: ignore[no-untyped-def]
    a, b, c = np.float64(scales[node, 0]), np.float64(scales[node, 1]), np.float64(scales[node, 2])
    return a * b + a * c + b * c


@njit
def _covariance(quaternions, scales, node, c):  # type: ignore[no-untyped-def]
    """c = xx, xy, xz, yy, yz, zz of the node's covariance; the quaternion is normalised."""
    w, x = np.float64(quaternions[node, 0]), np.float64(quaternions[node, 1])
    y, z = np.float64(quaternions[node, 2]), np.float64(quaternions[node, 3])
    t = 2.0 / (w * w + x * x + y * y + z * z)
    s0 = np.float64(scales[node, 0])
    s1 = np.float64(scales[node, 1])
    s2 = np.float64(scales[node, 2])
    m00, m10, m20 = (
        (1 - t * (y * y + z * z)) * s0,
        t * (x * y + w * z) * s0,
        t * (x * z - w * y) * s0,
    )
    m01, m11, m21 = (
        t * (x * y - w * z) * s1,
        (1 - t * (x * x + z * z)) * s1,
        t * (y * z + w * x) * s1,
    )
    m02, m12, m22 = (
        t * (x * z + w * y) * s2,
        t * (y * z - w * x) * s2,
        (1 - t * (x * x + y * y)) * s2,
    )
    c[0] = m00 * m00 + m01 * m01 + m02 * m02
    c[1] = m00 * m10 + m01 * m11 + m02 * m12
    c[2] = m00 * m20 + m01 * m21 + m02 * m22
    c[3] = m10 * m10 + m11 * m11 + m12 * m12
    c[4] = m10 * m20 + m11 * m21 + m12 * m22
    c[5] = m20 * m20 + m21 * m21 + m22 * m22


@njit
def _merge_children(node, first, number, means, quaternions, scales, opacities, sh, c, colour):  # type: ignore[no-untyped-def]
    last = first + number
    total = 0.0
    for child in range(first, last):
        total += np.float64(opacities[child]) * _surface(scales, child)
    equal = not total > 0.0
    weight_sum = np.float64(number) if equal else total
    opacity = 0.0
    mx, my, mz = 0.0, 0.0, 0.0
    for child in range(first, last):
        w = _weight(equal, opacities, scales, child) / weight_sum
        opacity += w * np.float64(opacities[child])
        mx += w * np.float64(means[child, 0])
        my += w * np.float64(means[child, 1])
        mz += w * np.float64(means[child, 2])
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for child in range(first, last):
        w = _weight(equal, opacities, scales, child) / weight_sum
        _covariance(quaternions, scales, child, c)
        dx = np.float64(means[child, 0]) - mx
        dy = np.float64(means[child, 1]) - my
        dz = np.float64(means[child, 2]) - mz
        xx += w * (c[0] + dx * dx)
        xy += w * (c[1] + dx * dy)
        xz += w * (c[2] + dx * dz)
        yy += w * (c[3] + dy * dy)
        yz += w * (c[4] + dy * dz)
        zz += w * (c[5] + dz * dz)
    colour[:] = 0.0
    for child in range(first, last):
        w = _weight(equal, opacities, scales, child) / weight_sum
        for k in range(len(colour)):
            colour[k] += w * np.float64(sh[child, k])
    for k in range(len(colour)):
        sh[node, k] = np.float32(colour[k])
    means[node, 0], means[node, 1], means[node, 2] = np.float32(mx), np.float32(my), np.float32(mz)
    surface = _store_axes(node, xx, xy, xz, yy, yz, zz, quaternions, scales)
    if not equal and surface > 0.0:
        opacity = total / surface
    opacities[node] = np.float32(opacity)


@njit
def _weight(equal, opacities, scales, child):  # type: ignore[no-untyped-def]
    return 1.0 if equal else np.float64(opacities[child]) * _surface(scales, child)


@njit
def _store_axes(node, xx, xy, xz, yy, yz, zz, quaternions, scales):  # type: ignore[no-untyped-def]
    """Standard deviations and rotation of a covariance; returns its surface.

    Cyclic Jacobi; the rotations are accumulated as a quaternion. Rounding may leave an eigenvalue a
    little below zero: its standard deviation is 0.
    """
    w, x, y, z = 1.0, 0.0, 0.0, 0.0
    for _ in range(_SWEEPS):
        xx, yy, xy, xz, yz, half_c, half_s = _rotate(xx, yy, xy, xz, yz)
        w, x, y, z = (
            w * half_c - z * half_s,
            x * half_c + y * half_s,
            y * half_c - x * half_s,
            z * half_c + w * half_s,
        )
        yy, zz, yz, xy, xz, half_c, half_s = _rotate(yy, zz, yz, xy, xz)
        w, x, y, z = (
            w * half_c - x * half_s,
            x * half_c + w * half_s,
            y * half_c + z * half_s,
            z * half_c - y * half_s,
        )
        zz, xx, xz, yz, xy, half_c, half_s = _rotate(zz, xx, xz, yz, xy)
        w, x, y, z = (
            w * half_c - y * half_s,
            x * half_c - z * half_s,
            y * half_c + w * half_s,
            z * half_c + x * half_s,
        )
        if xy == 0.0 and xz == 0.0 and yz == 0.0:
            break
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    quaternions[node, 0], quaternions[node, 1] = np.float32(w / norm), np.float32(x / norm)
    quaternions[node, 2], quaternions[node, 3] = np.float32(y / norm), np.float32(z / norm)
    s0, s1, s2 = math.sqrt(max(xx, 0.0)), math.sqrt(max(yy, 0.0)), math.sqrt(max(zz, 0.0))
    scales[node, 0], scales[node, 1], scales[node, 2] = (
        np.float32(s0),
        np.float32(s1),
        np.float32(s2),
    )
    return s0 * s1 + s0 * s2 + s1 * s2


@njit
def _rotate(pp, qq, pq, rp, rq):  # type: ignore[no-untyped-def]
    """One Jacobi rotation in the plane (p, q) about r; p, q, r in cyclic order.

    Returns the new pp, qq, pq = 0, rp, rq, and cosine and sine of half the angle about r.
    """
    if pq * pq <= _NEGLIGIBLE * abs(pp * qq):
        return pp, qq, 0.0, rp, rq, 1.0, 0.0
    ratio = (qq - pp) / (2.0 * pq)
    t = 1.0 / (abs(ratio) + math.sqrt(ratio * ratio + 1.0))
    if ratio < 0.0:
        t = -t
    c = 1.0 / math.sqrt(t * t + 1.0)
    s = t * c
    half_c = math.sqrt(0.5 * (1.0 + c))
    half_s = -0.5 * s / half_c
    return pp - t * pq, qq + t * pq, 0.0, c * rp - s * rq, s * rp + c * rq, half_c, half_s
