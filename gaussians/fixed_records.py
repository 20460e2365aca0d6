"""The formats of the integer datapath, and splat records in them.

docs/number_formats.md states the contract. Records are made once per splat from its float32
features, all roundings half up; arithmetic here is float64, in which every step is exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.constants import BLUE, CONIC_A, CONIC_C, RED, THRESHOLD, U, V
from gaussians.errors import InputError

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
Bool = NDArray[np.bool_]

# Columns of a record: those of a feature record, but for the two words of the opacity, and one more
REACH, EXPONENT, SCALE = 5, 6, 10
RECORD = 11

CENTRE_INTEGER_BITS = 12  # and a sign: -4096 px to just below 4096 px, times 2^scale
POWER_INTEGER_BITS = 5  # powers are base 2, so 2^-32 is the faintest
COLOUR_INTEGER_BITS = 3
ACCUMULATOR_INTEGER_BITS = 2
EXPONENT_MAX = 46  # what smaller conics lose is below 2^-18 of a power within the window

_HALF_LOG2_E = np.float32(0.5 * math.log2(math.e))
_LOG2_E = np.float32(math.log2(math.e))


@dataclass(frozen=True)
class FixedFormat:
    """Widths of the integer datapath; the defaults are those of `hw`.

    Widths are bits behind the binary point unless said; those before it are fixed in this file.
    """

    name: str
    centre_fraction: int = 8  # splat centres, px; less by the scale of a far one
    conic_mantissa: int = 18  # sign included; one exponent for the three of a splat
    power_fraction: int = 12  # log2 of a splat's falloff, and its reach
    exp_index: int = 6  # log2 of the entries of the table of powers of two
    alpha_fraction: int = 12
    transmittance_fraction: int = 16
    colour_fraction: int = 13
    accumulator_fraction: int = 14

    def __post_init__(self) -> None:
        rules = {
            "conic_mantissa + 2 centre_fraction must be at most 36": (  # int64 holds the form
                self.conic_mantissa + 2 * self.centre_fraction <= 36
            ),
            "centre_fraction must be at least 1": self.centre_fraction >= 1,
            "exp_index must lie in 1..power_fraction": (1 <= self.exp_index <= self.power_fraction),
            "alpha_fraction must lie in 7..15": 7 <= self.alpha_fraction <= 15,
            "transmittance_fraction must lie in 14..20": (14 <= self.transmittance_fraction <= 20),
            "colour_fraction must lie in 4..20": 4 <= self.colour_fraction <= 20,
            "accumulator_fraction must lie in 8..22": 8 <= self.accumulator_fraction <= 22,
            "accumulator_fraction must be below transmittance_fraction + colour_fraction": (
                self.accumulator_fraction < self.transmittance_fraction + self.colour_fraction
            ),
        }
        for rule, kept in rules.items():
            if not kept:
                raise InputError(f"number format {self.name}: {rule}")


def encode(features: Float32, f: FixedFormat) -> tuple[Int32, tuple[int, int, int, int]]:
    """Feature records [M, 10] as integers, and how many splats' centre, conic, opacity and colour
    were held at the limit.

    Raises InputError for thresholds above 0: opacities below 1/255 cannot pass and are not listed.
    """
    if (features[:, THRESHOLD] > 0).any():
        raise InputError("thresholds of listed splats must be <= 0 (opacity at least 1/255)")
    records = np.zeros((len(features), RECORD), np.int32)
    records[:, U : V + 1], records[:, SCALE], far = _shared_scale(
        features[:, U : V + 1], f.centre_fraction
    )
    least = f.power_fraction + 1 - 2 * (f.centre_fraction - records[:, SCALE])  # shift to the right
    records[:, CONIC_A : CONIC_C + 1], records[:, EXPONENT], sharp = _shared_exponent(
        features[:, CONIC_A : CONIC_C + 1] * _HALF_LOG2_E, f.conic_mantissa, least
    )
    reach_limit = (1 << (POWER_INTEGER_BITS + f.power_fraction)) - 2  # saturated powers never pass
    reach = -features[:, THRESHOLD] * _LOG2_E
    records[:, REACH], opaque = fixed(reach, f.power_fraction, reach_limit)
    colour_limit = (1 << (COLOUR_INTEGER_BITS + f.colour_fraction)) - 1
    records[:, RED : BLUE + 1], bright = fixed(
        features[:, RED : BLUE + 1], f.colour_fraction, colour_limit
    )
    vivid = bright.any(axis=1)
    return records, (int(far.sum()), int(sharp.sum()), int(opaque.sum()), int(vivid.sum()))


def fixed(values: Float32, fraction: int, high: int) -> tuple[Int32, Bool]:
    """``values`` with ``fraction`` bits, half up, held in 0..high; where they had to be."""
    scaled = np.floor(values.astype(np.float64) * 2.0**fraction + 0.5)
    held = np.clip(scaled, 0, high)
    return held.astype(np.int32), held != scaled


def _shared_scale(centres: Float32, fraction: int) -> tuple[Int32, Int32, Bool]:
    """Centres [M, 2] and scales [M]: centre = integer x 2^(scale - fraction), with the smallest
    scale in which both fit, at most one with exact pixel centres; which did not fit."""
    limit = 1 << (CENTRE_INTEGER_BITS + fraction)
    scales = np.full(len(centres), fraction - 1, np.int32)
    for scale in range(fraction - 1, -1, -1):
        scaled = _scaled(centres.astype(np.float64), np.full(len(centres), fraction - scale))
        scales[((scaled >= -limit) & (scaled < limit)).all(axis=1)] = scale
    scaled = _scaled(centres.astype(np.float64), fraction - scales)
    held = np.clip(scaled, -limit, limit - 1)
    return held.astype(np.int32), scales, (held != scaled).any(axis=1)


def _shared_exponent(conics: Float32, bits: int, least: Int32) -> tuple[Int32, Int32, Bool]:
    """Mantissas [M, 3] and exponents [M] from ``least`` on: conic = mantissa x 2^-exponent; which
    did not fit."""
    limit = 1 << (bits - 1)
    wide = conics.astype(np.float64)
    _, largest = np.frexp(np.abs(wide).max(axis=1, initial=0.0))
    exponents = np.minimum((bits - 1) - largest, EXPONENT_MAX)
    exponents -= (
        np.abs(_scaled(wide, exponents)).max(axis=1, initial=0.0) >= limit
    )  # rounded up to it
    exponents = np.maximum(exponents, np.maximum(least, 0))
    scaled = _scaled(wide, exponents)
    held = np.clip(scaled, 1 - limit, limit - 1)
    return held.astype(np.int32), exponents.astype(np.int32), (held != scaled).any(axis=1)


def _scaled(values: NDArray[np.float64], exponents: NDArray[np.integer]) -> NDArray[np.float64]:
    """``values`` [M, n] times 2^exponents [M], half up."""
    return np.floor(np.ldexp(values, exponents[:, None].astype(np.int32)) + 0.5)
