"""Entropy coding: what is pushed is pulled, in no more bytes than it must, and damage is found."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gaussians.errors import InputError
from lod_cloud.codec.rans import MOST_SYMBOLS, Frequencies, Puller, Pusher
from lod_cloud.columns import ColumnReader, ColumnWriter
from lod_cloud.protocol import RemoteProtocolError

Made = tuple[Frequencies, np.ndarray, np.ndarray]


def column(rng: np.random.Generator, count: int, shape: tuple[int, int]) -> Made:
    """Frequencies, symbols and contexts; some symbols are rarer than they were in the sample."""
    contexts, symbols = shape
    sample = np.minimum(rng.geometric(0.2, 300), symbols) - 1
    frequencies = Frequencies.counted(sample, rng.integers(0, contexts, 300), shape)
    values = np.minimum(rng.geometric(rng.choice([0.01, 0.2, 0.9]), count), symbols) - 1
    return frequencies, values, rng.integers(0, contexts, count)


def pushed(columns: list[Made]) -> tuple[bytes, dict[str, int]]:
    writer, pusher = ColumnWriter(), Pusher()
    for number, (frequencies, symbols, contexts) in enumerate(columns):
        pusher.add(str(number), frequencies, symbols, contexts)
    pusher.write(writer)
    return writer.bytes(), writer.sizes


def pulled(data: bytes, columns: list[Made]) -> list[np.ndarray]:
    reader = ColumnReader(data)
    puller = Puller(reader)
    found = [puller.column(frequencies, contexts) for frequencies, _, contexts in columns]
    puller.finish()
    reader.finish()
    return found


@given(
    st.lists(st.tuples(st.integers(0, 40), st.integers(1, 3), st.integers(1, 400)), max_size=5),
    st.integers(0, 999),
)
def test_what_is_pushed_is_pulled(sizes: list[tuple[int, int, int]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    columns = [column(rng, count, (contexts, symbols)) for count, contexts, symbols in sizes]
    data, by_name = pushed(columns)
    assert sum(by_name.values()) == len(data)
    for found, (_, symbols, _) in zip(pulled(data, columns), columns, strict=True):
        assert np.array_equal(found, symbols)


def test_bytes_are_those_of_the_frequencies() -> None:
    rng = np.random.default_rng(3)
    frequencies, _, contexts = column(rng, 20_000, (3, 256))
    shares = frequencies.table[contexts] / 4096
    symbols = (shares.cumsum(axis=1) < rng.random((20_000, 1))).sum(axis=1)
    bits = -np.log2(shares[np.arange(20_000), symbols]).sum()
    data, _ = pushed([(frequencies, symbols, contexts)])
    assert 0.999 * bits <= 8 * len(data) <= 1.001 * bits + 48


def test_nothing_takes_no_bytes_and_the_only_symbol_of_an_alphabet_none_but_the_state() -> None:
    rng = np.random.default_rng(1)
    assert pushed([column(rng, 0, (2, 9))])[0] == b""
    assert len(pushed([column(rng, 500, (2, 1))])[0]) == 4


def test_symbols_that_no_sample_showed_can_be_coded() -> None:
    seen = Frequencies.counted(np.zeros(50_000, np.int64), np.zeros(50_000, np.int64), (2, 256))
    assert seen.table.min() == 1
    assert seen.table[0, 0] == seen.table[1, 0] == 4096 - 255
    symbols = np.arange(256)
    made = (seen, symbols, symbols % 2)
    assert np.array_equal(pulled(pushed([made])[0], [made])[0], symbols)


def test_frequencies_are_near_the_shares() -> None:
    """Of two contexts, one seen often, one never, which leans on the column."""
    rng = np.random.default_rng(2)
    symbols = rng.choice(4, 40_000, p=[0.5, 0.25, 0.125, 0.125])
    table = Frequencies.counted(symbols, np.zeros(40_000, np.int64), (2, 4)).table
    for row in table:
        assert np.abs(row / 4096 - [0.5, 0.25, 0.125, 0.125]).max() < 0.01
    assert (table.sum(axis=1) == 4096).all()


def test_truncation_is_refused_and_most_damage() -> None:
    """Truncated anywhere; changed anywhere, mostly, which the checksum of a message finds."""
    columns = [column(np.random.default_rng(seed), 60, (2, 64)) for seed in range(3)]
    data, _ = pushed(columns)
    for size in range(len(data)):
        wrong = "must hold" if size < 4 else "must not end before their last symbol"
        with pytest.raises(RemoteProtocolError, match=wrong):
            pulled(data[:size], columns)
    with pytest.raises(RemoteProtocolError, match="must end here"):
        pulled(data + b"\0", columns)
    refused = 0
    for place in range(len(data)):
        damaged = bytearray(data)
        damaged[place] ^= 0x5A
        try:
            pulled(bytes(damaged), columns)
        except RemoteProtocolError:
            refused += 1
    assert refused >= 0.95 * len(data)


@pytest.mark.parametrize(
    ("rows", "wrong"),
    [
        ([[4096, 0]], "at least 1"),
        ([[2048, 2047]], "add up to 4096"),
        ([[1] * (MOST_SYMBOLS + 1)], f"1 to {MOST_SYMBOLS} symbols"),
        ([4096], "1 to"),
        ([], "whole numbers"),
        ([[2048.0, 2048.0]], "whole numbers"),
        ([[True, True]], "whole numbers"),
        ([[70_000, 1]], "at most 4096"),
        ([[-1, 4097]], "at most 4096"),
        ([["4096"]], "whole numbers"),
    ],
)
def test_frequencies_that_nobody_counted_are_refused(rows: list[object], wrong: str) -> None:
    with pytest.raises(InputError, match=wrong):
        Frequencies.of(rows)
