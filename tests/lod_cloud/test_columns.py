"""Integers as bits and bytes: what is written is read, and what is not is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lod_cloud.columns import ColumnReader, ColumnWriter
from lod_cloud.protocol import RemoteProtocolError

SIZES = st.integers(0, 31).flatmap(lambda bits: st.integers(0, 2**bits))


@given(st.lists(SIZES, max_size=60), st.integers(0, 2**63 - 1))
def test_integers_of_any_size(numbers: list[int], single: int) -> None:
    values = np.array(numbers, np.int64)
    ids, widths = np.unique(values), np.array([v.bit_length() for v in numbers], np.int64)
    writer = ColumnWriter()
    writer.integers(values)
    writer.ascending(ids)
    writer.varint(single)
    writer.bits(values, widths)
    writer.begin("rows")
    writer.positions(ids)
    reader = ColumnReader(writer.bytes())
    assert np.array_equal(reader.integers(len(values)), values)
    assert np.array_equal(reader.ascending(len(ids)), ids)
    assert reader.varint() == single
    assert np.array_equal(reader.bits(len(values), widths), values)
    assert np.array_equal(reader.positions(2**31 + 1), ids)
    reader.finish()
    assert sum(writer.sizes.values()) == len(writer.bytes())


def test_bytes_are_near_the_information() -> None:
    """A thousand of 40 million ids have 16.7 bits of information each; equal numbers none."""
    ids = np.sort(np.random.default_rng(1).choice(40_000_000, 1000, replace=False))
    writer = ColumnWriter()
    writer.ascending(ids)
    assert 16.7 * 1000 / 8 < len(writer.bytes()) < 17.7 * 1000 / 8
    equal = ColumnWriter()
    equal.integers(np.full(1000, 2))
    assert len(equal.bytes()) == 2


@given(st.binary(max_size=60), st.integers(0, 1000))
def test_any_bytes_are_read_or_refused(data: bytes, count: int) -> None:
    for read in ("integers", "ascending", "positions"):
        try:
            found = getattr(ColumnReader(data), read)(count)
        except RemoteProtocolError:
            continue
        assert (np.diff(found) > 0).all() or read == "integers"


def test_refusals_say_what_must_be_what() -> None:
    with pytest.raises(RemoteProtocolError, match="at most 63 bits"):
        ColumnReader(b"\xff" * 12).varint()
    with pytest.raises(RemoteProtocolError, match="at most 67108864 integers"):
        ColumnReader(b"\x00\xff").integers(2**40)
    with pytest.raises(RemoteProtocolError, match="0 to 32 bits"):
        ColumnReader(b"\x00" * 9).bits(1, 33)
    writer = ColumnWriter()
    writer.positions(np.array([4]))
    with pytest.raises(RemoteProtocolError, match="must ascend and be below 4"):
        ColumnReader(writer.bytes()).positions(4)
