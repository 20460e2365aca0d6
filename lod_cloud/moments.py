"""Second moments of Gaussians for merging: covariance, its axes, surface. Kernels, float64.

Axes are found for up to `LANES` covariances at a time, element by element in one array, which
compilers turn into vector instructions; the bits are those of one at a time.
"""

import math

import numpy as np
from numba import njit

LANES = 64
ROWS = 10  # of LANES numbers: xx, xy, xz, yy, yz, zz; quaternion w, x, y, z
# unsigned: with signed indices, which might count from the end, nothing is vectorised
_LANES = np.uint64(LANES)
_XX, _XY, _XZ, _YY, _YZ, _ZZ = (np.uint64(row * LANES) for row in range(6))
_QW, _QX, _QY, _QZ = (np.uint64(row * LANES) for row in range(6, 10))
_SWEEPS = 4  # enough for nearly all
_MORE_SWEEPS = 6
_NEGLIGIBLE = 1e-20  # squared ratio of an off-diagonal entry to its diagonal ones


@njit
def rounded_up(value):  # type: ignore[no-untyped-def]
    """Smallest float32 >= value, for finite value >= 0."""
    nearest = np.float32(value)
    if np.float64(nearest) < value:
        return np.int32(nearest.view(np.int32) + np.int32(1)).view(np.float32)
    return nearest


@njit
def surface(scales, node):  # type: ignore[no-untyped-def]
    """s0 s1 + s0 s2 + s1 s2, a fixed share of the ellipsoid's silhouette."""
    a, b, c = np.float64(scales[node, 0]), np.float64(scales[node, 1]), np.float64(scales[node, 2])
    return a * b + a * c + b * c


@njit
def covariance(quaternions, scales, node):  # type: ignore[no-untyped-def]
    """xx, xy, xz, yy, yz, zz of the node's covariance; the quaternion is normalised."""
    w, x = np.float64(quaternions[node, 0]), np.float64(quaternions[node, 1])
    y, z = np.float64(quaternions[node, 2]), np.float64(quaternions[node, 3])
    t = 2.0 / (w * w + x * x + y * y + z * z)
    s0 = np.float64(scales[node, 0])
    s1 = np.float64(scales[node, 1])
    s2 = np.float64(scales[node, 2])
    m00 = (1 - t * (y * y + z * z)) * s0
    m10 = t * (x * y + w * z) * s0
    m20 = t * (x * z - w * y) * s0
    m01 = t * (x * y - w * z) * s1
    m11 = (1 - t * (x * x + z * z)) * s1
    m21 = t * (y * z + w * x) * s1
    m02 = t * (x * z + w * y) * s2
    m12 = t * (y * z - w * x) * s2
    m22 = (1 - t * (x * x + y * y)) * s2
    return (
        m00 * m00 + m01 * m01 + m02 * m02,
        m00 * m10 + m01 * m11 + m02 * m12,
        m00 * m20 + m01 * m21 + m02 * m22,
        m10 * m10 + m11 * m11 + m12 * m12,
        m10 * m20 + m11 * m21 + m12 * m22,
        m20 * m20 + m21 * m21 + m22 * m22,
    )


@njit
def find_axes(lanes, count):  # type: ignore[no-untyped-def]
    """Turn the first ``count`` covariances in ``lanes`` [ROWS * LANES] diagonal, by cyclic Jacobi.

    Writes the rotations to the rows of the quaternion (not normalised).
    """
    for i in range(_LANES):
        lanes[i + _QW] = 1.0
        lanes[i + _QX] = 0.0
        lanes[i + _QY] = 0.0
        lanes[i + _QZ] = 0.0
    for _ in range(_SWEEPS):
        for i in range(_LANES):
            _sweep(lanes, i)
    for i in range(np.uint64(count)):
        for _ in range(_MORE_SWEEPS):
            xx, yy, zz = abs(lanes[i + _XX]), abs(lanes[i + _YY]), abs(lanes[i + _ZZ])
            xy, xz, yz = lanes[i + _XY], lanes[i + _XZ], lanes[i + _YZ]
            if (
                xy * xy <= _NEGLIGIBLE * (xx * yy)
                and xz * xz <= _NEGLIGIBLE * (xx * zz)
                and yz * yz <= _NEGLIGIBLE * (yy * zz)
            ):
                break
            _sweep(lanes, i)


@njit
def _sweep(lanes, i):  # type: ignore[no-untyped-def]
    """One rotation in each of the three planes."""
    xx, xy, xz = lanes[i + _XX], lanes[i + _XY], lanes[i + _XZ]
    yy, yz, zz = lanes[i + _YY], lanes[i + _YZ], lanes[i + _ZZ]
    w, x, y, z = lanes[i + _QW], lanes[i + _QX], lanes[i + _QY], lanes[i + _QZ]
    xx, yy, xy, xz, yz, c, s = _rotate(xx, yy, xy, xz, yz)
    w, x, y, z = w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s
    yy, zz, yz, xy, xz, c, s = _rotate(yy, zz, yz, xy, xz)
    w, x, y, z = w * c - x * s, x * c + w * s, y * c + z * s, z * c - y * s
    zz, xx, xz, yz, xy, c, s = _rotate(zz, xx, xz, yz, xy)
    w, x, y, z = w * c - y * s, x * c - z * s, y * c + w * s, z * c + x * s
    lanes[i + _XX], lanes[i + _XY], lanes[i + _XZ] = xx, xy, xz
    lanes[i + _YY], lanes[i + _YZ], lanes[i + _ZZ] = yy, yz, zz
    lanes[i + _QW], lanes[i + _QX], lanes[i + _QY], lanes[i + _QZ] = w, x, y, z


@njit
def _rotate(pp, qq, pq, rp, rq):  # type: ignore[no-untyped-def]
    """One Jacobi rotation in the plane (p, q) about r; p, q, r in cyclic order.

    Returns the new pp, qq, pq = 0, rp, rq, and cosine and sine of half the angle about r. Without
    branches.
    """
    skip = pq * pq <= _NEGLIGIBLE * abs(pp * qq)
    ratio = (qq - pp) / (1.0 if skip else 2.0 * pq)
    size = 1.0 / (abs(ratio) + math.sqrt(ratio * ratio + 1.0))
    t = 0.0 if skip else (-size if ratio < 0.0 else size)
    c = 1.0 / math.sqrt(t * t + 1.0)
    s = t * c
    half_c = math.sqrt(0.5 * (1.0 + c))
    half_s = -0.5 * s / half_c
    left = pq if skip else 0.0
    return pp - t * pq, qq + t * pq, left, c * rp - s * rq, s * rp + c * rq, half_c, half_s


@njit
def store_axes(lanes, lane, node, quaternions, scales):  # type: ignore[no-untyped-def]
    """Standard deviations and unit rotation of one lane as a node's; returns the surface.

    Rounding may leave an eigenvalue a little below zero: its standard deviation is 0.
    """
    i = np.uint64(lane)
    w, x, y, z = lanes[i + _QW], lanes[i + _QX], lanes[i + _QY], lanes[i + _QZ]
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    quaternions[node, 0], quaternions[node, 1] = np.float32(w / norm), np.float32(x / norm)
    quaternions[node, 2], quaternions[node, 3] = np.float32(y / norm), np.float32(z / norm)
    s0 = math.sqrt(max(lanes[i + _XX], 0.0))
    s1 = math.sqrt(max(lanes[i + _YY], 0.0))
    s2 = math.sqrt(max(lanes[i + _ZZ], 0.0))
    scales[node, 0], scales[node, 1] = np.float32(s0), np.float32(s1)
    scales[node, 2] = np.float32(s2)
    return s0 * s1 + s0 * s2 + s1 * s2
