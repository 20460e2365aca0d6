"""A .npy file that is filled in blocks of rows and never held in memory."""

from __future__ import annotations

import math
import mmap
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


class ArrayFile:
    """A .npy file of known shape, [N, ...], written and read back in blocks of rows.

    Blocks may be written by several threads. Owns the seconds spent in the file system.
    """

    def __init__(self, path: Path, shape: tuple[int, ...], dtype: DTypeLike) -> None:
        self.path, self.dtype = path, np.dtype(dtype)
        self._shape, self._width = shape[1:], math.prod(shape[1:])
        with path.open("wb") as file:
            header = {
                "descr": np.lib.format.dtype_to_descr(self.dtype),
                "fortran_order": False,
                "shape": shape,
            }
            np.lib.format.write_array_header_1_0(file, header)
            self._start = file.tell()
            _allocate(file.fileno(), self._start + self.dtype.itemsize * math.prod(shape))
        self._file = path.open("r+b", buffering=0)
        self._buffers = threading.local()
        self._lock = threading.Lock()
        self.seconds = 0.0  # of all threads together

    def read(self, begin: int, end: int) -> NDArray[Any]:
        """[end - begin, K] a copy that the next ``read`` of this thread overwrites."""
        rows = self._buffer("read", end - begin)
        data = rows.reshape(-1).view(np.uint8).data
        offset = self._offset(begin)
        with self._timed():
            while len(data):
                got = os.preadv(self._file.fileno(), [data], offset)
                data, offset = data[got:], offset + got
        return rows

    def target(self, begin: int, end: int) -> NDArray[Any]:
        """[end - begin, ...] memory that the next ``target`` of this thread overwrites."""
        return self._buffer("target", end - begin).reshape(end - begin, *self._shape)

    def write(self, begin: int, rows: NDArray[Any]) -> None:
        """Put rows (of this file's type, in C order) where they belong."""
        data = np.ascontiguousarray(rows, self.dtype).reshape(-1).view(np.uint8).data
        offset = self._offset(begin)
        with self._timed():
            while len(data):
                written = os.pwrite(self._file.fileno(), data, offset)
                data, offset = data[written:], offset + written

    def mapped(self) -> NDArray[Any]:
        """The whole array, memory-mapped; changes to it stay in memory."""
        return np.asarray(np.load(self.path, mmap_mode="c", allow_pickle=False))

    def close(self) -> None:
        self._file.close()

    def _offset(self, row: int) -> int:
        return self._start + row * self._width * self.dtype.itemsize

    def _buffer(self, use: str, count: int) -> NDArray[Any]:
        held = getattr(self._buffers, use, None)
        if held is None or len(held) < count:
            held = np.empty((count, self._width), self.dtype)
            setattr(self._buffers, use, held)
        return held[:count]

    @contextmanager
    def _timed(self) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        with self._lock:
            self.seconds += time.perf_counter() - begin


def _allocate(file: int, size: int) -> None:
    """Make a file this long. A full disk is noticed here, and filling reserved blocks took ext4 a
    tenth of the time that filling a hole takes.
    """
    if size and hasattr(os, "posix_fallocate"):  # not on every platform
        os.posix_fallocate(file, 0, size)
    else:
        os.truncate(file, size)


def release_pages(array: NDArray[Any]) -> None:
    """Let go of the pages of a memory-mapped array, and of changes to it; nothing for another one.

    The array stays as it is on disk: what is read of it again is mapped again.
    """
    _advise(array, "MADV_DONTNEED")


def advise_huge_pages(array: NDArray[Any]) -> None:
    """Have a memory-mapped array mapped in pages of 2 MB where the system caches it so: reads in
    no particular order then wait less for addresses; nothing for another array.
    """
    with suppress(OSError):  # of a kernel that knows no such pages
        _advise(array, "MADV_HUGEPAGE")


def _advise(array: NDArray[Any], advice: str) -> None:
    base: Any = array
    while base is not None and not isinstance(base, mmap.mmap):
        base = getattr(base, "base", None)
    if base is not None and hasattr(mmap, advice):  # not on every platform
        base.madvise(getattr(mmap, advice))
