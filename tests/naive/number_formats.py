"""The number formats pixel by pixel: Python integers and fractions for `hw`, NumPy's half for fp16.

Written from docs/number_formats.md. No arrays in the integer part, so no width can overflow.
"""

from __future__ import annotations

from fractions import Fraction
from math import ceil, floor, log2
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.fixed_records import FixedFormat
from gaussians.half_precision import HalfFormat
from tests.naive.tiling import Lists

Float32 = NDArray[np.float32]


def half_up(value: Fraction) -> int:
    """The nearest integer, halves upwards."""
    return floor(value + Fraction(1, 2))


def fixed(value: Any, fraction: int) -> int:
    """A float as integer with so many bits behind the point."""
    return half_up(Fraction(float(value)) * 2**fraction)


def conic_record(conic: list[float], bits: int) -> tuple[list[int], int]:
    """Mantissas and their exponent: the largest of 0..46 with which all three fit."""
    for exponent in range(46, -1, -1):
        mantissas = [fixed(value, exponent) for value in conic]
        if all(abs(m) < 2 ** (bits - 1) for m in mantissas):
            return mantissas, exponent
    raise OverflowError("the conic does not fit")


def centre_record(centre: list[float], fraction: int) -> tuple[list[int], int]:
    """Both coordinates, and the smallest scale in which they fit 12 bits and a sign."""
    for scale in range(fraction):
        integers = [fixed(value, fraction - scale) for value in centre]
        if all(-(2 ** (12 + fraction)) <= i < 2 ** (12 + fraction) for i in integers):
            return integers, scale
    raise OverflowError("the centre does not fit")


def fixed_record(feature: Float32, f: FixedFormat) -> dict[str, Any]:
    """One splat as the projection unit stores it; for splats that fit."""
    half_log2_e, log2_e = np.float32(0.5 * log2(np.e)), np.float32(log2(np.e))
    u, v, a, b, c, threshold, _opacity, *colour = feature[:10]
    conic, exponent = conic_record([x * half_log2_e for x in (a, b, c)], f.conic_mantissa)
    centre, scale = centre_record([u, v], f.centre_fraction)
    return {
        "centre": centre,
        "scale": scale,
        "conic": conic,
        "exponent": exponent,
        "reach": fixed(-threshold * log2_e, f.power_fraction),
        "colour": [fixed(x, f.colour_fraction) for x in colour],
    }


def alpha(power: int, reach: int, f: FixedFormat) -> int:
    """2^(reach - power) / 255 by table and interpolation, with alpha_fraction bits."""
    most = half_up(Fraction(float(np.float32(0.99))) * 2**f.alpha_fraction)
    x = half_up(Fraction(log2(255)) * 2**f.power_fraction) - (reach - power)
    if x < 0:
        return most
    whole, rest = divmod(x, 2**f.power_fraction)
    step = 2 ** (f.power_fraction - f.exp_index)
    index, rest = divmod(rest, step)
    entries = 2**f.exp_index
    here, there = (half_up(Fraction(2.0 ** (16 - i / entries))) for i in (index, index + 1))
    value = here - half_up(Fraction((here - there) * rest, step))
    return min(most, half_up(Fraction(value, 2 ** (16 - f.alpha_fraction + whole))))


def fixed_pixel(
    records: list[dict[str, Any]], x: int, y: int, background: list[int], f: FixedFormat
) -> tuple[list[int], int]:
    """The three accumulators of one pixel, and how many of them were held at their limit."""
    shift = 2 ** (f.transmittance_fraction + f.colour_fraction - f.accumulator_fraction)
    t, colour = 2**f.transmittance_fraction - 1, [0, 0, 0]
    for record in records:
        scale = 2 ** (f.centre_fraction - record["scale"])
        u, v = record["centre"]
        dx, dy = (2 * x + 1) * scale // 2 - u, (2 * y + 1) * scale // 2 - v
        a, b, c = record["conic"]
        form = Fraction(a * dx * dx + 2 * b * dx * dy + c * dy * dy, scale * scale)
        power = half_up(form * Fraction(2**f.power_fraction, 2 ** record["exponent"]))
        if power < 0 or power > record["reach"]:
            continue
        opaque = alpha(power, record["reach"], f)
        weight = half_up(Fraction(opaque * t, 2**f.alpha_fraction))
        if t - weight < ceil(Fraction(float(np.float32(1e-4))) * 2**f.transmittance_fraction):
            break
        t -= weight
        for channel in range(3):
            colour[channel] += half_up(Fraction(record["colour"][channel] * weight, shift))
    total = [c + half_up(Fraction(b * t, shift)) for c, b in zip(colour, background, strict=True)]
    most = 2 ** (2 + f.accumulator_fraction) - 1
    return [min(c, most) for c in total], sum(c > most for c in total)


def fixed_image(
    features: Float32,
    lists: Lists,
    shape: tuple[int, int],
    tile_px: int,
    background: tuple[float, float, float],
    f: FixedFormat,
) -> tuple[Float32, int]:
    """[H, W, 3] and the number of held accumulators."""
    listed = {rank for row in lists for tile in row for rank in tile}
    records = {rank: fixed_record(features[rank], f) for rank in listed}
    behind = [fixed(np.float32(channel), f.colour_fraction) for channel in background]
    image, held = np.zeros((*shape, 3), np.float32), 0
    for y in range(shape[0]):
        for x in range(shape[1]):
            tile = [records[rank] for rank in lists[y // tile_px][x // tile_px]]
            pixel, over = fixed_pixel(tile, x, y, behind, f)
            image[y, x] = [channel / 2**f.accumulator_fraction for channel in pixel]
            held += over
    return image, held


def half_pixel(
    features: list[Any], x: int, y: int, corner: tuple[int, int], f: HalfFormat, exp: Any
) -> tuple[list[Any], Any]:
    """Colour and transmittance of one pixel; NumPy rounds every operation to its operands' type."""
    single, half = np.float32, np.float16
    power_type, alpha_type = (half if f.power else single), (half if f.alpha else single)
    sum_type = half if f.accumulators else single
    store = half if f.features else single
    t, colour = alpha_type(1), [sum_type(0)] * 3
    for feature in features:
        u, v = feature[:2]
        a, b, c, threshold, opacity, *rgb = (single(store(word)) for word in feature[2:])
        if f.power:
            dx = half(single(x - corner[0] + 0.5)) - half(u - single(corner[0]))
            dy = half(single(y - corner[1] + 0.5)) - half(v - single(corner[1]))
        else:
            dx, dy = single(x + 0.5) - u, single(y + 0.5) - v
        a, b, c = power_type(a), power_type(b), power_type(c)
        p = power_type(-0.5) * ((a * dx) * dx + (c * dy) * dy) - (b * dx) * dy
        if not (p <= 0 and single(p) >= threshold):
            continue
        fall = alpha_type(exp(single(p)))
        opaque = min(alpha_type(single(0.99)), alpha_type(opacity * single(fall)))
        rest = t * (alpha_type(1) - opaque)
        if single(rest) < single(1e-4):
            break
        weight = opaque * t
        t = rest
        for channel in range(3):
            colour[channel] = colour[channel] + sum_type(rgb[channel] * single(weight))
    return colour, t


def half_image(
    features: Float32, lists: Lists, shape: tuple[int, int], tile_px: int, f: HalfFormat, exp: Any
) -> Float32:
    """[H, W, 3] on black; ``exp`` is the exponential of float32 that both ends share."""
    image = np.zeros((*shape, 3), np.float32)
    with np.errstate(all="ignore"):
        for y in range(shape[0]):
            for x in range(shape[1]):
                row, column = y // tile_px, x // tile_px
                tile = [features[rank] for rank in lists[row][column]]
                corner = column * tile_px, row * tile_px
                image[y, x], _ = half_pixel(tile, x, y, corner, f, exp)
    return image
