"""Arrays of integers as bytes.

Two families: one plane per byte of the number (``plain``, ``differences``), in which an entropy
coder finds likeness; and strings of bits (``bits``, ``integers``, ``ascending``), which are as
short as they get. Bits fill bytes from the lowest up.

``integers`` are written in the exponential Golomb code of the order that suits them best
(doi:10.1109/TIT.1975.1055349 has the code of order 0): number v as x = v - least + 2^k of n bits,
n - 1 - k zeros and a one, then the n - 1 lower bits of x.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from lod_cloud.protocol import RemoteProtocolError

Int64 = NDArray[np.int64]

_MOST_BITS = 32  # of a number in ``bits``, and of one in ``integers`` after the least is taken off
_MOST_INTEGERS = 1 << 26  # of a column; equal ones take no bits
_ALL_EQUAL = 255  # instead of an order


def varint(value: int) -> bytes:
    """An integer >= 0 in groups of 7 bits, lowest first; the eighth says that more follow."""
    data = bytearray()
    while value >= 128:
        data.append(value & 127 | 128)
        value >>= 7
    data.append(value)
    return bytes(data)


class ColumnWriter:
    """Collects columns; the reader must ask for them in the same order with the same lengths."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self.sizes: dict[str, int] = {}  # bytes by the names given to `begin`
        self._name = ""

    def begin(self, name: str) -> None:
        """What follows is to be counted under ``name``."""
        self._name = name

    def raw(self, data: bytes) -> None:
        """Bytes as they are."""
        self._parts.append(data)
        self.sizes[self._name] = self.sizes.get(self._name, 0) + len(data)

    def plain(self, values: NDArray[Any]) -> None:
        """Byte planes, most significant last, of an array of any shape (columns of it one by
        one).
        """
        columns = np.ascontiguousarray(values.reshape(len(values), math.prod(values.shape[1:])).T)
        as_bytes = columns.view(np.uint8).reshape(*columns.shape, values.itemsize)
        self.raw(np.ascontiguousarray(np.moveaxis(as_bytes, 2, 1)).tobytes())

    def differences(self, values: NDArray[Any]) -> None:
        """Byte planes of the differences along the first axis, modulo the width of the type."""
        unsigned = np.ascontiguousarray(values).view(f"u{values.itemsize}")
        self.plain(np.diff(unsigned, axis=0, prepend=np.zeros_like(unsigned[:1])))

    def varint(self, value: int) -> None:
        """One integer >= 0."""
        self.raw(varint(value))

    def bits(self, values: NDArray[Any], widths: NDArray[Any] | int) -> None:
        """The lowest ``widths`` bits of each number of an array of any shape."""
        flat = values.reshape(-1).astype(np.uint64)
        places = np.arange(int(np.max(widths, initial=0)), dtype=np.uint8)
        every = (flat[:, None] >> places.astype(np.uint64) & np.uint64(1)).astype(np.uint8)
        wide = np.broadcast_to(np.reshape(widths, (-1, 1)), (len(flat), 1))
        self.raw(np.packbits(every[places < wide], bitorder="little").tobytes())

    def integers(self, values: NDArray[Any]) -> None:
        """Integers >= 0, mostly near the least of them."""
        if not len(values):
            return
        least = int(values.min())
        rest = values.astype(np.int64) - least
        self.varint(least)
        if not rest.any():
            self.raw(bytes([_ALL_EQUAL]))
            return
        order = _best_order(rest)
        x = rest + (1 << order)
        zeros = _bit_lengths(x) - 1 - order
        prefix = np.zeros(int(zeros.sum()) + len(zeros), np.uint8)
        prefix[np.cumsum(zeros + 1) - 1] = 1
        packed = np.packbits(prefix, bitorder="little").tobytes()
        self.raw(bytes([order]) + varint(len(packed)) + packed)
        self.bits(x, zeros + order)

    def signed(self, values: Int64) -> None:
        """Integers, mostly near 0."""
        self.integers((values << 1) ^ (values >> 63))

    def ascending(self, ids: NDArray[Any]) -> None:
        """Integers >= 0, each above the one before."""
        self.integers(np.diff(ids.astype(np.int64), prepend=-1) - 1)

    def positions(self, rows: NDArray[Any]) -> None:
        """Some rows of a table, ascending; mostly none."""
        self.varint(len(rows))
        self.ascending(rows)

    def bytes(self) -> bytes:
        """Everything written so far."""
        return b"".join(self._parts)


class ColumnReader:
    """Reads what a `ColumnWriter` wrote; raises RemoteProtocolError when the bytes do not
    suffice.
    """

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._position = 0

    def expect(self, size: int) -> None:
        """Raises RemoteProtocolError unless so many bytes follow."""
        left = len(self._data) - self._position
        if left < size:
            raise RemoteProtocolError(f"message must hold {size} more bytes, but {left} are left")

    def raw(self, size: int) -> bytes:
        self.expect(size)
        data = self._data[self._position : self._position + size]
        self._position += size
        return data

    def plain(self, dtype: DTypeLike, count: int, columns: int = 1) -> NDArray[Any]:
        """[count] or, for several columns, [count, columns]."""
        kind = np.dtype(dtype)
        planes = np.frombuffer(self.raw(count * columns * kind.itemsize), np.uint8)
        planes = np.moveaxis(planes.reshape(columns, kind.itemsize, count), 1, 2)
        values = np.ascontiguousarray(planes).view(kind).reshape(columns, count)
        return values[0] if columns == 1 else np.ascontiguousarray(values.T)

    def differences(self, dtype: DTypeLike, count: int, columns: int = 1) -> NDArray[Any]:
        kind = np.dtype(dtype)
        steps = self.plain(f"u{kind.itemsize}", count, columns)
        return np.cumsum(steps, axis=0, dtype=steps.dtype).view(kind)

    def rest(self) -> bytes:
        """All that is left."""
        return self.raw(len(self._data) - self._position)

    def ahead(self) -> memoryview:
        """All that is left, without reading it."""
        return memoryview(self._data)[self._position :]

    def varint(self) -> int:
        value = shift = 0
        while True:
            byte = self.raw(1)[0]
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value
            if shift > 63:
                raise RemoteProtocolError("an integer must have at most 63 bits")

    def bits(self, count: int, widths: NDArray[Any] | int) -> NDArray[np.uint32]:
        """[count] numbers of the given numbers of bits each, at most 32."""
        wide = np.broadcast_to(np.asarray(widths, np.int64), count)
        if count and not 0 <= wide.min() <= wide.max() <= _MOST_BITS:
            raise RemoteProtocolError(f"a number must have 0 to {_MOST_BITS} bits")
        total = int(wide.sum())
        data = np.frombuffer(self.raw(-(-total // 8)), np.uint8)
        stream = np.unpackbits(data, count=total, bitorder="little")
        places = np.arange(int(wide.max(initial=0)))
        inside = places < wide[:, None]
        every = np.zeros(inside.shape, np.uint64)
        every[inside] = stream
        return (every << places.astype(np.uint64)).sum(axis=1).astype(np.uint32)

    def integers(self, count: int) -> Int64:
        if count == 0:
            return np.empty(0, np.int64)
        if count > _MOST_INTEGERS:
            raise RemoteProtocolError(f"a column must have at most {_MOST_INTEGERS} integers")
        least, order = self.varint(), self.raw(1)[0]
        if least >> _MOST_BITS:
            raise RemoteProtocolError(f"an integer must have at most {_MOST_BITS} bits")
        if order == _ALL_EQUAL:
            return np.full(count, least, np.int64)
        prefix = np.unpackbits(np.frombuffer(self.raw(self.varint()), np.uint8), bitorder="little")
        ends = np.flatnonzero(prefix)
        if len(ends) != count or order >= _MOST_BITS:
            raise RemoteProtocolError(f"a column must have {count} integers, not {len(ends)}")
        widths = np.diff(ends, prepend=-1) - 1 + order
        lower = self.bits(count, widths).astype(np.int64)
        return lower + (np.int64(1) << widths) - (1 << order) + least

    def signed(self, count: int) -> Int64:
        values = self.integers(count)
        return (values >> 1) ^ -(values & 1)

    def ascending(self, count: int) -> Int64:
        """Raises RemoteProtocolError for numbers of more than 32 bits."""
        ids = np.cumsum(self.integers(count) + 1) - 1
        if count and not 0 <= ids[-1] < 1 << _MOST_BITS:
            raise RemoteProtocolError(f"ids must have at most {_MOST_BITS} bits")
        return ids

    def positions(self, count: int) -> Int64:
        """Rows below ``count``. Raises RemoteProtocolError for others."""
        rows = self.ascending(self.varint())
        if len(rows) and rows[-1] >= count:
            raise RemoteProtocolError(f"rows must ascend and be below {count}")
        return rows

    def finish(self) -> None:
        """Raises RemoteProtocolError unless everything was read."""
        if self._position != len(self._data):
            left = len(self._data) - self._position
            raise RemoteProtocolError(f"message must end here, but {left} bytes follow")


def _bit_lengths(values: Int64) -> Int64:
    """Of integers 1..2^52."""
    return np.frexp(values.astype(np.float64))[1].astype(np.int64)


def _best_order(values: Int64) -> int:
    """The order whose code of these integers is shortest."""
    orders = range(int(values.max()).bit_length() + 1)
    sizes = [int((2 * _bit_lengths(values + (1 << k)) - 1 - k).sum()) for k in orders]
    return int(np.argmin(sizes))
