"""Merging: a right tile's list from the rows of the stereo buffer that hold its entries.

Every row is sorted, so the smallest of their heads is next. Equal heads are one splat that came
along several ways and leaves once.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.parallel import run_chunks
from gaussians.tiling import TileLists, offsets_of


@njit(cache=True, error_model="numpy", nogil=True)
def _merge(
    begin: int,
    end: int,
    starts: NDArray[np.int64],
    ends: NDArray[np.int64],
    fifo: NDArray[np.int32],
    order: NDArray[np.int32],
    tile_offsets: NDArray[np.int64],
    merged: NDArray[np.int32],
    lengths: NDArray[np.int32],
) -> int:
    """Smallest key first, of equal keys the lowest row; returns the duplicates dropped."""
    _tiles_y, tiles_x, rows = starts.shape
    nothing = np.int32(2147483647)
    by_key = order.shape[0] > 0
    heads = np.empty(rows, np.int32)  # what each row shows
    places = np.empty(rows, np.int64)
    duplicates = 0
    for row in range(begin, end):
        for column in range(tiles_x):
            ending = ends[row, column]
            for k in range(rows):
                places[k] = starts[row, column, k]
                heads[k] = fifo[places[k]] if places[k] < ending[k] else nothing
            first_out = out = tile_offsets[row * tiles_x + column]
            while True:
                best, least = nothing, nothing
                for k in range(rows):
                    key = order[heads[k]] if by_key and heads[k] != nothing else heads[k]
                    if key < least:
                        best, least = heads[k], key
                if best == nothing:
                    break
                popped = 0
                for k in range(rows):
                    while heads[k] == best:
                        places[k] += 1
                        heads[k] = fifo[places[k]] if places[k] < ending[k] else nothing
                        popped += 1
                duplicates += popped - 1
                merged[out] = best
                out += 1
            lengths[row, column] = out - first_out
    return duplicates


def merge_rows(
    starts: NDArray[np.int64],
    ends: NDArray[np.int64],
    fifo: NDArray[np.int32],
    depths: NDArray[np.float32] | None = None,
) -> tuple[TileLists, int]:
    """Lists of all right tiles, and how many equal heads were dropped.

    Parameters
    ----------
    starts, ends : [tiles_y, tiles_x, rows] where each list begins and ends in ``fifo``
    fifo : ranks, ascending in each list
    depths : [M] by rank, to merge by depth alone; None merges by rank. One splat in two rows, with
        another of its depth before it in one of them, is then not recognised and stays twice.
    """
    tiles_y, tiles_x, _rows = starts.shape
    order = np.zeros(0, np.int32)
    if depths is not None:  # splats of equal depth bits share the number of their depth
        order = np.cumsum(np.diff(depths, prepend=depths[:1]) > 0, dtype=np.int32)
    offsets = offsets_of((ends - starts).sum(axis=2))
    merged = np.empty(offsets[-1], np.int32)
    lengths = np.empty((tiles_y, tiles_x), np.int32)
    arguments = (starts, ends, fifo, order, offsets, merged, lengths)
    duplicates = sum(run_chunks(_merge, tiles_y, *arguments))
    if duplicates:  # the lists they stood in are shorter than their places
        behind = np.repeat(offsets[:-1] + lengths.ravel(), np.diff(offsets))
        merged, offsets = merged[np.arange(len(merged)) < behind], offsets_of(lengths)
    return TileLists(tiles_x, tiles_y, offsets, merged), duplicates
