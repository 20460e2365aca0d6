"""The integer datapath `hw`: every operation of a rendering unit, once.

docs/number_formats.md states the contract: widths, order, rounding. All rounding is half up: add
half of the last place that stays, then shift right arithmetically. The small functions take and
return integers and are the definition that other levels call or are compared with.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.constants import (
    ALPHA_MAX,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    RED,
    TRANSMITTANCE_STOP,
    U,
    V,
)
from gaussians.errors import InputError
from gaussians.fixed_records import (
    ACCUMULATOR_INTEGER_BITS,
    CENTRE_INTEGER_BITS,
    COLOUR_INTEGER_BITS,
    EXPONENT,
    POWER_INTEGER_BITS,
    REACH,
    SCALE,
    FixedFormat,
    fixed,
)
from gaussians.parallel import run_chunks
from gaussians.tiling import TileGrid, TileLists

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]

TABLE_FRACTION_BITS = 16
_LOG2_255 = math.log2(255.0)
_ONE = np.int64(1)


Integer: TypeAlias = int | np.int64


class Widths(NamedTuple):
    """What the kernel needs of a format, and the constants that follow from it."""

    centre: int
    power: int
    power_max: int  # where a power saturates
    log2_255: int
    index_bits: int
    alpha: int
    alpha_max: int
    one: int  # transmittance before the first splat
    stop: int  # a pixel stops before it would fall below this
    weight_shift: int  # from colour x weight to the accumulator
    accumulator_max: int
    table: Int64  # [2^index] 2^(-i / 2^index)
    slopes: Int64  # [2^index] what is lost to the next entry


def widths(number_format: FixedFormat) -> Widths:
    """Constants of a format, computed in float64 and rounded half up (the stop: upwards)."""
    f = number_format
    entries = 1 << f.exp_index
    powers = [2.0 ** (TABLE_FRACTION_BITS - i / entries) for i in range(entries + 1)]
    table = np.array([math.floor(p + 0.5) for p in powers], np.int64)
    return Widths(
        centre=f.centre_fraction,
        power=f.power_fraction,
        power_max=(1 << (POWER_INTEGER_BITS + f.power_fraction)) - 1,
        log2_255=math.floor(_LOG2_255 * 2.0**f.power_fraction + 0.5),
        index_bits=f.exp_index,
        alpha=f.alpha_fraction,
        alpha_max=math.floor(float(ALPHA_MAX) * 2.0**f.alpha_fraction + 0.5),
        one=(1 << f.transmittance_fraction) - 1,
        stop=math.ceil(float(TRANSMITTANCE_STOP) * 2.0**f.transmittance_fraction),
        weight_shift=f.transmittance_fraction + f.colour_fraction - f.accumulator_fraction,
        accumulator_max=(1 << (ACCUMULATOR_INTEGER_BITS + f.accumulator_fraction)) - 1,
        table=table[:-1],
        slopes=table[:-1] - table[1:],
    )


# ---------------------------------------------------------------- one operation each


@njit(inline="always")
def rounded(value: Integer, shift: Integer) -> Integer:
    """``value`` / 2^shift, half up."""
    return (value + ((_ONE << shift) >> 1)) >> shift


@njit(inline="always")
def quadratic_form(a: Integer, b: Integer, c: Integer, dx: Integer, dy: Integer) -> Integer:
    """a dx^2 + 2 b dx dy + c dy^2, exact: any order of evaluation gives these bits."""
    return (a * dx + 2 * b * dy) * dx + c * dy * dy


@njit(inline="always")
def power_of(form: Integer, exponent: Integer, scale: Integer, w: Widths) -> Integer:
    """-log2 of the falloff, U5.power saturating; negative where rounding made the form so."""
    shift = exponent + 2 * (w.centre - scale) - w.power  # at least 1, see encode
    return min(((form >> (shift - 1)) + 1) >> 1, w.power_max)  # as rounded(), without its sum


@njit(inline="always")
def alpha_of(power: Integer, reach: Integer, w: Widths) -> Integer:
    """2^(reach - power) / 255, at most 0.99; for 0 <= power <= reach."""
    x = w.log2_255 - (reach - power)
    if x < 0:
        return w.alpha_max
    rest_bits = w.power - w.index_bits
    index = (x >> rest_bits) & ((1 << w.index_bits) - 1)
    rest = x & ((1 << rest_bits) - 1)
    value = w.table[index] - rounded(w.slopes[index] * rest, rest_bits)
    return min(rounded(value, TABLE_FRACTION_BITS - w.alpha + (x >> w.power)), w.alpha_max)


@njit(inline="always")
def weight_of(alpha: Integer, transmittance: Integer, w: Widths) -> Integer:
    """alpha x transmittance, with the fraction of the transmittance, which then loses it."""
    return rounded(alpha * transmittance, w.alpha)


# ---------------------------------------------------------------- a tile


class _Job(NamedTuple):
    """What the kernel reads, and last what it writes."""

    tile: int
    tiles_x: int
    origin: int  # the grid's first pixel column
    records: Int32  # [M, RECORD]
    offsets: Int64
    splats: Int32
    background: Int64  # [3]
    widths: Widths
    accumulators: Int32  # [H, W, 3]


@njit(cache=True, error_model="numpy")
def _tile_corner(job: _Job, row: Integer, column: Integer) -> tuple[Integer, Integer]:
    """Centre of a tile's first pixel, with the fraction of the centres."""
    half = (_ONE << job.widths.centre) >> 1
    x, y = job.origin + column * job.tile, row * job.tile
    return (x << job.widths.centre) + half, (y << job.widths.centre) + half


@njit(cache=True, error_model="numpy")
def _write(job: _Job, row: int, column: int, colour: Int64, t: Int64) -> int:
    """A tile in front of the background; returns how many accumulators had to be held."""
    height, width, _ = job.accumulators.shape
    held = 0
    for lane in range(job.tile * job.tile):
        x, y = column * job.tile + lane % job.tile, row * job.tile + lane // job.tile
        if y < height and x < width:
            for channel in range(3):
                behind = rounded(job.background[channel] * t[lane], job.widths.weight_shift)
                total = colour[channel, lane] + behind
                held += 1 if total > job.widths.accumulator_max else 0
                job.accumulators[y, x, channel] = min(total, job.widths.accumulator_max)
    return held


@njit(cache=True, error_model="numpy", nogil=True)
def _fixed_rows(begin: int, end: int, job: _Job) -> int:
    """Colours are not negative, so an accumulator that saturates may do so once, at the end."""
    w, tile, pixels = job.widths, job.tile, job.tile * job.tile
    powers, live = np.empty(pixels, np.int64), np.empty(pixels, np.int64)
    steps_x, steps_y = np.empty(pixels, np.int64), np.empty(pixels, np.int64)
    for lane in range(pixels):
        steps_x[lane], steps_y[lane] = (lane % tile) << w.centre, (lane // tile) << w.centre
    t, colour = np.empty(pixels, np.int64), np.empty((3, pixels), np.int64)
    held = 0
    for row in range(begin, end):
        for column in range(job.tiles_x):
            corner_x, corner_y = _tile_corner(job, row, column)
            t[:], colour[:], live[:] = w.one, 0, 1
            live_count = pixels
            index = row * job.tiles_x + column
            for entry in range(job.offsets[index], job.offsets[index + 1]):
                if live_count == 0:
                    break
                record = job.records[job.splats[entry]]
                scale = np.int64(record[SCALE])
                first_dx = (corner_x >> scale) - np.int64(record[U])
                first_dy = (corner_y >> scale) - np.int64(record[V])
                a, b = np.int64(record[CONIC_A]), np.int64(record[CONIC_B])
                c, exponent = np.int64(record[CONIC_C]), np.int64(record[EXPONENT])
                reach = np.int64(record[REACH])
                hits = 0
                for lane in range(pixels):
                    dx = first_dx + (steps_x[lane] >> scale)
                    dy = first_dy + (steps_y[lane] >> scale)
                    power = power_of(quadratic_form(a, b, c, dx, dy), exponent, scale, w)
                    hit = live[lane] & np.int64(power >= 0) & np.int64(power <= reach)
                    powers[lane] = power if hit != 0 else -1
                    hits += hit
                if hits == 0:
                    continue
                for lane in range(pixels):
                    if powers[lane] < 0:
                        continue
                    weight = weight_of(alpha_of(powers[lane], reach, w), t[lane], w)
                    if t[lane] - weight < w.stop:
                        live[lane] = 0
                        live_count -= 1
                        continue
                    t[lane] -= weight
                    for channel in range(3):
                        part = np.int64(record[RED + channel]) * weight
                        colour[channel, lane] += rounded(part, w.weight_shift)
            held += _write(job, row, column, colour, t)
    return held


def rasterise_fixed(
    f: FixedFormat,
    records: Int32,
    lists: TileLists,
    grid: TileGrid,
    background: tuple[float, float, float],
) -> tuple[Float32, int]:
    """The image [H, W, 3], and how many accumulators (pixel and channel) had to be held.

    Raises InputError where window or background are beyond what the format can hold.
    """
    limit = 1 << CENTRE_INTEGER_BITS
    left, right = grid.first_column * grid.tile_px, grid.first_column * grid.tile_px + grid.width
    if left < -limit or max(right, grid.height) > limit:
        raise InputError(
            f"number format {f.name}: the window must lie within {-limit}..{limit} px, not reach "
            f"from column {left} to {right} and to row {grid.height}"
        )
    brightest = (1 << (COLOUR_INTEGER_BITS + f.colour_fraction)) - 1
    behind, beyond = fixed(np.array(background, np.float32), f.colour_fraction, brightest)
    if beyond.any() or min(background) < 0:
        raise InputError(
            f"number format {f.name}: background must lie in 0..{1 << COLOUR_INTEGER_BITS}, "
            f"not {background}"
        )
    accumulators = np.zeros((grid.height, grid.width, 3), np.int32)
    job = _Job(
        grid.tile_px,
        grid.tiles_x,
        left,
        records,
        lists.offsets,
        lists.splats,
        behind.astype(np.int64),
        widths(f),
        accumulators,
    )
    held = sum(run_chunks(_fixed_rows, grid.tiles_y, job))
    return accumulators.astype(np.float32) * np.float32(2.0**-f.accumulator_fraction), held
