"""Positions without history: whole numbers of steps, of which only the lowest bits travel.

The step is the power of two at most 2^-bits times a node's coded largest standard deviation, and
the number that of its mean. The receiver takes, of all whole numbers with these lowest bits, the
one nearest to the mean of a Gaussian it holds. What it finds is a function of the node alone as
long as its own value of that mean is within a tolerance of the tree's
(`lod_cloud.codec.tolerance`): how many bits a node needs for that is for the sender to work out.
Four numbers of bits serve a message; 32 bits need no neighbour at all. Coding against what only
the receiver knows exactly: doi:10.1109/TIT.1976.1055508.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from lod_cloud.codec.interface import References
from lod_cloud.columns import ColumnReader, ColumnWriter
from lod_cloud.lod_tree import Float32

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

_ABSOLUTE_BITS = 32
_WIDTH_SHARES = (0.3, 0.62, 0.88, 1.0)  # of the nodes of a message that a number of bits suffices
_REACH = 2.0**40  # steps; a reference that far away is of no use
_MOST_BITS = 16


@dataclass(frozen=True)
class PositionSteps:
    """Positions in steps of 2^-``bits`` standard deviations; error at most half a step."""

    bits: int

    def __post_init__(self) -> None:
        if not 0 <= self.bits <= _MOST_BITS:
            raise InputError(f"position bits must be 0 to {_MOST_BITS}, not {self.bits}")

    @property
    def max_error(self) -> float:
        """Largest error per axis, in the node's largest standard deviation, for a sender to hold to
        (half a step, twice that for the standard deviation's own code and float32).
        """
        return 2.0**-self.bits

    def encode(self, means: Float32, sigmas: Float64) -> tuple[Int64, Mask]:
        """[N, 3] whole numbers, and which rows have them."""
        places = np.floor(means / self._steps(sigmas)[:, None])
        valid = np.all(np.abs(places) < 2.0 ** (_ABSOLUTE_BITS - 1), axis=1)
        return np.where(valid[:, None], places, 0).astype(np.int64), valid

    def decode(self, places: Int64, sigmas: Float64) -> Float32:
        """[N, 3] means, in the middle of the step."""
        return ((places + 0.5) * self._steps(sigmas)[:, None]).astype(np.float32)

    def write(
        self,
        writer: ColumnWriter,
        places: Int64,
        sigmas: Float64,
        references: References | None,
        tolerance: float,
    ) -> None:
        """So many bits that any value within ``tolerance`` standard deviations of the reference
        will do.
        """
        steps = self._steps(sigmas)[:, None]
        near, margin = np.zeros(places.shape), np.zeros(steps.shape)
        if references is not None:
            near = references.means / steps
            margin = tolerance * references.sigmas[:, None] / steps
        room = (np.abs(places - near) + margin).max(axis=1, initial=0) + 2
        needed = np.minimum(np.frexp(room)[1] + 1, _ABSOLUTE_BITS)
        widths = _few(needed)
        classes = np.searchsorted(widths, needed)
        writer.raw(bytes(widths))
        writer.bits(classes, 2)
        writer.bits(places & ((1 << _ABSOLUTE_BITS) - 1), np.repeat(widths[classes], 3))

    @staticmethod
    def read(reader: ColumnReader, count: int) -> tuple[Int64, Int64]:
        """[3 count] lowest bits, and how many they are."""
        widths = np.frombuffer(reader.raw(len(_WIDTH_SHARES)), np.uint8).astype(np.int64)
        every = np.repeat(widths[reader.bits(count, 2)], 3)
        return reader.bits(3 * count, every).astype(np.int64), every

    def nearest(
        self, lowest: tuple[Int64, Int64], sigmas: Float64, references: Float32 | None
    ) -> Int64:
        """[N, 3] the whole numbers with these lowest bits that are nearest to the references."""
        low, widths = lowest
        around = np.zeros(len(low), np.int64)
        if references is not None:
            steps = np.repeat(self._steps(sigmas), 3)
            scaled = np.clip(references.reshape(-1).astype(np.float64) / steps, -_REACH, _REACH)
            around = np.where(widths < _ABSOLUTE_BITS, np.rint(scaled), 0).astype(np.int64)
        whole = np.int64(1) << widths
        half = whole >> 1
        return (around + ((low - around + half) & (whole - 1)) - half).reshape(-1, 3)

    def _steps(self, sigmas: Float64) -> Float64:
        """[N] powers of two (of a standard deviation of 0: any)."""
        return np.ldexp(1.0, np.frexp(sigmas)[1] - 1 - self.bits)


def _few(needed: NDArray[np.integer]) -> NDArray[np.uint8]:
    """[4] ascending numbers of bits, the last one enough for all."""
    values = np.sort(needed) if len(needed) else np.zeros(1, np.int64)
    rows = [math.ceil(share * len(values)) - 1 for share in _WIDTH_SHARES]
    return values[rows].astype(np.uint8)
