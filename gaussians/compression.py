"""Number formats of the Gaussian stream, one per kind of field (codebook.py: harmonics).

The paper's coding (Sec. 4.3): attributes are coded independently of each other; every attribute is
16-bit fixed point but the spherical harmonics above degree 0 ("AC"), which are vector-quantised.
Fields that also serve with fewer codes take the largest code as ``top``.
Where the paper names no range, the range comes from the scene, and a value outside it is reported,
never clipped: ``encode`` returns the codes and which values are valid.

Decoding uses additions, multiplications, divisions and square roots in float64 in a fixed order and
rounds once to float32, so both ends get the same bits. No code depends on the number of threads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError

UInt16 = NDArray[np.uint16]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

TOP = 65535  # largest 16-bit code
FLOAT32_STEP = 2.0**-24  # largest relative rounding error of float32
ROTATION_ERROR_RAD = 8e-5  # 2 * 2 * sqrt(3) * (sqrt(2) / 65534 / 2), and float32 rounding
_TILE_LIMIT = 32767


def exp2(x: Float64) -> Float64:
    """2**x in float64 within 1e-15 relative, from exact operations only: no library decides the
    bits.
    """
    whole = np.rint(x)
    t = (x - whole) * 0.6931471805599453
    value = np.ones_like(t)
    for n in range(14, 0, -1):
        value = 1.0 + t * value / n
    return np.ldexp(value, whole.astype(np.int32))


@dataclass(frozen=True)
class LinearField:
    """Evenly spaced codes over ``low``..``high``. Error at most ``max_error``."""

    low: float
    high: float
    top: int = TOP

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise InputError(f"field range must rise, not go from {self.low} to {self.high}")

    @property
    def step(self) -> float:
        return (self.high - self.low) / self.top

    @property
    def max_error(self) -> float:
        """Half a step and the rounding to float32."""
        return 0.5 * self.step * (1 + 1e-9) + FLOAT32_STEP * max(abs(self.low), abs(self.high))

    def encode(self, values: Float32) -> tuple[UInt16, Mask]:
        """Codes of any shape, and where the value lies in the range."""
        wide = values.astype(np.float64)
        valid = (wide >= self.low) & (wide <= self.high)
        codes = np.rint((np.where(valid, wide, self.low) - self.low) / self.step)
        return codes.astype(np.uint16), valid

    def decode(self, codes: UInt16) -> Float32:
        return (self.low + codes.astype(np.float64) * self.step).astype(np.float32)


@dataclass(frozen=True)
class SquareRootField:
    """0..``high`` with codes spaced evenly in the square root (companding): fine near 0.

    Error of a value v at most sqrt(v * high) / 65535 + high / 65535**2 / 4, and float32 rounding.
    """

    high: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.high) and self.high > 0):
            raise InputError(f"field range must end above 0, not at {self.high}")

    def max_error(self, value: float) -> float:
        """Largest error of a value in the range."""
        rounding = (FLOAT32_STEP + 1e-12) * value
        return math.sqrt(value * self.high) / TOP + self.high / TOP**2 / 2 + rounding

    def encode(self, values: Float32) -> tuple[UInt16, Mask]:
        wide = values.astype(np.float64)
        valid = (wide >= 0) & (wide <= self.high)
        codes = np.rint(np.sqrt(np.where(valid, wide, 0.0) / self.high) * TOP)
        return codes.astype(np.uint16), valid

    def decode(self, codes: UInt16) -> Float32:
        root = codes.astype(np.float64) / TOP
        return (root * root * self.high).astype(np.float32)


@dataclass(frozen=True)
class LogField:
    """0 exactly, and ``top`` values spaced evenly in the logarithm over 2**low .. 2**high.

    To the nearest: relative error at most ``max_ratio - 1``. With ``round_up`` the decoded value
    is never below the original and at most ``max_ratio`` times it.
    """

    low: float
    high: float
    round_up: bool = False
    top: int = TOP

    def __post_init__(self) -> None:
        if not (-150 <= self.low < self.high <= 128):
            raise InputError(
                f"logarithmic range must rise within -150..128, not {self.low} to {self.high}"
            )

    @classmethod
    def covering(
        cls, values: Float32 | Float64, *, round_up: bool = False, top: int = TOP
    ) -> LogField:
        """The range of the positive ones of these values, its ends widened to multiples of 1/64."""
        positive = values[values > 0].astype(np.float64)
        if not len(positive):
            return cls(-1.0, 1.0, round_up, top)
        ends = np.log2([positive.min(), positive.max()]) * 64 + [-0.01, 0.01]
        return cls(float(np.floor(ends[0]) / 64), float(np.ceil(ends[1]) / 64), round_up, top)

    @property
    def step(self) -> float:
        """Step of the base-2 logarithm."""
        return (self.high - self.low) / (self.top - 1)

    @property
    def max_ratio(self) -> float:
        """Largest factor between a value and its decoded one."""
        return 2.0 ** (self.step * (1.0 if self.round_up else 0.5)) * (1 + 4 * FLOAT32_STEP)

    @cached_property
    def _table(self) -> Float32:
        """[top + 1] decoded values."""
        values = exp2(self.low + np.arange(-1, self.top, dtype=np.float64) * self.step)
        values[0] = 0.0
        return values.astype(np.float32)

    @cached_property
    def _limits(self) -> Float64:
        """[top + 2] code n stands for values in limits[n] .. limits[n + 1]; nearest only."""
        inner = exp2(self.low + (np.arange(-1, self.top + 1, dtype=np.float64) - 0.5) * self.step)
        inner[0] = 0.0
        return inner

    def encode(self, values: Float32 | Float64) -> tuple[UInt16, Mask]:
        wide = values.astype(np.float64)
        floor = 2.0 ** (self.low - self.step * (1.0 if self.round_up else 0.5))
        valid = (wide == 0) | ((wide >= floor) & (wide <= np.float64(self._table[-1])))
        inside = np.where(valid & (wide > 0), wide, 1.0 if self.low <= 0 <= self.high else floor)
        guess = (np.log2(inside) - self.low) / self.step + 1
        if self.round_up:
            codes = np.clip(np.ceil(guess), 1, self.top).astype(np.int32)
            codes -= (codes > 1) & (self._table[codes - 1] >= inside)
            codes += (codes < self.top) & (self._table[codes] < inside)
        else:
            codes = np.clip(np.rint(guess), 1, self.top).astype(np.int32)
            codes -= (codes > 1) & (inside < self._limits[codes])
            codes += (codes < self.top) & (inside >= self._limits[codes + 1])
        return np.where(wide > 0, codes, 0).astype(np.uint16), valid

    def decode(self, codes: UInt16) -> Float32:
        return self._table[codes]


@dataclass(frozen=True)
class PositionField:
    """Positions as the number of a cubic tile (three signed 16-bit) and 16-bit offsets in it.

    The tile's edge is a power of two, so tiles and steps are exact. Error per axis at most
    ``max_error(|coordinate|)``: half a step (edge / 65536) and the rounding to float32.
    """

    tile_m: float

    def __post_init__(self) -> None:
        if not (self.tile_m > 0 and math.frexp(self.tile_m)[0] == 0.5):
            raise InputError(f"tile edge must be a power of two in metres, not {self.tile_m}")

    @property
    def step(self) -> float:
        return self.tile_m / (TOP + 1)

    def max_error(self, coordinate: float) -> float:
        return 0.5 * self.step + FLOAT32_STEP * (abs(coordinate) + self.step)

    def encode(self, means: Float32) -> tuple[NDArray[np.int16], UInt16, Mask]:
        """Tiles and offsets [N, 3], and per row whether all three tiles fit."""
        scaled = means.astype(np.float64) / self.tile_m
        tile = np.floor(scaled)
        valid: Mask = np.all(np.abs(tile) <= _TILE_LIMIT, axis=1)
        tile = np.where(valid[:, None], tile, 0.0)
        offset = np.floor((np.where(valid[:, None], scaled, 0.0) - tile) * (TOP + 1))
        offset = np.minimum(offset, TOP)  # just below 0, the difference rounds up to a whole tile
        return tile.astype(np.int16), offset.astype(np.uint16), valid

    def decode(self, tile: NDArray[np.int16], offset: UInt16) -> Float32:
        inside = (offset.astype(np.float64) + 0.5) * self.step
        return (tile.astype(np.float64) * self.tile_m + inside).astype(np.float32)


_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def encode_rotation(quaternions: Float32, top: int = TOP) -> tuple[NDArray[np.uint8], UInt16]:
    """Smallest three: which component is largest [N], and the other three [N, 3] over +-1/sqrt(2).

    The quaternion is normalised first. The decoded rotation differs by at most
    ``ROTATION_ERROR_RAD``, times 65535 / ``top`` with fewer codes.
    """
    wide = quaternions.astype(np.float64)
    wide /= np.sqrt((wide * wide).sum(axis=1, keepdims=True))
    largest = np.abs(wide).argmax(axis=1)
    rows = np.arange(len(wide))
    sign = np.where(wide[rows, largest] < 0, -1.0, 1.0)
    three = wide[rows[:, None], _OTHERS[largest]] * sign[:, None]
    codes = np.rint(three / _rotation_step(top)) + (top - 1) // 2
    return largest.astype(np.uint8), np.clip(codes, 0, top - 1).astype(np.uint16)


def decode_rotation(largest: NDArray[np.uint8], codes: UInt16, top: int = TOP) -> Float32:
    """[N, 4] unit quaternions; the omitted component is positive."""
    three = (codes.astype(np.float64) - (top - 1) // 2) * _rotation_step(top)
    rest = np.maximum(1.0 - (three * three).sum(axis=1), 0.0)
    quaternions = np.empty((len(three), 4), np.float64)
    rows = np.arange(len(three))
    quaternions[rows, largest] = np.sqrt(rest)
    quaternions[rows[:, None], _OTHERS[largest]] = three
    return quaternions.astype(np.float32)


def _rotation_step(top: int) -> float:
    return math.sqrt(2.0) / (top - 1)  # an even number of steps: zero is a code
