"""exp and ln for kernels: own polynomials, so that the bits depend on no library.

Called from kernels in other files; see kernel_cache.py for what that asks of the disk cache.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from gaussians.lanes import scaled

_LOG2_E = np.float32(1.4426950408889634)
_LN2_HIGH = np.float32(0.693359375)  # 9 significant bits: k * _LN2_HIGH is exact for |k| < 2**15
_LN2_LOW = np.float32(-2.1219444005469057e-4)
_ROUND = np.float32(12582912.0)  # 1.5 * 2**23: adding and subtracting it rounds to an integer
# (exp(r) - 1 - r) / r**2 on |r| <= ln(2)/2, Chebyshev fit of degree 4
_E2 = np.float32(0.5)
_E3 = np.float32(0.16666576)
_E4 = np.float32(0.041666463)
_E5 = np.float32(0.008363236)
_E6 = np.float32(0.0013933734)
_ONE = np.float32(1.0)


@njit(inline="always")
def exp_float32(p: Any) -> Any:
    """exp(p) for -87 < p <= 0, one float32 or `Lanes`, within 2 ulp; operation order in
    conventions.md."""
    shifted = p * _LOG2_E + _ROUND
    k = shifted - _ROUND
    r = (p - k * _LN2_HIGH) - k * _LN2_LOW
    poly = (((_E6 * r + _E5) * r + _E4) * r + _E3) * r + _E2
    return scaled((poly * (r * r) + r) + _ONE, shifted)


_SQRT_HALF = 0.7071067811865476
_LN2 = 0.6931471805599453


@njit(inline="always")
def ln_float64(x: float) -> float:
    """ln(x) for normal x > 0, float64, within 2 ulp: atanh series of the mantissa."""
    mantissa, exponent = math.frexp(x)
    if mantissa < _SQRT_HALF:
        mantissa *= 2.0
        exponent -= 1
    s = (mantissa - 1.0) / (mantissa + 1.0)
    z = s * s
    series = 1.0 / 21.0
    series = series * z + 1.0 / 19.0
    series = series * z + 1.0 / 17.0
    series = series * z + 1.0 / 15.0
    series = series * z + 1.0 / 13.0
    series = series * z + 1.0 / 11.0
    series = series * z + 1.0 / 9.0
    series = series * z + 1.0 / 7.0
    series = series * z + 1.0 / 5.0
    series = series * z + 1.0 / 3.0
    return exponent * _LN2 + (2.0 * s + 2.0 * s * (z * series))
