"""Binning: which tiles a splat may touch, and the depth-ordered list of every tile.

Row lists come first and are shared by both eyes: on a rectified rig v, c_yy and the opacity have
the same bits in both eyes. Then each eye's own horizontal span per tile row. Spans are computed in
float64 and are conservative by the bound stated in conventions.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.constants import CONIC_A, CONIC_B, CONIC_C, THRESHOLD, U, V
from gaussians.errors import InputError
from gaussians.footprints import (
    ELLIPSE,
    INTERSECTIONS,
    Intersection,
    Shape,
    footprint,
    footprint_interval,
)
from gaussians.parallel import run_chunks
from gaussians.projection import ProjectedSplats

Float32 = NDArray[np.float32]
_SLACK_PX = 1e-3  # far above the rounding of the float64 span arithmetic itself (< 1e-6 px)
_BLOCK = 4096  # splats per unit of parallel work; rows are filled block by block in depth order


@dataclass(frozen=True)
class TileGrid:
    """The tiles of one eye's window; ``first_column`` counts from the eye's image, and is not 0
    for a window that reaches beyond it."""

    width: int
    height: int
    tile_px: int
    first_column: int = 0

    def __post_init__(self) -> None:
        if self.tile_px not in (4, 8, 16):
            raise InputError(f"tile size must be 4, 8 or 16 px, not {self.tile_px}")

    @property
    def tiles_x(self) -> int:
        return -(-self.width // self.tile_px)

    @property
    def tiles_y(self) -> int:
        return -(-self.height // self.tile_px)


@dataclass(frozen=True)
class TileLists:
    """Depth-ordered splat ranks per tile, row-major: tile i holds splats[offsets[i]:offsets[i +
    1]]."""

    tiles_x: int
    tiles_y: int
    offsets: NDArray[np.int64]  # [tiles_y * tiles_x + 1]
    splats: NDArray[np.int32]  # [pairs] ranks, ascending within a tile

    @property
    def lengths(self) -> NDArray[np.int32]:
        """[tiles_y, tiles_x] entries per tile."""
        return np.diff(self.offsets).astype(np.int32).reshape(self.tiles_y, self.tiles_x)


@dataclass(frozen=True)
class RowSpans:
    """(splat, tile row) entries in depth order per row, with each eye's span of tile columns."""

    grid: TileGrid
    offsets: NDArray[np.int64]  # [tiles_y + 1] into the entries
    ranks: NDArray[np.int32]  # [entries]
    spans: NDArray[np.int16]  # [eyes, entries, 2] first and last tile column; empty: first > last
    counts: NDArray[np.int32]  # [eyes, tiles_y, tiles_x] list lengths
    visible: NDArray[np.bool_]  # [eyes, M] splats that stand in a tile
    ill_conditioned: int  # splats whose region is unbounded by rounding


class _Job(NamedTuple):
    """How to bin. Holds no arrays: passing those on counts references in every call."""

    rule: int
    tile: int
    shift: int  # log2 of tile
    left: int  # first pixel column
    right: int  # behind the last one
    height: int


@njit(cache=True, error_model="numpy")
def _column_span(job: _Job, u: float, v: float, shape: Shape, row: int) -> tuple[int, int]:
    """First and last tile column of a splat in a tile row; first > last when it touches none.

    An ellipse must meet a pixel centre of the tile, square and box any of its area.
    """
    top = row * job.tile
    if job.rule == ELLIPSE:
        bottom = min(top + job.tile, job.height) - 1
        low, high = top + 0.5 - v - _SLACK_PX, bottom + 0.5 - v + _SLACK_PX
        left, right = footprint_interval(job.rule, shape, low, high)
        if left > right:
            return 1, 0
        first = math.ceil(max(u + left - 0.5 - _SLACK_PX, job.left - 1.0))
        last = math.floor(min(u + right - 0.5 + _SLACK_PX, np.float64(job.right)))
    else:
        left, right = footprint_interval(job.rule, shape, top - v, top + job.tile - v)
        if left > right:
            return 1, 0
        first = math.floor(max(u + left, job.left - 1.0))
        last = math.ceil(min(u + right, np.float64(job.right + 1))) - 1
    if first > last or last < job.left or first >= job.right:
        return 1, 0
    first, last = max(first, job.left) - job.left, min(last, job.right - 1) - job.left
    return first >> job.shift, last >> job.shift


@njit(inline="always")
def _wide(features: Float32, covariances: Float32, eye: int, rank: int) -> tuple[Any, Any, Any]:
    """Conic, threshold and covariance of a splat in float64."""
    conic = (
        np.float64(features[eye, rank, CONIC_A]),
        np.float64(features[eye, rank, CONIC_B]),
        np.float64(features[eye, rank, CONIC_C]),
    )
    covariance = (
        np.float64(covariances[eye, rank, 0]),
        np.float64(covariances[eye, rank, 1]),
        np.float64(covariances[eye, rank, 2]),
    )
    return conic, np.float64(features[eye, rank, THRESHOLD]), covariance


@njit(cache=True, error_model="numpy", nogil=True)
def _row_ranges(
    begin: int,
    end: int,
    job: _Job,
    features: Float32,
    covariances: Float32,
    rows: NDArray[np.int32],
    block_counts: NDArray[np.int64],
) -> int:
    """rows [M, 2]: first and last tile row, the union over eyes; returns the unbounded splats."""
    unbounded = 0
    for block in range(begin, end):
        for rank in range(block * _BLOCK, min((block + 1) * _BLOCK, rows.shape[0])):
            half = -1.0
            for eye in range(features.shape[0]):
                conic, threshold, covariance = _wide(features, covariances, eye, rank)
                extent, _shape = footprint(job.rule, conic, threshold, covariance)
                half = max(half, extent)
            if half == np.inf:
                unbounded += 1
            v = np.float64(features[0, rank, V])
            low = max(v - half - 0.5 - _SLACK_PX, -1.0)
            high = min(v + half - 0.5 + _SLACK_PX, np.float64(job.height))
            if job.rule == ELLIPSE:  # only rows of pixel centres count
                first_px, last_px = math.ceil(low), math.floor(high)
            else:
                first_px, last_px = math.floor(low), math.ceil(high)
            if first_px > last_px or last_px < 0 or first_px >= job.height:
                rows[rank, 0], rows[rank, 1] = 1, 0
                continue
            rows[rank, 0] = max(first_px, 0) >> job.shift
            rows[rank, 1] = min(last_px, job.height - 1) >> job.shift
            for row in range(rows[rank, 0], rows[rank, 1] + 1):
                block_counts[block, row] += 1
    return unbounded


@njit(cache=True, error_model="numpy", nogil=True)
def _row_entries(
    begin: int,
    end: int,
    job: _Job,
    features: Float32,
    covariances: Float32,
    rows: NDArray[np.int32],
    cursors: NDArray[np.int64],
    ranks: NDArray[np.int32],
    spans: NDArray[np.int16],
    visible: NDArray[np.bool_],
) -> None:
    """Splat by splat, so that a splat's numbers are read once for all its rows and both eyes."""
    for block in range(begin, end):
        for rank in range(block * _BLOCK, min((block + 1) * _BLOCK, rows.shape[0])):
            for eye in range(features.shape[0]):
                u, v = np.float64(features[eye, rank, U]), np.float64(features[eye, rank, V])
                conic, threshold, covariance = _wide(features, covariances, eye, rank)
                _half, shape = footprint(job.rule, conic, threshold, covariance)
                seen = False
                for row in range(rows[rank, 0], rows[rank, 1] + 1):
                    entry = cursors[block, row]
                    first, last = _column_span(job, u, v, shape, row)
                    spans[eye, entry, 0], spans[eye, entry, 1] = first, last
                    seen |= first <= last
                visible[eye, rank] = seen
            for row in range(rows[rank, 0], rows[rank, 1] + 1):
                ranks[cursors[block, row]] = rank
                cursors[block, row] += 1


@njit(cache=True, error_model="numpy", nogil=True)
def _count_tiles(
    begin: int,
    end: int,
    offsets: NDArray[np.int64],
    spans: NDArray[np.int16],
    counts: NDArray[np.int32],
) -> None:
    """List length of every tile: +1 where a span begins, -1 behind its end, then running sums."""
    tiles_x = counts.shape[2]
    change = np.empty(tiles_x + 1, np.int32)
    for row in range(begin, end):
        for eye in range(counts.shape[0]):
            change[:] = 0
            for entry in range(offsets[row], offsets[row + 1]):
                first, last = spans[eye, entry, 0], spans[eye, entry, 1]
                if first <= last:
                    change[first] += 1
                    change[last + 1] -= 1
            running = 0
            for column in range(tiles_x):
                running += change[column]
                counts[eye, row, column] = running


@njit(cache=True, error_model="numpy", nogil=True)
def _fill(
    begin: int,
    end: int,
    row_offsets: NDArray[np.int64],
    ranks: NDArray[np.int32],
    spans: NDArray[np.int16],
    tile_offsets: NDArray[np.int64],
    tiles_x: int,
    splats: NDArray[np.int32],
) -> None:
    for row in range(begin, end):
        cursor = tile_offsets[row * tiles_x : (row + 1) * tiles_x].copy()
        for entry in range(row_offsets[row], row_offsets[row + 1]):
            for column in range(spans[entry, 0], spans[entry, 1] + 1):
                splats[cursor[column]] = ranks[entry]
                cursor[column] += 1


def row_spans(
    splats: ProjectedSplats, grid: TileGrid, intersection: Intersection = "ellipse"
) -> RowSpans:
    """Bin splats into tile rows and compute every eye's column span in each.

    ``intersection`` names a footprint of footprints.py. Only ``ellipse`` lists are complete.
    """
    rule = INTERSECTIONS.index(intersection)
    job = _Job(
        rule=rule,
        tile=grid.tile_px,
        shift=grid.tile_px.bit_length() - 1,
        left=grid.first_column * grid.tile_px,
        right=grid.first_column * grid.tile_px + grid.width,
        height=grid.height,
    )
    arrays = (splats.features, splats.covariances)
    rows = np.empty((len(splats.ids), 2), np.int32)
    blocks = -(-len(rows) // _BLOCK)
    block_counts = np.zeros((blocks, grid.tiles_y), np.int64)
    unbounded = run_chunks(_row_ranges, blocks, job, *arrays, rows, block_counts)
    offsets = offsets_of(block_counts.sum(axis=0))
    cursors = offsets[:-1] + np.cumsum(block_counts, axis=0) - block_counts
    ranks = np.empty(offsets[-1], np.int32)
    spans = np.empty((splats.eyes, len(ranks), 2), np.int16)
    visible = np.empty((splats.eyes, len(rows)), np.bool_)
    run_chunks(_row_entries, blocks, job, *arrays, rows, cursors, ranks, spans, visible)
    counts = np.empty((splats.eyes, grid.tiles_y, grid.tiles_x), np.int32)
    run_chunks(_count_tiles, grid.tiles_y, offsets, spans, counts)
    return RowSpans(grid, offsets, ranks, spans, counts, visible, sum(unbounded))


def offsets_of(counts: NDArray[np.integer]) -> NDArray[np.int64]:
    """[n + 1] running sum of counts, starting at 0."""
    offsets = np.zeros(counts.size + 1, np.int64)
    np.cumsum(counts.reshape(-1), out=offsets[1:])
    return offsets


def tile_lists(rows: RowSpans, eye: int) -> TileLists:
    """The lists of one eye (0 left, 1 right) from its own spans."""
    grid = rows.grid
    offsets = offsets_of(rows.counts[eye])
    splats = np.empty(offsets[-1], np.int32)
    run_chunks(
        _fill,
        grid.tiles_y,
        rows.offsets,
        rows.ranks,
        rows.spans[eye],
        offsets,
        grid.tiles_x,
        splats,
    )
    return TileLists(grid.tiles_x, grid.tiles_y, offsets, splats)
