"""Second moments of Gaussians for merging: covariance, its axes, surface, and the spheres of the
node test around them. Kernels, float64.

A node's R and e hold its own 3-sigma box (half diagonal, longest side) and exceed those of its
children by ``NEST_MARGIN``: R_ch + |m_ch - m|, e_ch. Rounded up once, to float32.

Axes are found for up to `LANES` covariances at a time, element by element in one array, which
compilers turn into vector instructions; the bits are those of one at a time.
"""

import math

import numpy as np
from numba import njit

NEST_MARGIN = 1.0 + 2.0**-19  # exceeds the rounding of the float32 node test
LANES = 64
ROWS = 10  # of LANES numbers: xx, xy, xz, yy, yz, zz; quaternion w, x, y, z
# unsigned: with signed indices, which might count from the end, nothing is vectorised
_LANES = np.uint64(LANES)
_XX, _XY, _XZ, _YY, _YZ, _ZZ = (np.uint64(row * LANES) for row in range(6))
_QW, _QX, _QY, _QZ = (np.uint64(row * LANES) for row in range(6, 10))
_NEGLIGIBLE = 1e-16  # squared ratio of an off-diagonal entry to its diagonal ones
_TINY = 1e-300  # no rotation where nothing is left to turn


@njit(forceinline=True)
def rounded_up(value):  # type: ignore[no-untyped-def]
    """Smallest float32 >= value, for finite value >= 0."""
    nearest = np.float32(value)
    step = np.int32(np.float64(nearest) < value)  # without a branch, which is not vectorised
    return np.int32(nearest.view(np.int32) + step).view(np.float32)


@njit(forceinline=True)
def box(xx, yy, zz):  # type: ignore[no-untyped-def]
    """Half diagonal and longest side of the 3-sigma box of a covariance with this diagonal."""
    return 3.0 * math.sqrt(xx + yy + zz), 6.0 * math.sqrt(max(xx, yy, zz))


@njit
def own_box(quaternions, scales, node):  # type: ignore[no-untyped-def]
    """`box` of a node's covariance."""
    xx, _, _, yy, _, zz = covariance(quaternions, scales, node)
    return box(xx, yy, zz)


@njit
def around(radius, extent, means, child, above, node, margin):  # type: ignore[no-untyped-def]
    """Least R and e of a node, at ``above[node]``, that hold a child's, at ``means[child]``."""
    dx = np.float64(means[child, 0]) - np.float64(above[node, 0])
    dy = np.float64(means[child, 1]) - np.float64(above[node, 1])
    dz = np.float64(means[child, 2]) - np.float64(above[node, 2])
    return around_at(np.float64(radius), np.float64(extent), dx, dy, dz, margin)


@njit(forceinline=True)
def around_at(radius, extent, dx, dy, dz, margin):  # type: ignore[no-untyped-def]
    """`around`, of a child so far away."""
    gap = dx * dx + dy * dy + dz * dz
    return (radius + math.sqrt(gap)) * margin, extent * margin


@njit
def surface(scales, node):  # type: ignore[no-untyped-def]
    """s0 s1 + s0 s2 + s1 s2, a fixed share of the ellipsoid's silhouette."""
    a, b, c = np.float64(scales[node, 0]), np.float64(scales[node, 1]), np.float64(scales[node, 2])
    return surface_of(a, b, c)


@njit(forceinline=True)
def surface_of(a, b, c):  # type: ignore[no-untyped-def]
    """`surface` of these standard deviations."""
    return a * b + a * c + b * c


@njit
def covariance(quaternions, scales, node):  # type: ignore[no-untyped-def]
    """xx, xy, xz, yy, yz, zz of the node's covariance; the quaternion is normalised."""
    w, x = np.float64(quaternions[node, 0]), np.float64(quaternions[node, 1])
    y, z = np.float64(quaternions[node, 2]), np.float64(quaternions[node, 3])
    s0 = np.float64(scales[node, 0])
    s1 = np.float64(scales[node, 1])
    s2 = np.float64(scales[node, 2])
    return covariance_of(w, x, y, z, s0, s1, s2)


@njit(forceinline=True)  # a call is not vectorised
def covariance_of(w, x, y, z, s0, s1, s2):  # type: ignore[no-untyped-def]
    """`covariance` of this rotation and these standard deviations."""
    t = 2.0 / (w * w + x * x + y * y + z * z)
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

    Writes the rotations to the rows of the quaternion (not normalised). What is diagonal stays as
    it is, so that no covariance depends on those beside it; the other lanes must hold numbers,
    zeros at first. Three sweeps are enough for 99.8 % of
    the nodes of a city.
    """
    for i in range(np.uint64(count)):
        lanes[i + _QW] = 1.0
        lanes[i + _QX] = 0.0
        lanes[i + _QY] = 0.0
        lanes[i + _QZ] = 0.0
    for _ in range(len(lanes) // LANES):  # 10; a constant would be unrolled, at 10 times the code
        left = 0
        for i in range(_LANES):
            left += _sweep(lanes, i)
        if left == 0:
            return


@njit(forceinline=True)  # a call is not vectorised
def _sweep(lanes, i):  # type: ignore[no-untyped-def]
    """One rotation in each of the three planes, unless diagonal; 1 if it still is not."""
    xx, xy, xz = lanes[i + _XX], lanes[i + _XY], lanes[i + _XZ]
    yy, yz, zz = lanes[i + _YY], lanes[i + _YZ], lanes[i + _ZZ]
    w, x, y, z = lanes[i + _QW], lanes[i + _QX], lanes[i + _QY], lanes[i + _QZ]
    turn = 1.0 if _is_left(xx, xy, xz, yy, yz, zz) else 0.0
    xx, yy, xy, xz, yz, c, s = _rotate(turn, xx, yy, xy, xz, yz)
    w, x, y, z = w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s
    yy, zz, yz, xy, xz, c, s = _rotate(turn, yy, zz, yz, xy, xz)
    w, x, y, z = w * c - x * s, x * c + w * s, y * c + z * s, z * c - y * s
    zz, xx, xz, yz, xy, c, s = _rotate(turn, zz, xx, xz, yz, xy)
    w, x, y, z = w * c - y * s, x * c - z * s, y * c + w * s, z * c + x * s
    lanes[i + _XX], lanes[i + _XY], lanes[i + _XZ] = xx, xy, xz
    lanes[i + _YY], lanes[i + _YZ], lanes[i + _ZZ] = yy, yz, zz
    lanes[i + _QW], lanes[i + _QX], lanes[i + _QY], lanes[i + _QZ] = w, x, y, z
    return _is_left(xx, xy, xz, yy, yz, zz)


@njit(forceinline=True)
def _is_left(xx, xy, xz, yy, yz, zz):  # type: ignore[no-untyped-def]
    """1 if off-diagonal entries matter, else 0; without branches."""
    return (
        np.int64(xy * xy > _NEGLIGIBLE * abs(xx * yy))
        | np.int64(xz * xz > _NEGLIGIBLE * abs(xx * zz))
        | np.int64(yz * yz > _NEGLIGIBLE * abs(yy * zz))
    )


@njit(forceinline=True)
def _rotate(turn, pp, qq, pq, rp, rq):  # type: ignore[no-untyped-def]
    """One Jacobi rotation in the plane (p, q) about r; p, q, r in cyclic order; with ``turn`` 0
    none.

    Returns the new pp, qq, pq, rp, rq, and cosine and sine of half the angle about r. Without
    branches, and without operations that need one: those are not vectorised.
    """
    twice, gap = 2.0 * pq, qq - pp
    size = math.sqrt(gap * gap + twice * twice) + _TINY
    t = turn * twice / (gap + (size if gap >= 0.0 else -size))
    c = 1.0 / math.sqrt(t * t + 1.0)
    s = t * c
    half_c = math.sqrt(0.5 * (1.0 + c))
    half_s = -0.5 * s / half_c
    left = pq * (1.0 - turn)
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
