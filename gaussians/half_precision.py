"""float32 with some parts in half precision (IEEE binary16, nearest even): how far that carries.

Every rounded operation is computed in float32 and then rounded to half. For a single product or sum
of halves that is the correctly rounded result. What exceeds 65504 becomes infinite.
"""

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

Float32 = NDArray[np.float32]

_ZERO, _PIXEL_CENTRE, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_MINUS_HALF = np.float32(-0.5)
_SMALLEST_NORMAL = np.float32(2.0**-14)
_SUBNORMAL_ROUND = np.float32(0.75)  # float32 next to it lie 2^-24 apart, as subnormal halves do
_INFINITE_FROM = np.float32(65536)
_INFINITY = np.float32(np.inf)
_DROPPED = np.int32(13)  # mantissa bits that float32 has more
_LOW_HALF = np.int32(0xFFF)
_KEPT = np.int32(~0x1FFF)


@dataclass(frozen=True)
class HalfFormat:
    """Which parts of the float32 datapath are rounded to half precision; none is `fp32`."""

    name: str
    features: bool = False  # stored conic, threshold, opacity, colour
    power: bool = False  # centres relative to the tile, and every operation up to the exponent
    alpha: bool = False  # exponential, alpha, transmittance, weight
    accumulators: bool = False  # weighted colours and their sums


@njit(inline="always")
def to_half(x: np.float32) -> np.float32:
    """The nearest half, ties to even, as float32."""
    if abs(x) < _SMALLEST_NORMAL:
        return (x + _SUBNORMAL_ROUND) - _SUBNORMAL_ROUND
    bits = np.float32(x).view(np.int32)
    odd = (bits >> _DROPPED) & np.int32(1)
    near = np.int32((bits + _LOW_HALF + odd) & _KEPT).view(np.float32)
    if abs(near) >= _INFINITE_FROM:
        near = _INFINITY if near > _ZERO else -_INFINITY
    return near


class _Job(NamedTuple):
    """What the kernel reads, and last what it writes."""

    tile: int
    tiles_x: int
    origin: int  # the grid's first pixel column
    half_power: bool
    half_alpha: bool
    half_accumulators: bool
    alpha_max: np.float32
    features: Float32  # [M, 10]
    offsets: NDArray[np.int64]
    splats: NDArray[np.int32]
    background: Float32  # [3]
    image: Float32  # [H, W, 3]


@njit(cache=True, error_model="numpy")
def _powers(
    half: bool,
    record: Float32,
    corner: tuple[np.float32, np.float32],
    grid: Float32,
    power: Float32,
) -> None:
    """Exponents of a splat at a tile's pixels, in the order of conventions.md; ``grid`` [2, pixels]
    holds the pixel centres relative to the corner."""
    a, b, c = record[CONIC_A], record[CONIC_B], record[CONIC_C]
    if half:
        u, v = to_half(record[U] - corner[0]), to_half(record[V] - corner[1])
        for lane in range(power.size):
            dx, dy = to_half(grid[0, lane] - u), to_half(grid[1, lane] - v)
            along = to_half(to_half(to_half(a * dx) * dx) + to_half(to_half(c * dy) * dy))
            across = to_half(to_half(b * dx) * dy)
            power[lane] = to_half(to_half(_MINUS_HALF * along) - across)
    else:
        u, v = record[U], record[V]
        for lane in range(power.size):
            dx, dy = (corner[0] + grid[0, lane]) - u, (corner[1] + grid[1, lane]) - v
            power[lane] = _MINUS_HALF * ((a * dx) * dx + (c * dy) * dy) - (b * dx) * dy


@njit(cache=True, error_model="numpy")
def _blend(job: _Job, record: Float32, p: np.float32, t: np.float32, colour: Float32) -> np.float32:
    """Add one splat to one pixel; its new transmittance, negative if the pixel stops instead."""
    alpha = exp_float32(p)
    if job.half_alpha:
        alpha = min(job.alpha_max, to_half(record[OPACITY] * to_half(alpha)))
        rest = to_half(t * to_half(_ONE - alpha))
        weight = to_half(alpha * t)
    else:
        alpha = min(job.alpha_max, record[OPACITY] * alpha)
        rest = t * (_ONE - alpha)
        weight = alpha * t
    if rest < TRANSMITTANCE_STOP:
        return -_ONE
    for channel in range(3):
        part = record[RED + channel] * weight
        if job.half_accumulators:
            colour[channel] = to_half(colour[channel] + to_half(part))
        else:
            colour[channel] = colour[channel] + part
    return rest


@njit(cache=True, error_model="numpy", nogil=True)
def _half_rows(begin: int, end: int, job: _Job) -> None:
    height, width, _ = job.image.shape
    pixels = job.tile * job.tile
    power, t = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    colour, live = np.empty((pixels, 3), np.float32), np.empty(pixels, np.int32)
    grid = np.empty((2, pixels), np.float32)
    for lane in range(pixels):
        grid[0, lane] = np.float32(lane % job.tile) + _PIXEL_CENTRE
        grid[1, lane] = np.float32(lane // job.tile) + _PIXEL_CENTRE
    for row in range(begin, end):
        for column in range(job.tiles_x):
            x0, y0 = column * job.tile, row * job.tile
            corner = (np.float32(job.origin + x0), np.float32(y0))
            t[:], colour[:], live[:] = _ONE, _ZERO, 1
            live_count = pixels
            index = row * job.tiles_x + column
            for entry in range(job.offsets[index], job.offsets[index + 1]):
                if live_count == 0:
                    break
                record = job.features[job.splats[entry]]
                _powers(job.half_power, record, corner, grid, power)
                for lane in range(pixels):
                    p = power[lane]
                    if live[lane] == 0 or not (p <= _ZERO and p >= record[THRESHOLD]):
                        continue
                    rest = _blend(job, record, p, t[lane], colour[lane])
                    if rest < _ZERO:
                        live[lane] = 0
                        live_count -= 1
                    else:
                        t[lane] = rest
            for lane in range(pixels):
                x, y = x0 + lane % job.tile, y0 + lane // job.tile
                if y < height and x < width:
                    for channel in range(3):
                        behind = t[lane] * job.background[channel]
                        shown = colour[lane, channel] + behind
                        if job.half_accumulators:
                            shown = to_half(colour[lane, channel] + to_half(behind))
                        job.image[y, x, channel] = shown


def encode(features: Float32, f: HalfFormat) -> tuple[Float32, tuple[int, int, int, int]]:
    """Feature records [M, 10] as the format stores them, and how many splats' centre, conic,
    opacity and colour became infinite; centres are stored in float32."""
    if not f.features:
        return features, (0, 0, 0, 0)
    stored = features.copy()
    with np.errstate(over="ignore", under="ignore"):
        stored[:, CONIC_A:] = features[:, CONIC_A:].astype(np.float16)
    over = np.isinf(stored)
    return stored, (
        0,
        int(over[:, CONIC_A : CONIC_C + 1].any(axis=1).sum()),
        int(over[:, OPACITY].sum()),
        int(over[:, RED : BLUE + 1].any(axis=1).sum()),
    )


def rasterise_half(
    f: HalfFormat,
    features: Float32,
    lists: TileLists,
    grid: TileGrid,
    background: tuple[float, float, float],
) -> Float32:
    """The image [H, W, 3]; infinite where an accumulator overflowed."""
    image = np.zeros((grid.height, grid.width, 3), np.float32)
    job = _Job(
        grid.tile_px,
        grid.tiles_x,
        grid.first_column * grid.tile_px,
        f.power,
        f.alpha,
        f.accumulators,
        np.float32(np.float16(ALPHA_MAX)) if f.alpha else ALPHA_MAX,
        features,
        lists.offsets,
        lists.splats,
        np.asarray(background, np.float32),
        image,
    )
    run_chunks(_half_rows, grid.tiles_y, job)
    return image
