"""Stereo re-projection: how the right eye's tile lists follow from the left eye's (Sec. 4.4).

A left tile forwards splats to right tiles through K rows of first-in-first-out lists, row k holding
what moves left by k tiles; merging.py makes each right tile's list from them. Which entry goes
where is the stereo method's matter, see stereo_method.py and docs/stereo.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.cameras import StereoRig
from gaussians.constants import BLUE, CONIC_A, CONIC_C, RED, U
from gaussians.left_view import LeftEye, disparity_px, shift_tiles
from gaussians.merging import merge_rows
from gaussians.parallel import run_chunks
from gaussians.projection import ProjectedSplats
from gaussians.stereo_method import OutOfRange, StereoMethod
from gaussians.tiling import RowSpans, TileLists, offsets_of

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]

_POLICIES: tuple[OutOfRange, ...] = ("drop", "spill", "independent_tile", "forward_only")
_DROP, _SPILL, _INDEPENDENT, _FORWARD_ONLY = range(4)


@dataclass(frozen=True)
class StereoForwarding:
    """What went through the stereo buffer to make the right lists."""

    lists: TileLists  # right eye; empty where `independent`
    fifo_entries: Int32  # [rows, tiles_y, tiles_x] by destination right tile; last row the spill
    forward_only: Int32  # [tiles_y, plane tiles] by carrying left tile
    first_column: int  # plane tile column of forward_only[:, 0]; the left image begins at 0
    independent: NDArray[np.bool_]  # [tiles_y, tiles_x] right tiles binned on their own
    dropped: int  # forwards that found no row
    spilled: int  # forwards that went through memory instead of a row
    unseen: int  # right pairs no left tile could forward: outside its view, or in none of its lists
    duplicates: int


class _Fifos(NamedTuple):
    """The first-in-first-out lists: counted in a first pass, filled in a second."""

    fill: bool
    rows: int  # K
    policy: int  # index into _POLICIES
    shift: int  # right-window tile column + shift = column of the plane the left image begins at 0
    first: int  # first and last plane column with a left tile that forwards
    last: int
    left_first: int  # plane column of the left grid's column 0
    moved: Int32  # [M] disparity in tiles, rounded as the rule asks
    extra: NDArray[np.uint8]  # [M] 1 where the shifted tile also touches the tile one further on
    counts: Int32  # [tiles_y, tiles_x, rows], first pass
    cursors: NDArray[np.int64]  # [tiles_y, tiles_x, rows], second pass
    entries: Int32  # ranks, second pass; the lists of one right tile lie side by side
    independent: NDArray[np.bool_]  # [tiles_y, tiles_x]


class _Left(NamedTuple):
    """Row entries and the left lists they stand in."""

    row_offsets: NDArray[np.int64]
    ranks: Int32
    spans: NDArray[np.int16]
    list_offsets: NDArray[np.int64]  # [tiles_y, left tiles_x]
    forwards: NDArray[np.uint8]
    last_rank: Int32  # [tiles_y, left tiles_x] a splat behind it comes too late


_LOSSES = 3  # dropped, spilled, unseen


@njit(cache=True, error_model="numpy", nogil=True)
def _by_footprint(
    begin: int,
    end: int,
    fifos: _Fifos,
    left: _Left,
    right: NDArray[np.int16],
    carried: bool,
    lose_beyond: bool,
    forward_only: Int32,
    losses: NDArray[np.int64],
) -> None:
    """Every (splat, right tile) of the right footprint from one left tile: the carrier rule.

    Scans a tile row in depth order, so every FIFO receives its entries in rank order: FIFO (k, t)
    has one source, left tile t + k, whose own list has the same order.
    """
    fill, rows, policy, shift = fifos.fill, fifos.rows, fifos.policy, fifos.shift
    first, last, left_first = fifos.first, fifos.last, fifos.left_first
    moved, entries, spans = fifos.moved, fifos.entries, left.spans
    ranks, forwards, row_offsets = left.ranks, left.forwards, left.row_offsets
    filtered = forwards.shape[0] > 0
    lowest = min(first, shift)
    seen = np.zeros(left.list_offsets.shape[1], np.int64)
    for row in range(begin, end):
        counts, cursors, independent = (
            fifos.counts[row],
            fifos.cursors[row],
            fifos.independent[row],
        )
        list_offsets, last_rank = left.list_offsets[row], left.last_rank[row]
        seen[:] = 0
        dropped, spilled, unseen = 0, 0, 0
        for entry in range(row_offsets[row], row_offsets[row + 1]):
            rank = ranks[entry]
            left_begin, left_end = spans[entry, 0] + left_first, spans[entry, 1] + left_first
            for column in range(right[entry, 0], right[entry, 1] + 1):
                if independent[column]:
                    continue
                target = column + shift
                carrier = target + moved[rank]
                held = left_begin <= left_end
                if held:
                    carrier = min(max(carrier, left_begin), left_end)
                if not (held or carried) or (lose_beyond and not first <= carrier <= last):
                    unseen += 1
                    continue
                carrier = min(max(carrier, first), last)
                if policy == _FORWARD_ONLY:
                    carrier = min(max(carrier, target), target + rows - 1)
                    if not first <= carrier <= last:
                        unseen += 1
                        continue
                tile = carrier - left_first
                added = carrier < left_begin or carrier > left_end
                if added:
                    if 0 <= tile < last_rank.shape[0] and rank > last_rank[tile]:
                        continue
                elif filtered and forwards[list_offsets[tile] + seen[tile]] == 0:
                    continue
                k = carrier - target
                if k < 0 or k >= rows:
                    if policy == _DROP:
                        dropped += 1
                        continue
                    if policy == _INDEPENDENT:
                        independent[column] = True
                        continue
                    k = rows
                    spilled += 1
                if fill:
                    if added:
                        forward_only[row, carrier - lowest] += 1
                    entries[cursors[column, k]] = rank
                    cursors[column, k] += 1
                else:
                    counts[column, k] += 1
            if filtered:
                for tile in range(spans[entry, 0], spans[entry, 1] + 1):
                    seen[tile] += 1
        losses[row, 0], losses[row, 1], losses[row, 2] = dropped, spilled, unseen


@njit(cache=True, error_model="numpy", nogil=True)
def _by_disparity(
    begin: int, end: int, fifos: _Fifos, left: _Left, losses: NDArray[np.int64]
) -> None:
    """Every forwarded left entry into the one or two right tiles its disparity points to."""
    fill, rows, policy = fifos.fill, fifos.rows, fifos.policy
    moved, extra, entries, spans = fifos.moved, fifos.extra, fifos.entries, left.spans
    ranks, forwards, row_offsets = left.ranks, left.forwards, left.row_offsets
    filtered = forwards.shape[0] > 0
    right_first = fifos.left_first - fifos.shift  # right-window column of left grid column 0
    tiles_x = fifos.independent.shape[1]
    seen = np.zeros(left.list_offsets.shape[1], np.int64)
    for row in range(begin, end):
        counts, cursors, independent = (
            fifos.counts[row],
            fifos.cursors[row],
            fifos.independent[row],
        )
        list_offsets = left.list_offsets[row]
        seen[:] = 0
        dropped, spilled = 0, 0
        for entry in range(row_offsets[row], row_offsets[row + 1]):
            rank = ranks[entry]
            for tile in range(spans[entry, 0], spans[entry, 1] + 1):
                if filtered:
                    place = list_offsets[tile] + seen[tile]
                    seen[tile] += 1
                    if forwards[place] == 0:
                        continue
                for step in range(1 + extra[rank]):
                    k = moved[rank] + step
                    column = tile + right_first - k
                    if column < 0 or column >= tiles_x or independent[column]:
                        continue
                    if k >= rows:
                        if policy == _DROP:
                            dropped += 1
                            continue
                        if policy == _INDEPENDENT:
                            independent[column] = True
                            continue
                        k = rows
                        spilled += 1
                    if fill:
                        entries[cursors[column, k]] = rank
                        cursors[column, k] += 1
                    else:
                        counts[column, k] += 1
        losses[row, 0], losses[row, 1] = dropped, spilled


def right_features(splats: ProjectedSplats, rig: StereoRig, method: StereoMethod) -> Float32:
    """[M, 16] the right eye's feature records under the method's reuse switches."""
    left, right = splats.features
    if (method.conic, method.colour, method.centre) == ("per_eye", "per_eye", "projected"):
        return right
    out = right.copy()
    if method.conic == "left":
        out[:, CONIC_A : CONIC_C + 1] = left[:, CONIC_A : CONIC_C + 1]
    if method.colour == "left":
        out[:, RED : BLUE + 1] = left[:, RED : BLUE + 1]
    if method.centre == "shifted":
        offset = np.float32(rig.display.window_offset_px)
        out[:, U] = (left[:, U] - disparity_px(splats, rig)) - offset
    return out


def forward(
    splats: ProjectedSplats,
    rows: RowSpans,
    left: LeftEye,
    rig: StereoRig,
    method: StereoMethod,
) -> StereoForwarding:
    """Build the right eye's lists by forwarding and merging.

    ``rows`` holds the right eye's spans on its own window; ``left`` may be wider.
    """
    grid = rows.grid
    shift = shift_tiles(rig, grid)
    lanes = method.rows + (method.out_of_range == "spill")
    shape = (grid.tiles_y, grid.tiles_x, lanes)
    counts = np.zeros(shape, np.int32)
    losses = np.zeros((grid.tiles_y, _LOSSES), np.int64)
    independent = np.zeros(shape[:2], np.bool_)
    if method.independent_edge_tiles:
        independent[:, -method.independent_edge_tiles :] = True
    first, behind = left.grid.first_column, left.grid.first_column + left.grid.tiles_x
    if method.left_view == "forward_only":  # the whole plane: virtual tiles that only forward
        first, behind = min(first, shift), max(behind, grid.tiles_x + shift)
    in_tiles = disparity_px(splats, rig) / np.float32(grid.tile_px)
    limit = behind - min(first, shift) + method.rows  # farther moves all behave alike
    moved, extra = _tiles_moved(in_tiles, method, limit)
    source = _left_lists(rows, left, method)
    forward_only = np.zeros((grid.tiles_y, behind - min(first, shift)), np.int32)
    kernel: Callable[..., None] = _by_disparity
    arguments: tuple[Any, ...] = (source, losses)
    if not method.by_disparity:
        carried, lose = method.insertion == "carrier", method.left_view != "forward_only"
        kernel = _by_footprint
        arguments = (source, rows.spans[1], carried, lose, forward_only, losses)
    counting = _Fifos(
        fill=False,
        rows=method.rows,
        policy=_POLICIES.index(method.out_of_range),
        shift=shift,
        first=first,
        last=behind - 1,
        left_first=left.grid.first_column,
        moved=moved,
        extra=extra,
        counts=counts,
        cursors=np.zeros(shape, np.int64),
        entries=np.zeros(0, np.int32),
        independent=independent,
    )
    run_chunks(kernel, grid.tiles_y, counting, *arguments)
    counts[independent] = 0
    ends = offsets_of(counts)[1:].reshape(shape)
    starts = ends - counts
    entries = np.empty(ends[-1, -1, -1], np.int32)
    filling = counting._replace(fill=True, cursors=starts.copy(), entries=entries)
    run_chunks(kernel, grid.tiles_y, filling, *arguments)
    depths = splats.depths if method.tie == "depth" else None
    lists, duplicates = merge_rows(starts, ends, entries, depths)
    dropped, spilled, unseen = (int(loss) for loss in losses.sum(axis=0))
    by_row = np.ascontiguousarray(np.moveaxis(counts, 2, 0))
    return StereoForwarding(
        lists,
        by_row,
        forward_only,
        min(first, shift),
        independent,
        dropped,
        spilled,
        unseen,
        duplicates,
    )


def _tiles_moved(
    in_tiles: Float32, method: StereoMethod, limit: int
) -> tuple[Int32, NDArray[np.uint8]]:
    """Disparity in tiles as the rule rounds it, and whether the shifted tile touches a second."""
    low, high = np.floor(in_tiles), np.ceil(in_tiles)
    extra = (high > low).astype(np.uint8) if method.insertion == "two_tiles" else None
    if method.insertion == "round":
        chosen = np.floor(in_tiles + np.float32(0.5))
    else:
        chosen = low if method.by_disparity else high
    moved = np.minimum(chosen, limit).astype(np.int32)
    return moved, np.zeros(len(low), np.uint8) if extra is None else extra


def _left_lists(rows: RowSpans, left: LeftEye, method: StereoMethod) -> _Left:
    tiles_y, tiles_x = left.grid.tiles_y, left.grid.tiles_x
    last_rank = np.zeros((tiles_y, 0), np.int32)
    if method.stops_with_left_tile:
        last_rank = np.full((tiles_y, tiles_x), np.iinfo(np.int32).max, np.int32)
        ended = left.eye.work.terminated > 0
        starts = left.lists.offsets[:-1].reshape(tiles_y, tiles_x)
        last_rank[ended] = left.lists.splats[(starts + left.eye.work.processed - 1)[ended]]
    list_offsets = left.lists.offsets[:-1].reshape(tiles_y, tiles_x)
    return _Left(rows.offsets, rows.ranks, left.spans, list_offsets, left.forwards, last_rank)
