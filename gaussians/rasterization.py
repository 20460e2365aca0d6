"""Rasterisation of one eye from its tile lists: alpha check, blending, termination, counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.constants import (
    ALPHA_MAX,
    BLUE,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    GREEN,
    OPACITY,
    RED,
    THRESHOLD,
    TRANSMITTANCE_STOP,
    U,
    V,
)
from gaussians.float32_math import exp_float32
from gaussians.parallel import run_chunks
from gaussians.tiling import TileGrid, TileLists
from gaussians.work import EyeWork

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]

_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_MINUS_HALF = np.float32(-0.5)
_COUNTERS = 5  # processed, alpha checks, passes, blends, terminated


@dataclass(frozen=True)
class EyeImage:
    """One rendered eye."""

    image: Float32  # [H, W, 3] linear colour >= 0, not clamped above
    transmittance: Float32  # [H, W] what is left of the background, 1 where nothing was blended
    work: EyeWork
    live_passes: NDArray[
        np.uint8
    ]  # [pairs] 1 where the entry passed in a live pixel; [0] if not asked


class _Job(NamedTuple):
    """What the kernel reads, and after the lists what it writes."""

    tile: int
    first_column: int
    last_column: int  # exclusive
    origin: int  # the grid's first column
    tiles_x: int
    features: Float32  # [M, 10]
    offsets: NDArray[np.int64]
    splats: NDArray[np.int32]
    background: Float32  # [3]
    image: Float32
    transmittance: Float32
    work: NDArray[np.int32]  # [_COUNTERS, tiles_y, tiles_x]
    live_passes: NDArray[np.uint8]


@njit(cache=True, error_model="numpy")
def _place(
    row: int,
    column: int,
    tile: int,
    origin: int,
    size: tuple[int, int],
    xs: Float32,
    ys: Float32,
    live: Int32,
) -> int:
    """Pixel centres of a tile's lanes, and which lie inside the image; returns their number."""
    inside = 0
    for lane in range(tile * tile):
        x, y = column * tile + lane % tile, row * tile + lane // tile
        xs[lane], ys[lane] = np.float32(origin * tile + x) + _HALF, np.float32(y) + _HALF
        live[lane] = 1 if y < size[0] and x < size[1] else 0
        inside += live[lane]
    return inside


@njit(cache=True, error_model="numpy")
def _write(job: _Job, row: int, column: int, colour: Float32, t: Float32) -> None:
    """What the lanes of a tile have gathered, in front of the background."""
    height, width = job.transmittance.shape
    for lane in range(job.tile * job.tile):
        x, y = column * job.tile + lane % job.tile, row * job.tile + lane // job.tile
        if y < height and x < width:
            for channel in range(3):
                behind = t[lane] * job.background[channel]
                job.image[y, x, channel] = colour[channel, lane] + behind
            job.transmittance[y, x] = t[lane]


@njit(cache=True, error_model="numpy", nogil=True)
def _raster_rows(begin: int, end: int, job: _Job) -> None:
    tile, tiles_x = job.tile, job.tiles_x
    features, offsets, splats = job.features, job.offsets, job.splats
    work, live_passes = job.work, job.live_passes
    size = job.transmittance.shape
    pixels = tile * tile
    xs, ys = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    power, weight = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    t, colour = np.empty(pixels, np.float32), np.empty((3, pixels), np.float32)
    red, green, blue = colour[0], colour[1], colour[2]
    live, passed = np.empty(pixels, np.int32), np.empty(pixels, np.int32)
    record_passes = live_passes.shape[0] > 0
    for row in range(begin, end):
        for column in range(job.first_column, job.last_column):
            live_count = _place(row, column, tile, job.origin, size, xs, ys, live)
            t[:], colour[:] = _ONE, _ZERO
            processed, checks, passes, blends = 0, 0, 0, 0
            index = row * tiles_x + column
            for entry in range(offsets[index], offsets[index + 1]):
                if live_count == 0:
                    break
                record = features[splats[entry]]
                u, v = record[U], record[V]
                a, b, c = record[CONIC_A], record[CONIC_B], record[CONIC_C]
                threshold, opacity = record[THRESHOLD], record[OPACITY]
                processed += 1
                checks += live_count
                hits = 0
                for lane in range(pixels):
                    dx, dy = xs[lane] - u, ys[lane] - v
                    p = _MINUS_HALF * ((a * dx) * dx + (c * dy) * dy) - (b * dx) * dy
                    hit = np.int32(p <= _ZERO) & np.int32(p >= threshold) & live[lane]
                    passed[lane] = hit
                    power[lane] = p if hit != 0 else _ZERO
                    hits += hit
                if hits == 0:
                    continue
                passes += hits
                if record_passes:
                    live_passes[entry] = 1
                r, g, bl = record[RED], record[GREEN], record[BLUE]
                stopped = 0
                for lane in range(pixels):
                    alpha = min(ALPHA_MAX, opacity * exp_float32(power[lane]))
                    rest = t[lane] * (_ONE - alpha)
                    stop = passed[lane] & np.int32(rest < TRANSMITTANCE_STOP)
                    blend = passed[lane] & (stop ^ 1)
                    weight[lane] = alpha * t[lane] if blend != 0 else _ZERO
                    t[lane] = rest if blend != 0 else t[lane]
                    live[lane] = live[lane] & (stop ^ 1)
                    stopped += stop
                for lane in range(pixels):
                    red[lane] = red[lane] + r * weight[lane]
                    green[lane] = green[lane] + g * weight[lane]
                    blue[lane] = blue[lane] + bl * weight[lane]
                live_count -= stopped
                blends += hits - stopped
            _write(job, row, column, colour, t)
            work[0, row, column] = processed
            work[1, row, column] = checks
            work[2, row, column] = passes
            work[3, row, column] = blends
            work[4, row, column] = 1 if live_count == 0 else 0


def rasterise(
    features: Float32,
    lists: TileLists,
    grid: TileGrid,
    background: tuple[float, float, float],
    *,
    columns: tuple[int, int] | None = None,
    onto: EyeImage | None = None,
    record_passes: bool = False,
) -> EyeImage:
    """Render the tiles of one eye.

    Parameters
    ----------
    features : [M, 10] float32 feature records by rank
    lists : tile lists of the same grid
    background : colour behind everything
    columns : half-open range of tile columns to render; all by default
    onto : earlier image of the other columns; its arrays are written to and its work is added
    record_passes : also report, per list entry, whether it passed in a pixel still live
    """
    counters = np.zeros((_COUNTERS, grid.tiles_y, grid.tiles_x), np.int32)
    if onto is None:
        image = np.zeros((grid.height, grid.width, 3), np.float32)
        transmittance = np.ones((grid.height, grid.width), np.float32)
    else:
        image, transmittance = onto.image, onto.transmittance
    live_passes = np.zeros(len(lists.splats) if record_passes else 0, np.uint8)
    first, last = columns or (0, grid.tiles_x)
    job = _Job(
        grid.tile_px,
        first,
        last,
        grid.first_column,
        grid.tiles_x,
        features,
        lists.offsets,
        lists.splats,
        np.asarray(background, np.float32),
        image,
        transmittance,
        counters,
        live_passes,
    )
    run_chunks(_raster_rows, grid.tiles_y, job)
    entries = np.zeros_like(counters[0])
    entries[:, first:last] = lists.lengths[:, first:last]
    new = [entries, *counters]
    if onto is not None:
        old = onto.work
        earlier = (
            old.entries,
            old.processed,
            old.alpha_checks,
            old.passes,
            old.blends,
            old.terminated,
        )
        new = [a + b for a, b in zip(earlier, new, strict=True)]
    return EyeImage(image, transmittance, EyeWork(*new), live_passes)
