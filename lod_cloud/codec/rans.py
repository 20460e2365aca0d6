"""Entropy coding with static frequencies: range asymmetric numeral systems (rANS).

A whole number holds the message. A symbol of frequency f of 4096, with those before it in the
alphabet adding up to b, makes x into (x // f) 4096 + b + x mod f, so x grows by about as many bits
as the symbol carries; the receiver finds the symbol from x mod 4096 and undoes the step (Duda 2013,
arXiv:1311.2540). Here x stays in 2^16..2^32: what grows beyond that leaves as 16-bit words. Symbols
are pushed in reverse, so that they and the words come back in order. The last symbol pulled must
leave the x that pushing began with: what is cut off is always found out, what is changed mostly
(messages have a checksum of 64 bits besides).

All columns of a payload share one x. A column's symbols are pushed with the frequencies of one of
several contexts each.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.errors import InputError
from lod_cloud.columns import ColumnReader, ColumnWriter
from lod_cloud.protocol import RemoteProtocolError

UInt16 = NDArray[np.uint16]

BITS = 12  # of the sum of all frequencies of a context
MOST_SYMBOLS = 1 << 10  # of an alphabet: rare ones must stay cheap
_WORD_BITS = 16
_SUM = 1 << BITS
_LOW = 1 << _WORD_BITS
_TOP_SHIFT = 2 * _WORD_BITS - BITS
_PRIOR = 64  # symbols of the whole column that every context counts besides its own


@dataclass(frozen=True)
class Frequencies:
    """[contexts, symbols] of 4096, at least 1 each: no symbol cannot be coded."""

    table: UInt16

    def __post_init__(self) -> None:
        table = self.table
        right = table.ndim == 2 and 1 <= table.shape[1] <= MOST_SYMBOLS and len(table)
        if not right or table.min() < 1 or (table.sum(axis=1, dtype=np.int64) != _SUM).any():
            raise InputError(
                f"frequencies of 1 to {MOST_SYMBOLS} symbols must be at least 1 and add up to "
                f"{_SUM} in every context"
            )

    @classmethod
    def counted(
        cls, symbols: NDArray[Any], contexts: NDArray[Any], shape: tuple[int, int]
    ) -> Frequencies:
        """From symbols [N] seen in contexts [N]. ``shape``: contexts, symbols.

        Contexts seen rarely lean on what the whole column shows, symbols on all being possible.
        """
        cells = contexts.astype(np.int64) * shape[1] + symbols
        seen = np.bincount(cells, minlength=shape[0] * shape[1]).reshape(shape)
        every = seen.sum(axis=0) * _PRIOR + 1
        weights = seen * int(every.sum()) + every * _PRIOR
        return cls(_quantised(weights))

    @classmethod
    def of(cls, rows: Any) -> Frequencies:
        """From lists of whole numbers, by context. Raises InputError for anything else."""
        table = np.array(rows)
        if table.dtype != np.int64 or (table.size and not 0 <= table.min() <= table.max() <= _SUM):
            raise InputError(f"frequencies must be whole numbers of at most {_SUM}")
        return cls(table.astype(np.uint16))

    @cached_property
    def starts(self) -> UInt16:
        """[contexts, symbols] sums of the frequencies before."""
        return (np.cumsum(self.table, axis=1, dtype=np.int64) - self.table).astype(np.uint16)

    @cached_property
    def symbols(self) -> UInt16:
        """[contexts, 4096] which symbol a number below 4096 stands for."""
        every = np.arange(self.table.shape[1], dtype=np.uint16)
        return np.array([np.repeat(every, row) for row in self.table])


def _quantised(weights: NDArray[np.int64]) -> UInt16:
    """Frequencies near these weights > 0, row by row; whole numbers throughout, the same
    everywhere.
    """
    parts, totals = weights * _SUM, weights.sum(axis=1, keepdims=True)
    found = np.maximum(1, parts // totals)
    rest = np.where(parts >= totals, parts % totals, -1)
    for row, left, missing in zip(found, rest, _SUM - found.sum(axis=1), strict=True):
        row[np.argsort(-left, kind="stable")[: max(0, missing)]] += 1
        for _ in range(-missing):
            row[row.argmax()] -= 1
    return found.astype(np.uint16)


class Pusher:
    """Collects columns of symbols and codes them together."""

    def __init__(self) -> None:
        self._columns: list[tuple[str, Frequencies, UInt16, UInt16]] = []

    def add(
        self, name: str, frequencies: Frequencies, symbols: NDArray[Any], contexts: NDArray[Any]
    ) -> None:
        """One column, whose bytes count under ``name``: symbols [N] in contexts [N]."""
        symbols = np.ascontiguousarray(symbols, np.uint16)
        self._columns.append((name, frequencies, symbols, contexts.astype(np.uint16)))

    def write(self, writer: ColumnWriter) -> None:
        """State and words; nothing for no symbols."""
        words = np.empty(sum(len(symbols) for _, _, symbols, _ in self._columns), np.uint16)
        if not len(words):
            return
        state, at = _LOW, len(words)
        parts = []
        for name, frequencies, symbols, contexts in reversed(self._columns):
            state, begin = _push(
                symbols, contexts, frequencies.table, frequencies.starts, state, words, at
            )
            parts.append((name, words[begin:at]))
            at = begin
        writer.begin(parts[-1][0])
        writer.raw(state.to_bytes(4, "little"))
        for name, part in reversed(parts):
            writer.begin(name)
            writer.raw(part.astype("<u2").tobytes())


class Puller:
    """Gives the columns back in the order in which they were added."""

    def __init__(self, reader: ColumnReader) -> None:
        self._reader = reader
        self._state, self._at = _LOW, 0
        self._words: UInt16 | None = None

    def column(self, frequencies: Frequencies, contexts: NDArray[Any]) -> UInt16:
        """[N] symbols. Raises RemoteProtocolError where words are missing."""
        symbols = np.empty(len(contexts), np.uint16)
        if not len(symbols):
            return symbols
        if self._words is None:
            self._state = int.from_bytes(self._reader.raw(4), "little")
            ahead = self._reader.ahead()
            self._words = np.frombuffer(ahead, "<u2", len(ahead) // 2)
        self._state, self._at = _pull(
            contexts.astype(np.uint16), frequencies.symbols, frequencies.table, frequencies.starts,
            self._state, self._words, self._at, symbols,
        )  # fmt: skip
        if self._at > len(self._words):
            raise RemoteProtocolError("entropy-coded columns must not end before their last symbol")
        return symbols

    def finish(self) -> None:
        """What follows is read after this. Raises RemoteProtocolError unless all was as pushed."""
        if self._state != _LOW:
            raise RemoteProtocolError("entropy-coded columns must end in the state they began with")
        self._reader.raw(2 * self._at)


@njit(cache=True, error_model="numpy", nogil=True)
def _push(symbols, contexts, frequencies, starts, state, words, at):  # type: ignore[no-untyped-def]
    """All symbols [N], the last one first, into ``state`` and ``words`` before ``at``."""
    for i in range(len(symbols) - 1, -1, -1):
        frequency = np.int64(frequencies[contexts[i], symbols[i]])
        if state >= frequency << _TOP_SHIFT:
            at -= 1
            words[at] = state & (_LOW - 1)
            state >>= _WORD_BITS
        whole = state // frequency
        state += whole * (_SUM - frequency) + starts[contexts[i], symbols[i]]
    return state, at


@njit(cache=True, error_model="numpy", nogil=True)
def _pull(contexts, slots, frequencies, starts, state, words, at, symbols):  # type: ignore[no-untyped-def]
    """Symbols [N] from ``state`` and ``words`` from ``at`` on; ends beyond them where they end."""
    for i in range(len(contexts)):
        slot = state & (_SUM - 1)
        symbol = slots[contexts[i], slot]
        symbols[i] = symbol
        frequency = np.int64(frequencies[contexts[i], symbol])
        state = frequency * (state >> BITS) + slot - starts[contexts[i], symbol]
        if state < _LOW:
            if at >= len(words):
                return state, at + 1
            state = (state << _WORD_BITS) | np.int64(words[at])
            at += 1
    return state, at
