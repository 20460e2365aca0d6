"""What a codebook's words leave over of leaves, in even steps.

Where many Gaussians are blended the errors of their harmonics average out; one that covers many
pixels shows its own in all of them. Only leaves do: all other nodes of a cut are small on the
display. So leaves are told with words and, coefficient by coefficient, with what these leave over.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.codebook import Codebook
from gaussians.compression import UInt16
from gaussians.errors import InputError
from lod_cloud.codec.training import harmonics
from lod_cloud.lod_tree import Float32, Int32, LodTree

Mask = NDArray[np.bool_]

RESTS = 127  # codes of a coefficient: 63 steps either way
_MOST = (RESTS - 1) // 2
_MOST_STEP = 1e30
_STEP = 1.6  # in root mean squares of what words leave over


@dataclass(frozen=True)
class Told:
    """How the harmonics of nodes [N] are told."""

    by_words: Mask  # [N]; the others by numbers
    rests: NDArray[np.integer]  # [leaves told by words, dimensions] codes


@dataclass(frozen=True)
class HarmonicRests:
    """Raises InputError unless the step is a positive number, and all codes stand for numbers."""

    step: float  # a float32

    def __post_init__(self) -> None:
        if not 0 < self.step <= _MOST_STEP:
            raise InputError(f"the step of harmonics must lie in 0..{_MOST_STEP}, not {self.step}")

    @classmethod
    def train(cls, tree: LodTree, ids: Int32, codebook: Codebook) -> HarmonicRests:
        """From the leaves among nodes ``ids``."""
        wanted = harmonics(tree.gaussians, ids[tree.child_count[ids] == 0])
        left = wanted - codebook.decode(codebook.encode(wanted)[0]).astype(np.float64)
        step = np.float32(_STEP * math.sqrt((left * left).mean())) if len(left) else np.float32(0)
        return cls(float(step) or 1.0)

    def told(
        self, codebook: Codebook, words: UInt16, near: Mask, exact: Float32, inner: Mask
    ) -> Told:
        """Nodes [N] with their words, which are ``near`` enough alone (of no leaf); what the
        harmonics of the others are ``exact``-ly. A leaf more than 63 steps off is told by numbers.
        """
        others = np.flatnonzero(~near)
        codes = np.rint((exact - codebook.decode(words[others]).astype(np.float64)) / self.step)
        fits = (np.abs(codes) <= _MOST).all(axis=1) & ~inner[others]
        by_words = near.copy()
        by_words[others[fits]] = True
        return Told(by_words, codes[fits].astype(np.int64) + _MOST)

    def left_over(self, codes: NDArray[np.integer]) -> Float32:
        """Coefficients for codes."""
        return (codes.astype(np.float32) - np.float32(_MOST)) * np.float32(self.step)
