"""Procedural colours: what a point (u, v) of a textured rectangle looks like, light baked in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.synthetic.noise import hash_unit, value_noise
from gaussians.synthetic.patches import Material, Patches

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

_SUN = np.array([-0.45, -0.35, 0.82])  # direction towards the sun, about unit length
_AMBIENT, _DIFFUSE = 0.62, 0.46
_SHOP_M, _STOREY_M, _BAY_M = 3.9, 3.15, 2.7  # of a facade, from the ground up


@dataclass(frozen=True)
class Points:
    """Q points of one material: place and size on the rectangle, seed, base colour."""

    u: Float64  # [Q] metres along the rectangle
    v: Float64  # [Q]
    length_u: Float64  # [Q] metres
    length_v: Float64  # [Q]
    seed: NDArray[np.uint32]  # [Q]
    tint: Float64  # [Q, 3]


def surface_colours(patches: Patches, ids: NDArray[np.int64], u: Float64, v: Float64) -> Float64:
    """[Q, 3] colours in 0..1 of the points (u, v) in metres on the rectangles ``ids`` [Q]."""
    colours = np.empty((len(ids), 3))
    materials = patches.materials[ids]
    for material, texture in _TEXTURES.items():
        rows = np.flatnonzero(materials == material)
        if len(rows) == 0:
            continue
        of = ids[rows]
        length_u, length_v = patches.lengths[of].T
        points = Points(u[rows], v[rows], length_u, length_v, patches.seeds[of], patches.tints[of])
        colours[rows] = texture(points)
    return np.clip(colours * _light(patches.normals)[ids, None], 0.0, 1.0)


def _light(normals: Float64) -> Float64:
    """[M] baked sunlight and skylight by orientation."""
    x, y, z = normals.T
    sun = np.maximum(x * _SUN[0] + y * _SUN[1] + z * _SUN[2], 0.0)
    return _AMBIENT + 0.06 * z + _DIFFUSE * sun


def _grain(p: Points, size_m: float, amount: float) -> Float64:
    """[Q, 1] factor around 1: smooth noise of this wavelength."""
    noise = value_noise(p.seed, p.u / size_m, p.v / size_m)
    return (1.0 + amount * (noise - 0.5))[:, None]


def _paint(colours: Float64, where: Bool, colour: Float64 | tuple[float, float, float]) -> None:
    colours[where] = colour


def _plain(p: Points) -> Float64:
    return p.tint * _grain(p, 0.4, 0.12)


def _asphalt(p: Points) -> Float64:
    patched = hash_unit(p.seed, np.floor(p.u / 6.0).astype(int), np.floor(p.v / 2.0).astype(int))
    return p.tint * _grain(p, 0.25, 0.25) * _grain(p, 3.0, 0.3) * (0.94 + 0.1 * patched)[:, None]


def _road(p: Points) -> Float64:
    colours = _asphalt(p)
    across = np.abs(p.v - 0.5 * p.length_v)
    dashed = (across < 0.08) & (p.u - 6.0 * np.floor(p.u / 6.0) < 3.2)
    edge = np.abs(across - (0.5 * p.length_v - 2.1)) < 0.06
    gutter = across > 0.5 * p.length_v - 0.3
    _paint(colours, gutter, colours[gutter] * 0.72)
    worn = (0.82 - 0.25 * value_noise(p.seed, p.u * 3.0, p.v * 3.0))[:, None]
    lines = dashed | edge
    _paint(colours, lines, np.repeat(worn, 3, axis=1)[lines])
    return colours


def _zebra(p: Points) -> Float64:
    colours = _asphalt(p)
    white = p.u - np.floor(p.u) < 0.52
    worn = 0.86 - 0.2 * value_noise(p.seed, p.u * 3.0, p.v * 3.0)
    colours[white] = worn[white, None]
    return colours


def _pavement(p: Points) -> Float64:
    i, j = np.floor(p.u / 0.6), np.floor(p.v / 0.6)
    slab = hash_unit(p.seed, i.astype(int), j.astype(int))
    colours = p.tint * (0.9 + 0.16 * slab)[:, None] * _grain(p, 1.7, 0.2)
    joint = (np.abs(p.u / 0.6 - i - 0.5) > 0.465) | (np.abs(p.v / 0.6 - j - 0.5) > 0.465)
    _paint(colours, joint, colours[joint] * 0.66)
    return colours


def _grass(p: Points) -> Float64:
    colours = p.tint * _grain(p, 0.15, 0.7) * _grain(p, 4.0, 0.5)
    dry = value_noise(p.seed + np.uint32(7), p.u / 7.0, p.v / 7.0)[:, None]
    return colours + dry * np.array([0.09, 0.04, 0.0])


def _wall(p: Points) -> Float64:
    row = np.floor(p.v / 0.3)
    brick = hash_unit(p.seed, np.floor(p.u / 0.6 + 0.5 * row).astype(int), row.astype(int))
    streaks = value_noise(p.seed + np.uint32(3), p.u / 0.8, p.v / 6.0)
    tone = (0.93 + 0.12 * brick) * (0.88 + 0.2 * streaks)
    grime = np.clip(0.72 + 0.28 * p.v / 1.2, 0.0, 1.0)  # darker towards the ground
    return p.tint * (tone * grime)[:, None]


def _roof(p: Points) -> Float64:
    return p.tint * _grain(p, 0.5, 0.3) * _grain(p, 5.0, 0.4)


def _bark(p: Points) -> Float64:
    return p.tint * (0.7 + 0.6 * value_noise(p.seed, p.u / 0.05, p.v / 0.4))[:, None]


def _stripes(p: Points) -> Float64:
    pale = np.floor(p.u / 0.35) % 2 == 0
    return np.where(pale[:, None], np.array([0.88, 0.86, 0.80]), p.tint) * _grain(p, 0.5, 0.1)


def _car_side(p: Points) -> Float64:
    """Window band of a car's cabin: dark glass with coloured pillars."""
    colours = _plain(p)
    pillar = np.minimum(p.u, p.length_u - p.u) < 0.09
    pillar |= np.abs(p.u - 0.5 * p.length_u) < 0.05 * (p.length_u > 2.0)
    glass = ~pillar & (p.v > 0.06) & (p.v < p.length_v - 0.05)
    shine = 0.10 + 0.22 * p.v[glass] / 0.56
    _paint(colours, glass, shine[:, None] * np.array([0.85, 1.0, 1.2]))
    return colours


def _facade(p: Points) -> Float64:
    colours = _wall(p)
    bays = np.maximum(np.rint(p.length_u / _BAY_M), 1.0)
    bay = p.length_u / bays
    column = np.floor(p.u / bay)
    x = p.u / bay - column  # 0..1 inside the bay
    storey = np.floor((p.v - _SHOP_M) / _STOREY_M)
    y = (p.v - _SHOP_M) - storey * _STOREY_M  # metres above this storey's floor
    upper = (storey >= 0) & (p.v < p.length_v - 1.0)
    _windows(p, colours, upper, (column, storey), x * bay, bay, y)
    _shop(p, colours, p.v < _SHOP_M, column, x, bay)
    return colours


def _windows(
    p: Points,
    colours: Float64,
    upper: Bool,
    cell: tuple[Float64, Float64],
    x: Float64,
    bay: Float64,
    y: Float64,
) -> None:
    """Upper storeys: one window per bay with frame, sill, lintel, curtains or shutters."""
    away = np.abs(x - 0.5 * bay)  # metres from the middle of the window
    style = hash_unit(p.seed, np.full(len(x), 91), np.full(len(x), 17))
    half = 0.52 + 0.25 * style
    inside = upper & (away < half) & (y > 0.85) & (y < 2.55)
    frame = inside & ((away > half - 0.09) | (y < 0.95) | (y > 2.45))
    frame |= inside & ((away < 0.035) | (np.abs(y - 1.95) < 0.03))
    sill = upper & (away < half + 0.12) & (y > 0.73) & (y <= 0.85)
    lintel = upper & (away < half + 0.1) & (y >= 2.55) & (y < 2.75)
    shutter = upper & (away >= half) & (away < half + 0.4) & (y > 0.9) & (y < 2.5) & (style > 0.6)
    course = upper & (y < 0.14)
    pale = 0.45 * p.tint + np.array([0.46, 0.45, 0.42])
    for where in (sill, lintel, course):
        _paint(colours, where, pale[where])
    slats = 0.7 + 0.3 * ((y * 12.0) % 1.0 > 0.4)
    _paint(colours, shutter, (p.tint * [0.35, 0.55, 0.5] * slats[:, None])[shutter])
    column, storey = (c.astype(int) for c in cell)
    lit = hash_unit(p.seed + np.uint32(11), column, storey)
    sky = np.clip((y - 0.9) / 1.7 + 0.3 * (lit - 0.5), 0.0, 1.0)[:, None]
    glass = np.array([0.07, 0.09, 0.12]) + sky * np.array([0.20, 0.26, 0.34])
    curtain = (lit > 0.55) & (away > half * (1.3 - lit))
    glass = np.where(curtain[:, None], np.array([0.62, 0.58, 0.50]) * (0.7 + 0.3 * sky), glass)
    glass[lit < 0.06] = (0.95, 0.78, 0.45)
    _paint(colours, inside, glass[inside])
    _paint(colours, frame, (0.88, 0.87, 0.84))


def _shop(
    p: Points, colours: Float64, ground: Bool, column: Float64, x: Float64, bay: Float64
) -> None:
    """Ground floor: shop windows, a door in about every third bay, a sign band above."""
    index = column.astype(int)
    pick = hash_unit(p.seed + np.uint32(5), index, index)
    shop = hash_unit(p.seed, np.full(len(x), 3), np.full(len(x), 8)) < 0.75
    away = np.abs(x - 0.5) * bay
    door = ground & (pick < 0.3) & (away < 0.55) & (p.v < 2.45)
    pane = ground & shop & (pick >= 0.3) & (away < 0.5 * bay - 0.14) & (p.v > 0.55) & (p.v < 2.75)
    pane |= ground & ~shop & (pick >= 0.3) & (away < 0.5) & (p.v > 1.0) & (p.v < 2.6)
    goods = value_noise(p.seed + np.uint32(2), p.u / 0.3, p.v / 0.45)
    warm = np.clip(0.10 + 0.5 * (goods - 0.45) + 0.10 * (p.v - 0.5), 0.04, 0.85)[:, None]
    hue = np.stack([1.15 - 0.2 * pick, 0.95 + 0.1 * goods, 0.65 + 0.4 * pick], axis=1)
    _paint(colours, pane, (warm * hue)[pane])
    mullion = pane & ((np.abs(away - 0.5 * bay + 0.14) < 0.07) | (np.abs(p.v - 0.6) < 0.06))
    _paint(colours, mullion, (0.16, 0.15, 0.14))
    wood = np.stack([0.20 + 0.3 * pick, 0.16 + 0.1 * goods, 0.12 + 0.6 * pick * pick], axis=1)
    panel = 0.75 + 0.25 * ((away < 0.36) & (np.abs(p.v - 1.3) < 0.9))
    _paint(colours, door, (wood * panel[:, None])[door])
    _paint(colours, door & (away < 0.3) & (p.v > 1.7), (0.14, 0.17, 0.20))
    sign = ground & shop & (p.v > 2.95) & (p.v < 3.55)
    band = hash_unit(p.seed, np.full(len(x), 1), np.full(len(x), 5))
    base = np.stack([0.15 + 0.5 * band, 0.14 + 0.25 * (1 - band), 0.16 + 0.3 * (1 - band)], axis=1)
    letters = hash_unit(p.seed, np.floor(p.u / 0.16).astype(int), np.floor(p.v / 0.2).astype(int))
    written = sign & (letters > 0.5) & (np.abs(p.v - 3.25) < 0.2) & (away < 0.36 * bay)
    _paint(colours, sign, base[sign])
    _paint(colours, written, (0.92, 0.88, 0.72))


_TEXTURES: dict[Material, Callable[[Points], Float64]] = {
    Material.PLAIN: _plain,
    Material.ASPHALT: _asphalt,
    Material.ROAD: _road,
    Material.ZEBRA: _zebra,
    Material.PAVEMENT: _pavement,
    Material.GRASS: _grass,
    Material.FACADE: _facade,
    Material.WALL: _wall,
    Material.ROOF: _roof,
    Material.BARK: _bark,
    Material.STRIPES: _stripes,
    Material.CAR_SIDE: _car_side,
}


def leaf_colours(
    seeds: NDArray[np.uint32], tints: Float64, inside: Float64, positions: Float64
) -> Float64:
    """[Q, 3] colours of leaves; ``inside`` [Q, 3] is the place in the unit ball of the crown.

    Light from above and outside, darker within, tufts of about 0.4 m.
    """
    x, y, z = inside.T
    depth = np.sqrt(x * x + y * y + z * z)
    tuft = value_noise(
        seeds, positions[:, 0] / 0.35 + positions[:, 2] / 0.5, positions[:, 1] / 0.35
    )
    light = 0.30 + 0.55 * depth * (0.6 + 0.25 * z - 0.12 * x - 0.1 * y) + 0.75 * (tuft - 0.35)
    yellow = (0.25 * tuft)[:, None] * np.array([0.45, 0.35, 0.0])
    return np.clip((tints * 1.15 + yellow) * np.clip(light, 0.12, 1.25)[:, None], 0.0, 1.0)
