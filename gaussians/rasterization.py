"""Rasterisation of one eye from its tile lists: alpha check, blending, termination, counts.

A block of 4x4 pixels is one `Lanes`; its transmittance and colour stay in registers while its
tile's list is walked. A tile of 4 px is one block; larger tiles walk their list once per block, and
their counts come out the same, for no pixel asks what another has seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

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
from gaussians.lanes import (
    WIDTH,
    broadcast,
    count,
    halves,
    load,
    minimum,
    pair,
    prefetch,
    select,
    store,
)
from gaussians.parallel import run_chunks
from gaussians.tiling import TileGrid, TileLists
from gaussians.work import EyeWork

Float32 = NDArray[np.float32]

_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_MINUS_HALF = np.float32(-0.5)
_INFINITY = np.float32(np.inf)
_BLOCK = 4  # pixels; a block has WIDTH of them
_AHEAD = 16  # list entries whose scattered records are asked for in advance
_COUNTERS = 5
_PROCESSED, _CHECKS, _PASSES, _BLENDS, _TERMINATED = range(_COUNTERS)


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
    origin: int  # the grid's first pixel column
    tiles_x: int
    features: Float32  # [M, 10 or more]
    offsets: NDArray[np.int64]
    splats: NDArray[np.int32]
    background: Float32  # [3]
    image: Float32
    transmittance: Float32
    work: NDArray[np.int32]  # [_COUNTERS, tiles_y, tiles_x]
    live_passes: NDArray[np.uint8]


@njit(inline="always")
def _check(features: Float32, one: Any, two: Any, two_counts: bool, xs: Any, ys: Any) -> Any:
    """Of two splats: where each passes, and its alpha there. The second may be none at all."""
    dx = xs - pair(features[one, U], features[two, U])
    dy = ys - pair(features[one, V], features[two, V])
    a = pair(features[one, CONIC_A], features[two, CONIC_A])
    b = pair(features[one, CONIC_B], features[two, CONIC_B])
    c = pair(features[one, CONIC_C], features[two, CONIC_C])
    p = _MINUS_HALF * ((a * dx) * dx + (c * dy) * dy) - (b * dx) * dy
    threshold_two = features[two, THRESHOLD] if two_counts else _INFINITY
    passes = (p <= _ZERO) & (p >= pair(features[one, THRESHOLD], threshold_two))
    opacity = pair(features[one, OPACITY], features[two, OPACITY])
    return passes, minimum(opacity * exp_float32(select(passes, p, _ZERO)), ALPHA_MAX)


@njit(inline="always")
def _blend(alpha: Any, passed: Any, t: Any, live: Any) -> Any:
    """The splat's weight; transmittance and live pixels after it."""
    rest = t * (_ONE - alpha)
    stopped = passed & (rest < TRANSMITTANCE_STOP)
    blended = passed & ~stopped
    return select(blended, alpha * t, _ZERO), select(blended, rest, t), live & ~stopped


@njit(inline="always")
def _walk(
    features: Float32,
    splats: NDArray[np.int32],
    live_passes: NDArray[np.uint8],
    entries: tuple[int, int],
    pixels: Any,
    gathered: Float32,
) -> tuple[int, int, int, int]:
    """Blend a list into one block; red, green, blue and transmittance go to ``gathered`` [4, 16].

    Two entries a turn, whose checks are independent. Returns the entries processed, alpha checks,
    passes, and pixels still live.
    """
    entry, last = entries
    x, y, live = pixels
    xs, ys = pair(x, x), pair(y, y)
    t, red, green, blue = broadcast(_ONE), broadcast(_ZERO), broadcast(_ZERO), broadcast(_ZERO)
    processed, checks, passes, live_count = 0, 0, 0, count(live)
    while entry < last and live_count > 0:
        for ahead in range(entry + _AHEAD, entry + _AHEAD + 2):
            upcoming = np.intp(splats[np.uintp(min(ahead, splats.shape[0] - 1))])
            prefetch(features, upcoming * features.shape[1])
        two_counts = entry + 1 < last
        one = np.uintp(splats[np.uintp(entry)])  # unsigned: no index from the end
        two = np.uintp(splats[np.uintp(entry + 1)]) if two_counts else one
        passed_both, alpha_both = _check(features, one, two, two_counts, xs, ys)
        passed_one, passed_two = halves(passed_both)
        alpha_one, alpha_two = halves(alpha_both)

        passed = passed_one & live
        hits = count(passed)
        processed, checks, passes = processed + 1, checks + live_count, passes + hits
        if live_passes.shape[0] > 0 and hits > 0:
            live_passes[entry] = 1
        weight, t, live = _blend(alpha_one, passed, t, live)
        red = red + weight * features[one, RED]
        green = green + weight * features[one, GREEN]
        blue = blue + weight * features[one, BLUE]

        live_count = count(live)
        checked = live_count if two_counts else 0
        passed = passed_two & live
        hits = count(passed)
        processed, checks, passes = processed + (checked > 0), checks + checked, passes + hits
        if live_passes.shape[0] > 0 and hits > 0:
            live_passes[entry + 1] = 1
        weight, t, live = _blend(alpha_two, passed, t, live)
        red = red + weight * features[two, RED]
        green = green + weight * features[two, GREEN]
        blue = blue + weight * features[two, BLUE]
        live_count = count(live)
        entry += 2
    store(gathered, 0, red)
    store(gathered, WIDTH, green)
    store(gathered, 2 * WIDTH, blue)
    store(gathered, 3 * WIDTH, t)
    return processed, checks, passes, live_count


@njit(cache=True, error_model="numpy")
def _write(job: _Job, x0: int, y0: int, gathered: Float32) -> None:
    """What the pixels of a block have gathered, in front of the background."""
    height, width = job.transmittance.shape
    for y in range(y0, min(y0 + _BLOCK, height)):
        for x in range(x0, min(x0 + _BLOCK, width)):
            lane = (y - y0) * _BLOCK + (x - x0)
            rest = gathered[3, lane]
            for channel in range(3):
                job.image[y, x, channel] = gathered[channel, lane] + rest * job.background[channel]
            job.transmittance[y, x] = rest


@njit(cache=True, error_model="numpy", nogil=True)
def _raster_rows(begin: int, end: int, job: _Job) -> None:
    tile, tiles_x = job.tile, job.tiles_x
    features, offsets, splats = job.features, job.offsets, job.splats
    work, live_passes = job.work, job.live_passes
    height, width = job.transmittance.shape
    gathered, centres = np.empty((4, WIDTH), np.float32), np.empty((2, WIDTH), np.float32)
    for lane in range(WIDTH):
        centres[0, lane] = np.float32(lane % _BLOCK) + _HALF
        centres[1, lane] = np.float32(lane // _BLOCK) + _HALF
    for row in range(begin, end):
        for column in range(tiles_x):
            entries = offsets[row * tiles_x + column], offsets[row * tiles_x + column + 1]
            alive = 0
            for y0 in range(row * tile, (row + 1) * tile, _BLOCK):
                for x0 in range(column * tile, (column + 1) * tile, _BLOCK):
                    x = load(centres, 0) + np.float32(x0)
                    y = load(centres, WIDTH) + np.float32(y0)
                    live = (x < np.float32(width)) & (y < np.float32(height))
                    x = x + np.float32(job.origin)
                    processed, checks, passes, live_count = _walk(
                        features, splats, live_passes, entries, (x, y, live), gathered
                    )
                    _write(job, x0, y0, gathered)
                    alive += live_count
                    work[_PROCESSED, row, column] = max(work[_PROCESSED, row, column], processed)
                    work[_CHECKS, row, column] += checks
                    work[_PASSES, row, column] += passes
                    work[_BLENDS, row, column] += passes - (count(live) - live_count)
            work[_TERMINATED, row, column] = 1 if alive == 0 else 0


def rasterise(
    features: Float32,
    lists: TileLists,
    grid: TileGrid,
    background: tuple[float, float, float],
    *,
    record_passes: bool = False,
) -> EyeImage:
    """Render one eye.

    Parameters
    ----------
    features : [M, 10 or more] float32 feature records by rank
    lists : tile lists of the same grid
    background : colour behind everything
    record_passes : also report, per list entry, whether it passed in a pixel still live
    """
    counters = np.zeros((_COUNTERS, grid.tiles_y, grid.tiles_x), np.int32)
    image = np.empty((grid.height, grid.width, 3), np.float32)
    transmittance = np.empty((grid.height, grid.width), np.float32)
    live_passes = np.zeros(len(lists.splats) if record_passes else 0, np.uint8)
    job = _Job(
        grid.tile_px,
        grid.first_column * grid.tile_px,
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
    return EyeImage(image, transmittance, EyeWork(lists.lengths, *counters), live_passes)
