"""View-dependent colour: real spherical harmonics of degree 0 to 3 (formulas in conventions.md)."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.constants import RED, SH_C0, SH_C1, SH_C2, SH_C3
from gaussians.parallel import run_chunks

_ZERO, _HALF = np.float32(0), np.float32(0.5)
_TWO, _THREE, _FOUR = np.float32(2), np.float32(3), np.float32(4)
_C20, _C21, _C22, _C23, _C24 = SH_C2
_C30, _C31, _C32, _C33, _C34, _C35, _C36 = SH_C3


@njit(cache=True, error_model="numpy", nogil=True)
def _colour(
    begin: int,
    end: int,
    ids: NDArray[np.int32],
    needed: NDArray[np.bool_],
    means: NDArray[np.float32],
    sh: NDArray[np.float32],
    eye: NDArray[np.float32],
    features: NDArray[np.float32],
) -> None:
    coefficients = sh.shape[1]
    for rank in range(begin, end):
        if not needed[rank]:
            continue
        i = ids[rank]
        x = means[i, 0] - eye[0]
        y = means[i, 1] - eye[1]
        z = means[i, 2] - eye[2]
        length = np.sqrt((x * x + y * y) + z * z)
        if length > _ZERO:
            x, y, z = x / length, y / length, z / length
        xx, yy, zz = x * x, y * y, z * z
        xy, yz, xz = x * y, y * z, x * z
        for channel in range(3):
            k = sh[i, :, channel]
            c = SH_C0 * k[0] + _HALF
            if coefficients > 1:
                c = ((c - (SH_C1 * y) * k[1]) + (SH_C1 * z) * k[2]) - (SH_C1 * x) * k[3]
            if coefficients > 4:
                c = c + (_C20 * xy) * k[4]
                c = c + (_C21 * yz) * k[5]
                c = c + (_C22 * ((_TWO * zz - xx) - yy)) * k[6]
                c = c + (_C23 * xz) * k[7]
                c = c + (_C24 * (xx - yy)) * k[8]
            if coefficients > 9:
                c = c + ((_C30 * y) * (_THREE * xx - yy)) * k[9]
                c = c + ((_C31 * xy) * z) * k[10]
                c = c + ((_C32 * y) * ((_FOUR * zz - xx) - yy)) * k[11]
                c = c + ((_C33 * z) * ((_TWO * zz - _THREE * xx) - _THREE * yy)) * k[12]
                c = c + ((_C34 * x) * ((_FOUR * zz - xx) - yy)) * k[13]
                c = c + ((_C35 * z) * (xx - yy)) * k[14]
                c = c + ((_C36 * x) * (xx - _THREE * yy)) * k[15]
            features[rank, RED + channel] = max(c, _ZERO)


def fill_colours(
    features: NDArray[np.float32],
    ids: NDArray[np.int32],
    needed: NDArray[np.bool_],
    means: NDArray[np.float32],
    sh: NDArray[np.float32],
    eye: NDArray[np.float64],
) -> None:
    """Write red, green, blue >= 0 of the needed ranks into one eye's feature records [M, 10].

    ``eye`` is that eye's position in world metres; it is rounded to float32 first.
    """
    run_chunks(_colour, len(ids), ids, needed, means, sh, eye.astype(np.float32), features)
