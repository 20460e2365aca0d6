"""Arrays of integers as bytes: one plane per byte of the number, so that an entropy coder finds
likeness.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from lod_cloud.protocol import RemoteProtocolError


class ColumnWriter:
    """Collects columns; the reader must ask for them in the same order with the same lengths."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []

    def raw(self, data: bytes) -> None:
        """Bytes as they are."""
        self._parts.append(data)

    def plain(self, values: NDArray[Any]) -> None:
        """Byte planes, most significant last, of an array of any shape (columns of it one by
        one).
        """
        columns = np.ascontiguousarray(values.reshape(len(values), math.prod(values.shape[1:])).T)
        as_bytes = columns.view(np.uint8).reshape(*columns.shape, values.itemsize)
        self._parts.append(np.ascontiguousarray(np.moveaxis(as_bytes, 2, 1)).tobytes())

    def differences(self, values: NDArray[Any]) -> None:
        """Byte planes of the differences along the first axis, modulo the width of the type."""
        unsigned = np.ascontiguousarray(values).view(f"u{values.itemsize}")
        self.plain(np.diff(unsigned, axis=0, prepend=np.zeros_like(unsigned[:1])))

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

    def raw(self, size: int) -> bytes:
        data = self._data[self._position : self._position + size]
        if len(data) != size:
            raise RemoteProtocolError(
                f"message must hold {size} more bytes, but {len(data)} are left"
            )
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

    def finish(self) -> None:
        """Raises RemoteProtocolError unless everything was read."""
        if self._position != len(self._data):
            left = len(self._data) - self._position
            raise RemoteProtocolError(f"message must end here, but {left} bytes follow")
