"""View-dependent colour: real spherical harmonics of degree 0 to 3 (formulas in conventions.md)."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.constants import BLUE, GREEN, RED, SH_C0, SH_C1, SH_C2, SH_C3
from gaussians.lanes import WIDTH, prefetch
from gaussians.parallel import run_chunks

Float32 = NDArray[np.float32]

_ZERO, _HALF = np.float32(0), np.float32(0.5)
_TWO, _THREE, _FOUR = np.float32(2), np.float32(3), np.float32(4)
_C20, _C21, _C22, _C23, _C24 = SH_C2
_C30, _C31, _C32, _C33, _C34, _C35, _C36 = SH_C3
_AHEAD = 6  # splats whose scattered coefficients are asked for in advance


@njit(inline="always")
def _basis(coefficients: int, x: np.float32, y: np.float32, z: np.float32, basis: Float32) -> None:
    """What each coefficient after the first is multiplied by; x - b k is x + (-b) k, to the bit."""
    xx, yy, zz = x * x, y * y, z * z
    xy, yz, xz = x * y, y * z, x * z
    if coefficients > 1:
        basis[1] = -(SH_C1 * y)
        basis[2] = SH_C1 * z
        basis[3] = -(SH_C1 * x)
    if coefficients > 4:
        basis[4] = _C20 * xy
        basis[5] = _C21 * yz
        basis[6] = _C22 * ((_TWO * zz - xx) - yy)
        basis[7] = _C23 * xz
        basis[8] = _C24 * (xx - yy)
    if coefficients > 9:
        basis[9] = (_C30 * y) * (_THREE * xx - yy)
        basis[10] = (_C31 * xy) * z
        basis[11] = (_C32 * y) * ((_FOUR * zz - xx) - yy)
        basis[12] = (_C33 * z) * ((_TWO * zz - _THREE * xx) - _THREE * yy)
        basis[13] = (_C34 * x) * ((_FOUR * zz - xx) - yy)
        basis[14] = (_C35 * z) * (xx - yy)
        basis[15] = (_C36 * x) * (xx - _THREE * yy)


@njit(cache=True, error_model="numpy", nogil=True)
def _colour(
    begin: int,
    end: int,
    ids: NDArray[np.int32],
    needed: NDArray[np.bool_],
    means: Float32,
    sh: Float32,
    positions: Float32,
    features: Float32,
) -> None:
    coefficients = sh.shape[1]
    basis = np.empty(16, np.float32)
    for rank in range(begin, end):
        ahead = min(rank + _AHEAD, end - 1)
        if needed[ahead]:
            start = np.intp(ids[ahead]) * coefficients * 3
            for line in range(start, start + coefficients * 3, WIDTH):
                prefetch(sh, line)
            prefetch(means, np.intp(ids[ahead]) * 3)
        if not needed[rank]:
            continue
        i = ids[rank]
        for eye in range(features.shape[0]):
            x = means[i, 0] - positions[eye, 0]
            y = means[i, 1] - positions[eye, 1]
            z = means[i, 2] - positions[eye, 2]
            length = np.sqrt((x * x + y * y) + z * z)
            if length > _ZERO:
                x, y, z = x / length, y / length, z / length
            _basis(coefficients, x, y, z, basis)
            red = SH_C0 * sh[i, 0, 0] + _HALF
            green = SH_C0 * sh[i, 0, 1] + _HALF
            blue = SH_C0 * sh[i, 0, 2] + _HALF
            for k in range(1, coefficients):
                red = red + basis[k] * sh[i, k, 0]
                green = green + basis[k] * sh[i, k, 1]
                blue = blue + basis[k] * sh[i, k, 2]
            features[eye, rank, RED] = max(red, _ZERO)
            features[eye, rank, GREEN] = max(green, _ZERO)
            features[eye, rank, BLUE] = max(blue, _ZERO)


def fill_colours(
    features: Float32,
    ids: NDArray[np.int32],
    needed: NDArray[np.bool_],
    means: Float32,
    sh: Float32,
    positions: NDArray[np.float64],
) -> None:
    """Write red, green, blue >= 0 of the needed ranks into feature records [eyes, M, 10 or more].

    ``positions`` [eyes, 3] are the eyes in world metres; they are rounded to float32 first.
    """
    arguments = (ids, needed, means, sh, positions.astype(np.float32), features)
    run_chunks(_colour, len(ids), *arguments)
