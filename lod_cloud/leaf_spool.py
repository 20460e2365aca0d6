"""Leaves that arrive in pieces and need not fit in memory: on disk until their tree is built."""

from __future__ import annotations

import mmap
from pathlib import Path

import numpy as np

from gaussians.errors import InputError
from gaussians.scene import FIELDS, Scene
from lod_cloud.array_file import ArrayFile


class LeafSpool:
    """A scene of known size in a folder, filled piece by piece, read back memory-mapped.

    Pieces should be neighbours in space: a tree is built fastest from leaves that are nearly in
    its own order. Owns the folder's files, not the folder.
    """

    def __init__(self, folder: Path, count: int, sh_degree: int) -> None:
        shapes = ((3,), (4,), (3,), (), ((sh_degree + 1) ** 2, 3))
        self._files = [
            ArrayFile(folder / f"{name}.npy", (count, *shape), np.float32)
            for name, shape in zip(FIELDS, shapes, strict=True)
        ]
        self._count, self._filled = count, 0
        self._maps: list[np.memmap] = []

    def __enter__(self) -> LeafSpool:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """No more leaves."""
        for file in self._files:
            file.close()

    @property
    def seconds(self) -> float:
        """Spent writing."""
        return sum(file.seconds for file in self._files)

    def append(self, piece: Scene) -> None:
        """Add leaves behind those that are there. Raises InputError when there is no room."""
        end = self._filled + len(piece)
        if end > self._count:
            raise InputError(f"a spool of {self._count} leaves must not be given {end}")
        for name, file in zip(FIELDS, self._files, strict=True):
            file.write(self._filled, getattr(piece, name))
        self._filled = end

    def scene(self) -> Scene:
        """All leaves, memory-mapped. Raises InputError unless the spool is full."""
        if self._filled != self._count:
            raise InputError(f"a spool must hold {self._count} leaves, not {self._filled}")
        self.close()
        self._maps = [np.lib.format.open_memmap(file.path, mode="r+") for file in self._files]
        return Scene(*(np.asarray(array) for array in self._maps))

    def release(self) -> None:
        """Let go of the memory that reading `scene` took; its values stay."""
        for array in self._maps:
            array._mmap.madvise(mmap.MADV_DONTNEED)  # type: ignore[attr-defined]
