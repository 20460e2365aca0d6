"""Stereo rasterisation: how the right eye's tile lists follow from the left eye's (Sec. 4.4).

A left tile forwards splats to right tiles through K rows of first-in-first-out lists, row k holding
what moves left by k tiles; a right tile merges its K lists by depth rank. Three presets:

* ``independent``: the right eye bins for itself; the reference.
* ``paper``: the method as written. What passes the alpha check of a live left pixel is forwarded
  once, to row floor(disparity / tile); four rows; left conic and colour reused. Not exact.
* ``exact``: the carrier rule. Every (splat, right tile) pair of the right eye's own footprint is
  carried by exactly one left tile and row. Right lists equal the independent ones, list for list.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.cameras import StereoRig
from gaussians.constants import BLUE, CONIC_A, CONIC_C, RED, U
from gaussians.errors import InputError
from gaussians.footprints import INTERSECTIONS, Intersection
from gaussians.parallel import run_chunks
from gaussians.projection import ProjectedSplats
from gaussians.tiling import RowSpans, TileLists, offsets_of

Forwarding = Literal["none", "live_alpha_pass", "carrier"]
PerEye = Literal["per_eye", "left"]
Centre = Literal["projected", "shifted"]


@dataclass(frozen=True)
class StereoMethod:
    """How the right eye is made, as data."""

    name: str
    forwarding: Forwarding  # what a left tile forwards
    intersection: Intersection = "ellipse"  # tile test of both eyes
    rows: int = 4  # K: rows of the stereo buffer; larger disparities than K tiles do not fit
    conic: PerEye = "per_eye"  # or the left eye's reused
    colour: PerEye = "per_eye"
    centre: Centre = "projected"  # or u_left - B f / z
    independent_edge_tiles: int = 0  # last right tile columns binned on their own

    def __post_init__(self) -> None:
        choices = {
            "forwarding": get_args(Forwarding),
            "intersection": INTERSECTIONS,
            "conic": get_args(PerEye),
            "colour": get_args(PerEye),
            "centre": get_args(Centre),
        }
        for field, allowed in choices.items():
            if getattr(self, field) not in allowed:
                raise InputError(
                    f"stereo method: {field} must be one of {', '.join(allowed)}, "
                    f"not {getattr(self, field)!r}"
                )
        if not 1 <= self.rows <= 1024:
            raise InputError(f"stereo method: rows must lie in 1..1024, not {self.rows}")

    def __str__(self) -> str:
        if self.forwarding == "none":
            return f"{self.name}: both eyes binned independently, {self.intersection} lists"
        return (
            f"{self.name}: forward by {self.forwarding}, {self.rows} rows, "
            f"{self.intersection} lists, conic {self.conic}, colour {self.colour}, "
            f"centre {self.centre}, {self.independent_edge_tiles} independent edge tiles"
        )


PRESETS = {
    "independent": StereoMethod("independent", "none"),
    "paper": StereoMethod(
        "paper",
        "live_alpha_pass",
        intersection="square_3sigma",
        conic="left",
        colour="left",
        centre="shifted",
        independent_edge_tiles=3,
    ),
    "exact": StereoMethod("exact", "carrier"),
}


@dataclass(frozen=True)
class StereoForwarding:
    """What went through the stereo buffer to make the right lists."""

    lists: TileLists  # right eye
    fifo_entries: NDArray[np.int32]  # [rows, tiles_y, tiles_x] by destination right tile
    forward_only: NDArray[np.int32]  # [tiles_y, plane tiles] by carrying left tile
    shift: int  # right-window tile column + shift = column of the left window
    dropped: int
    duplicates: int


class _Fifos(NamedTuple):
    """The K rows of first-in-first-out lists: counted in a first pass, filled in a second."""

    fill: bool
    rows: int
    shift: int  # right-window column + shift = column of the image plane (left window)
    tiles_x: int
    tiles_moved: NDArray[np.int32]  # [M] disparity in tiles, rounded as the rule asks
    counts: NDArray[np.int32]  # [tiles_y, tiles_x, K], first pass
    cursors: NDArray[np.int64]  # [tiles_y, tiles_x, K], second pass
    entries: NDArray[np.int32]  # ranks, second pass; FIFOs of one right tile lie side by side


@njit(cache=True, error_model="numpy", nogil=True)
def _carry(
    begin: int,
    end: int,
    fifos: _Fifos,
    row_offsets: NDArray[np.int64],
    ranks: NDArray[np.int32],
    left: NDArray[np.int16],
    right: NDArray[np.int16],
    forward_only: NDArray[np.int32],
) -> int:
    """Carrier rule. Scans a tile row in depth order, so every FIFO receives its entries in rank
    order: FIFO (k, t) has one source, left tile t + k, whose own list has the same order."""
    shift, most, moved = fifos.shift, fifos.rows - 1, fifos.tiles_moved
    lowest = min(0, shift)  # first and last tile column of the image plane
    highest = max(fifos.tiles_x - 1, fifos.tiles_x - 1 + shift)
    for row in range(begin, end):
        counts, cursors = fifos.counts[row], fifos.cursors[row]
        for entry in range(row_offsets[row], row_offsets[row + 1]):
            rank = ranks[entry]
            left_first, left_last = left[entry, 0], left[entry, 1]
            for column in range(right[entry, 0], right[entry, 1] + 1):
                target = column + shift
                carrier = target + moved[rank]
                if left_first <= left_last:
                    carrier = min(max(carrier, left_first), left_last)
                carrier = min(max(carrier, target), target + most, highest)
                k = carrier - target
                if fifos.fill:
                    fifos.entries[cursors[column, k]] = rank
                    cursors[column, k] += 1
                else:
                    counts[column, k] += 1
                    if not left_first <= carrier <= left_last:
                        forward_only[row, carrier - lowest] += 1
    return 0


@njit(cache=True, error_model="numpy", nogil=True)
def _forward_passes(
    begin: int,
    end: int,
    fifos: _Fifos,
    first_edge: int,
    tile_offsets: NDArray[np.int64],
    splats: NDArray[np.int32],
    live_passes: NDArray[np.uint8],
) -> int:
    """The paper's rule; returns how many forwards found no row (disparity of K tiles and more)."""
    dropped = 0
    for row in range(begin, end):
        for column in range(fifos.tiles_x):
            tile = row * fifos.tiles_x + column
            for entry in range(tile_offsets[tile], tile_offsets[tile + 1]):
                if live_passes[entry] == 0:
                    continue
                k = fifos.tiles_moved[splats[entry]]
                target = column - k - fifos.shift
                if k >= fifos.rows:
                    dropped += 1
                elif 0 <= target < first_edge:
                    if fifos.fill:
                        fifos.entries[fifos.cursors[row, target, k]] = splats[entry]
                        fifos.cursors[row, target, k] += 1
                    else:
                        fifos.counts[row, target, k] += 1
    return dropped


@njit(cache=True, error_model="numpy", nogil=True)
def _merge(
    begin: int,
    end: int,
    starts: NDArray[np.int64],
    ends: NDArray[np.int64],
    fifo: NDArray[np.int32],
    tile_offsets: NDArray[np.int64],
    merged: NDArray[np.int32],
    lengths: NDArray[np.int32],
) -> int:
    """Merge unit: K sorted heads, smallest rank first, equal heads together; returns duplicates."""
    _tiles_y, tiles_x, rows = starts.shape
    nothing = np.int32(2147483647)
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
                best = nothing
                for k in range(rows):
                    best = min(best, heads[k])
                if best == nothing:
                    break
                popped = 0
                for k in range(rows):
                    if heads[k] == best:
                        places[k] += 1
                        heads[k] = fifo[places[k]] if places[k] < ending[k] else nothing
                        popped += 1
                duplicates += popped - 1
                merged[out] = best
                out += 1
            lengths[row, column] = out - first_out
    return duplicates


def disparity_px(splats: ProjectedSplats, rig: StereoRig) -> NDArray[np.float32]:
    """[M] float32 disparity B f / z, the triangulation of Sec. 4.4."""
    return np.float32(rig.baseline_m * rig.display.fx) / splats.depths


def right_features(
    splats: ProjectedSplats, rig: StereoRig, method: StereoMethod
) -> NDArray[np.float32]:
    """[M, 10] the right eye's feature records under the method's reuse switches."""
    left, right = splats.features
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
    left: TileLists,
    live_passes: NDArray[np.uint8],
    rig: StereoRig,
    method: StereoMethod,
) -> StereoForwarding:
    """Build the right eye's lists by forwarding and merging.

    ``live_passes`` [left pairs] is needed by ``live_alpha_pass`` only. Columns of the right eye's
    independent edge tiles stay empty.
    """
    grid = rows.grid
    shift = round(rig.display.window_offset_px) // grid.tile_px
    shape = (grid.tiles_y, grid.tiles_x, method.rows)
    counts = np.zeros(shape, np.int32)
    forward_only = np.zeros((grid.tiles_y, grid.tiles_x + abs(shift)), np.int32)
    in_tiles = disparity_px(splats, rig) / np.float32(grid.tile_px)
    limit = grid.tiles_x + abs(shift) + method.rows  # farther moves all behave alike
    kernel: Callable[..., int]
    if method.forwarding == "carrier":
        kernel, rounded = _carry, np.ceil(in_tiles)
        arguments: tuple[Any, ...] = (rows.offsets, rows.ranks, *rows.spans, forward_only)
    else:
        kernel, rounded = _forward_passes, np.floor(in_tiles)
        first_edge = grid.tiles_x - method.independent_edge_tiles
        arguments = (first_edge, left.offsets, left.splats, live_passes)
    moved = np.minimum(rounded, limit).astype(np.int32)
    setting = (method.rows, shift, grid.tiles_x, moved, counts)
    counting = _Fifos(False, *setting, np.zeros(shape, np.int64), np.zeros(0, np.int32))
    dropped = sum(run_chunks(kernel, grid.tiles_y, counting, *arguments))
    ends = offsets_of(counts)[1:].reshape(shape)
    starts = ends - counts
    filling = _Fifos(True, *setting, starts.copy(), np.empty(ends[-1, -1, -1], np.int32))
    run_chunks(kernel, grid.tiles_y, filling, *arguments)
    lists, duplicates = _merged_lists(starts, ends, filling.entries, counts)
    by_row = np.ascontiguousarray(np.moveaxis(counts, 2, 0))
    return StereoForwarding(lists, by_row, forward_only, shift, dropped, duplicates)


def _merged_lists(
    starts: NDArray[np.int64],
    ends: NDArray[np.int64],
    fifo: NDArray[np.int32],
    counts: NDArray[np.int32],
) -> tuple[TileLists, int]:
    tiles_y, tiles_x, _rows = counts.shape
    offsets = offsets_of(counts.sum(axis=2))
    merged = np.full(offsets[-1], -1, np.int32)
    lengths = np.empty((tiles_y, tiles_x), np.int32)
    arguments = (starts, ends, fifo, offsets, merged, lengths)
    duplicates = sum(run_chunks(_merge, tiles_y, *arguments))
    if duplicates:
        merged, offsets = merged[merged >= 0], offsets_of(lengths)
    return TileLists(tiles_x, tiles_y, offsets, merged), duplicates
