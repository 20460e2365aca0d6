"""The search arrays of a tree on disk: written block by block, and compared with the tree."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from gaussians.parallel import run_chunks
from lod_cloud.array_file import ArrayFile
from lod_cloud.lod_tree import LodTree
from lod_cloud.search_arrays import (
    GROUP,
    GROUP_ROWS,
    RECORD_COLUMNS,
    SearchArrays,
    number_of_groups,
    put_groups,
    put_records,
)

SEARCH_FILES = ("search_groups", "search_records")  # arrays on disk, as in `SearchArrays`
_SOURCES = ("means", "radius", "extent", "child_count", "first_child", "parent")
_BLOCK_NODES = GROUP << 14  # 8 MB of records: what is written so is cached in pages of 2 MB


def search_array_shapes(nodes: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Shapes of both arrays of a tree of so many nodes."""
    return (number_of_groups(nodes), GROUP_ROWS, GROUP), (nodes, RECORD_COLUMNS)


def write_search_arrays(files: dict[str, ArrayFile], nodes: int) -> None:
    """Fill both arrays, which are among the files, from the others; memory is that of a block."""

    def write(begin: int, end: int) -> None:
        for block in range(begin, end):
            first, last = block * _BLOCK_NODES, min((block + 1) * _BLOCK_NODES, nodes)
            made = _search_rows(*(_rows(files[name], first, last) for name in _SOURCES))
            groups, records = (files[name] for name in SEARCH_FILES)
            groups.write(first // GROUP, made.groups)
            records.write(first, made.records)

    run_chunks(write, -(-nodes // _BLOCK_NODES))


def compare_search_arrays(source: Path, tree: LodTree) -> None:
    """Raise InputError unless the stored arrays of a tree follow from its others."""
    if tree.search_arrays is None:
        return
    holders = (tree.gaussians, tree, tree, tree, tree, tree)
    for first in range(0, len(tree), _BLOCK_NODES):
        rows = slice(first, first + _BLOCK_NODES)
        wanted = _search_rows(
            *(getattr(holder, name)[rows] for holder, name in zip(holders, _SOURCES, strict=True))
        )
        starts = (first // GROUP, first)
        for name, stored, made, start in zip(
            SEARCH_FILES, tree.search_arrays, wanted, starts, strict=True
        ):
            found = stored[start : start + len(made)]
            if not np.array_equal(found.view(np.int32), made.view(np.int32)):
                raise InputError(f"{source / f'{name}.npy'}: must follow from the other arrays")


def _rows(file: ArrayFile, begin: int, end: int) -> NDArray[Any]:
    rows = file.read(begin, end)
    return rows if rows.shape[1] > 1 else rows[:, 0]


def _search_rows(*sources: NDArray[Any]) -> SearchArrays:
    """Both arrays of consecutive nodes, the first of which begins a group."""
    shapes = search_array_shapes(len(sources[0]))
    made = SearchArrays(*(np.empty(shape, np.float32) for shape in shapes))
    put_groups(made.groups, *sources[:4])
    put_records(made.records, *sources)
    return made
