"""Codes of everything but the harmonics above degree 0, and the columns in which they travel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lod_cloud.codec.harmonic_rests import RESTS
from lod_cloud.codec.positions import CHOICES
from lod_cloud.codec.rans import MOST_SYMBOLS
from lod_cloud.codec.shapes import BYTE, ROTATION, SPHERE, WIDE

Mask = NDArray[np.bool_]
Column = NDArray[Any]  # [N] whole numbers

_AXES = 4
_BYTES, _TURNS = BYTE + 1, ROTATION + 1
_MOST_BITS = MOST_SYMBOLS.bit_length() - 1
_DEGREES = 3
_COARSE = 8  # contexts that a code gives, by its three highest bits


class Coder(Protocol):
    """What one column of a payload goes through: counted, pushed or pulled."""

    def __call__(
        self, key: str, shape: tuple[int, int], contexts: Column, values: Column | None, /
    ) -> Column:
        """The symbols [N] of column ``key`` in ``contexts`` [N]; they are ``values`` where these
        are known. ``shape``: number of contexts, of symbols.
        """


@dataclass(frozen=True)
class Rows:
    """What both ends know of nodes [N] before they code them."""

    inner: Mask  # not leaves
    siblings: Mask  # child of the same parent as the node before
    below: Mask  # child of a node that the client holds

    @classmethod
    def of(cls, inner: Mask, parents: Column, references: Column | None) -> Rows:
        """Nodes as they travel, and the nodes held that they may be told from."""
        below = np.zeros(len(inner), np.bool_) if references is None else references == parents
        return cls(inner, np.diff(parents, prepend=-2) == 0, below)

    def take(self, some: Mask) -> Rows:
        """Of some of the nodes; a node that is left out is before others all the same."""
        return Rows(self.inner[some], self.siblings[some], self.below[some])


class _Columns:
    """Calls a coder for one column after the other. A column's contexts follow from the columns
    before it; no column depends on another payload.
    """

    def __init__(self, code: Coder, rows: Rows, given: Mapping[str, Column] | None = None) -> None:
        self._code, self._given = code, given
        self.values: dict[str, Column] = {}
        self._inner = rows.inner.astype(np.int64)
        self._place = self._inner + 2 * rows.siblings
        self._rows = rows

    def plain(self, key: str, symbols: int, contexts: Column, count: int) -> Column:
        """Values below ``symbols`` in one of ``count`` contexts."""
        given = None if self._given is None else self._given[key]
        self.values[key] = self._code(key, (count, symbols), contexts, given)
        return self.values[key].astype(np.int64)

    def stepped(self, key: str, symbols: int) -> Column:
        """Differences to the node before, modulo ``symbols``; by whether the two are siblings."""
        given = None
        if self._given is not None:
            steps: Column = np.diff(self._given[key].astype(np.int64), prepend=0)
            given = steps % symbols
        steps = self._code(key, (4, symbols), self._place, given)
        self.values[key] = np.cumsum(steps, dtype=np.int64) % symbols
        return self.values[key]

    def shape(self) -> None:
        """Scales and rotation."""
        inner = self._inner
        self.stepped("scale.0", WIDE + 1)
        ratio = self.plain("scale.1", _BYTES, inner, 2)
        self.plain("scale.2", _BYTES, inner + 2 * _coarse(ratio, _BYTES), 2 * _COARSE)
        axis = self.plain("rotation.axis", _AXES, inner, 2)
        one = self.plain("rotation.0", _TURNS, inner + 2 * axis, 2 * _AXES)
        two = self.plain("rotation.1", _TURNS, self._turned(one, axis), _COARSE * _AXES)
        self.plain("rotation.2", _TURNS, self._turned(two, axis), _COARSE * _AXES)

    @staticmethod
    def _turned(before: Column, axis: Column) -> Column:
        """Contexts that the component before gives."""
        return _coarse(before, _TURNS) + _COARSE * axis

    def look(self, colours: int) -> None:
        """Opacity, and green and what red and blue differ from it by."""
        self.plain("opacity", WIDE + 1, self._inner, 2)
        for key in ("colour.green", "colour.red", "colour.blue"):
            self.stepped(key, colours)

    def spheres(self) -> None:
        """Of inner nodes."""
        radius = self.plain("spheres.radius", SPHERE + 1, self._inner[self._rows.inner] * 0, 1)
        self.plain("spheres.extent", SPHERE + 1, radius, SPHERE + 1)

    def position(self) -> None:
        """How the lowest bits of a position are to be read."""
        self.plain("position", CHOICES, self._place + 4 * self._rows.below, 8)


@dataclass(frozen=True)
class Layout:
    """All columns of a payload."""

    colours: int  # codes of a channel
    words: tuple[tuple[int, int], ...]  # of every stage: symbols, lowest bits that are none
    dimensions: int  # coefficients above degree 0

    @classmethod
    def of(cls, colours: int, sizes: Sequence[int], dimensions: int) -> Layout:
        """For stages of so many words; the lowest bits of large numbers travel as they are."""
        lows = [max(0, (size - 1).bit_length() - _MOST_BITS) for size in sizes]
        split = [(((size - 1) >> low) + 1, low) for size, low in zip(sizes, lows, strict=True)]
        return cls(colours, tuple(split), dimensions)

    def high_parts(self, words: NDArray[np.uint16]) -> dict[str, Column]:
        """What of words [N, stages] are symbols."""
        return {f"harmonics.{i}": words[:, i] >> low for i, (_, low) in enumerate(self.words)}

    def fields(
        self, code: Coder, rows: Rows, given: Mapping[str, Column] | None
    ) -> dict[str, Column]:
        """All columns of nodes but those of the harmonics above degree 0."""
        columns = _Columns(code, rows, given)
        columns.shape()
        columns.look(self.colours)
        columns.spheres()
        columns.position()
        return columns.values

    def harmonics(
        self, code: Coder, inner: Mask, given: Mapping[str, Column] | None
    ) -> dict[str, Column]:
        """Words of nodes, one column for each stage of the codebook; and what they leave over of
        every coefficient of leaves, by its degree.
        """
        values = {}
        for stage, (symbols, _) in enumerate(self.words):
            key = f"harmonics.{stage}"
            known = None if given is None else given[key]
            values[key] = code(key, (2, symbols), inner.astype(np.int64), known)
        if self.words:
            degrees = np.sqrt(np.arange(self.dimensions) // 3 + 1).astype(np.int64)  # 1, 2, 3
            key, known = "harmonics.rest", None if given is None else given["harmonics.rest"]
            contexts = np.tile(degrees - 1, int(np.count_nonzero(~inner)))
            values[key] = code(key, (_DEGREES, RESTS), contexts, known)
        return values

    def shapes(self) -> dict[str, tuple[int, int]]:
        """Number of contexts and of symbols of every column."""
        shapes = {}

        def note(key: str, shape: tuple[int, int], _: Column, __: Column | None, /) -> Column:
            shapes[key] = shape
            return np.empty(0, np.int64)

        nothing = np.zeros(0, np.bool_)
        self.fields(note, Rows(nothing, nothing, nothing), None)
        self.harmonics(note, nothing, None)
        return shapes


def _coarse(values: Column, symbols: int) -> Column:
    return values // (symbols // _COARSE)
