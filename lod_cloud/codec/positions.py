"""Positions without history: whole numbers of steps, of which only the lowest bits travel.

The step is the power of two at most 2^-bits times a node's coded largest standard deviation, and
the number that of its mean. The receiver takes, of all whole numbers with these lowest bits, the
one nearest to the mean of a Gaussian it knows: one that it holds, or the node before in the same
message, whichever needs fewer bits. What it finds is a function of the node alone as long as its
own value of that mean is within a tolerance of the tree's (`lod_cloud.codec.tolerance`): how many
bits a node needs for that is for the sender to work out. How many they are travels too, and from
what they count; 32 bits need no neighbour at all. Coding against what only the receiver knows
exactly: doi:10.1109/TIT.1976.1055508.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.errors import InputError
from lod_cloud.codec.interface import References
from lod_cloud.columns import ColumnReader, ColumnWriter
from lod_cloud.lod_tree import Float32

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

ABSOLUTE_BITS = 32  # need no reference
CHOICES = 2 * (ABSOLUTE_BITS + 1)  # numbers of bits from what is held, from the node before
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
        valid = np.all(np.abs(places) < 2.0 ** (ABSOLUTE_BITS - 1), axis=1)
        return np.where(valid[:, None], places, 0).astype(np.int64), valid

    def decode(self, places: Int64, sigmas: Float64) -> Float32:
        """[N, 3] means, in the middle of the step."""
        return ((places + 0.5) * self._steps(sigmas)[:, None]).astype(np.float32)

    def choose(
        self, places: Int64, sigmas: Float64, references: References | None, tolerance: float
    ) -> Int64:
        """[N] how each node is best told from its surroundings, below `CHOICES`.

        Any value within ``tolerance`` standard deviations of the reference will do, and exactly
        the decoded value of the node before.
        """
        steps = self._steps(sigmas)[:, None]
        before = np.vstack([np.zeros((1, 3)), self.decode(places, sigmas)])[:-1] / steps
        counted = _bits_for(np.abs(places - before))
        counted[:1] = ABSOLUTE_BITS
        held = np.full(len(places), ABSOLUTE_BITS)
        if references is not None:
            margin = tolerance * references.sigmas[:, None] / steps
            held = _bits_for(np.abs(places - references.means / steps) + margin)
        return np.where(counted < held, counted + ABSOLUTE_BITS + 1, held)

    @staticmethod
    def write(writer: ColumnWriter, places: Int64, choices: Int64) -> None:
        """The lowest bits."""
        widths = choices % (ABSOLUTE_BITS + 1)
        writer.bits(places & ((1 << ABSOLUTE_BITS) - 1), np.repeat(widths, 3))

    def read(
        self, reader: ColumnReader, choices: Int64, sigmas: Float64, references: Float32 | None
    ) -> Int64:
        """[N, 3] whole numbers."""
        widths = choices % (ABSOLUTE_BITS + 1)
        low = reader.bits(3 * len(widths), np.repeat(widths, 3)).astype(np.int64).reshape(-1, 3)
        steps, around = self._steps(sigmas), np.zeros(low.shape, np.int64)
        if references is not None:
            scaled = np.clip(references.astype(np.float64) / steps[:, None], -_REACH, _REACH)
            around = np.where(widths[:, None] < ABSOLUTE_BITS, np.rint(scaled), 0).astype(np.int64)
        _complete(low, widths, choices > ABSOLUTE_BITS, steps, around)
        return around

    def _steps(self, sigmas: Float64) -> Float64:
        """[N] powers of two (of a standard deviation of 0: any)."""
        return np.ldexp(1.0, np.frexp(sigmas)[1] - 1 - self.bits)


def _bits_for(room: Float64) -> Int64:
    """[N] bits that tell numbers apart which are up to ``room`` [N, 3] from what is known."""
    most = np.frexp(room.max(axis=1, initial=0) + 2)[1] + 1
    return np.minimum(most, ABSOLUTE_BITS).astype(np.int64)


@njit(cache=True, error_model="numpy", nogil=True)
def _complete(low, widths, follows, steps, around):  # type: ignore[no-untyped-def]
    """The numbers with the lowest bits ``low`` [N, 3] nearest to ``around`` [N, 3], where they are
    left; to the node before for a node that ``follows``.
    """
    mean = np.zeros(3, np.float32)
    for i in range(len(low)):
        whole = np.int64(1) << widths[i]
        half = whole >> 1
        for axis in range(3):
            near = around[i, axis]
            if follows[i]:
                near = np.int64(np.rint(min(max(mean[axis] / steps[i], -_REACH), _REACH)))
            place = near + ((low[i, axis] - near + half) & (whole - 1)) - half
            around[i, axis] = place
            mean[axis] = (place + 0.5) * steps[i]
