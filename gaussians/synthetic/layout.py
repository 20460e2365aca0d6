"""The town plan: a main street along x, a cross street, two parallel streets, blocks of houses.

World axes: z up, the carriageway at z = 0, metres. The main street runs along y = 0.
"""

from __future__ import annotations

import numpy as np

from gaussians.synthetic.furniture import add_furniture
from gaussians.synthetic.patches import Colour, Geometry, GeometryBuilder, Material

HALF_EXTENT_M = 80.0  # the town is 160 m x 160 m
KERB_M = 0.13
CARRIAGEWAY_HALF_M = 4.0  # main street: carriageway |y| < 4, pavements to 7.5, then houses
STREET_HALF_M = 7.5
CROSS_ROAD_X = (10.5, 17.5)  # cross street: carriageway, and its width with pavements
CROSS_STREET_X = (8.0, 20.0)
PARALLEL_ROAD_Y = (51.0, 59.0)
PARALLEL_STREET_Y = (48.5, 61.5)
HOUSE_DEPTH_M = 12.0
STOREY_M = 3.15
GROUND_STOREY_M = 3.9  # shops
_OUTSKIRTS_M = 125.0

_WEST_EAST = ((-HALF_EXTENT_M, CROSS_STREET_X[0]), (CROSS_STREET_X[1], HALF_EXTENT_M))
_ASPHALT: Colour = (0.27, 0.27, 0.29)
_PAVING: Colour = (0.55, 0.53, 0.50)
_KERB: Colour = (0.62, 0.61, 0.58)
_GRASS: Colour = (0.25, 0.36, 0.14)
_FACADE_TINTS: tuple[Colour, ...] = (
    (0.72, 0.62, 0.47),
    (0.60, 0.32, 0.24),
    (0.80, 0.77, 0.70),
    (0.68, 0.50, 0.36),
    (0.56, 0.60, 0.62),
    (0.76, 0.68, 0.38),
    (0.50, 0.27, 0.21),
    (0.70, 0.74, 0.66),
)
_AWNING_TINTS: tuple[Colour, ...] = ((0.62, 0.12, 0.12), (0.10, 0.30, 0.20), (0.15, 0.22, 0.45))


def town(rng: np.random.Generator) -> Geometry:
    """The whole town: streets, houses, trees, lamps, parked cars, clutter; and soil below."""
    builder = GeometryBuilder(rng)
    add_town(builder)
    _soil(builder)
    return builder.build()


def add_town(builder: GeometryBuilder) -> None:
    """Add the town, without the soil below it, to a builder (more objects may follow)."""
    _main_street(builder)
    _cross_street(builder)
    _parallel_streets(builder)
    _outskirts(builder)
    _blocks(builder)
    add_furniture(builder)


def open_town(rng: np.random.Generator) -> Geometry:
    """A town without outskirts and without houses across the main street, so that towns join."""
    builder = GeometryBuilder(rng)
    _main_street(builder)
    _cross_street(builder)
    _parallel_streets(builder)
    _rows_of_houses(builder)
    add_furniture(builder)
    return builder.build()


def _kerb(builder: GeometryBuilder, x0: float, x1: float, y: float, exposure: float) -> None:
    """Kerb face along x, facing the carriageway at smaller |y| (y > 0: facing -y)."""
    start, edge = (x0, x1 - x0) if y > 0 else (x1, x0 - x1)
    builder.rectangle(
        (start, y, 0.0), (edge, 0.0, 0.0), (0.0, 0.0, KERB_M), Material.PLAIN, _KERB, exposure
    )


def _main_street(builder: GeometryBuilder) -> None:
    edge = CARRIAGEWAY_HALF_M
    c0, c1 = CROSS_ROAD_X
    for x0, x1 in ((-HALF_EXTENT_M, c0), (c1, HALF_EXTENT_M)):
        builder.floor((x0, -edge), (x1, edge), 0.0, Material.ROAD, _ASPHALT)
        for side in (-1.0, 1.0):
            _kerb(builder, x0, x1, side * edge, 1.0)
            low, high = sorted((side * edge, side * STREET_HALF_M))
            builder.floor((x0, low), (x1, high), KERB_M, Material.PAVEMENT, _PAVING)
    builder.floor((c0, -edge), (c1, edge), 0.0, Material.ASPHALT, _ASPHALT)
    for x0 in (c0 - 3.6, c1 + 0.6):
        corners = (x0, 0.3 - edge), (x0 + 3.0, edge - 0.3)
        builder.floor(*corners, 0.006, Material.ZEBRA, _ASPHALT, along_y=True)


def _cross_street(builder: GeometryBuilder) -> None:
    c0, c1 = CROSS_ROAD_X
    s0, s1 = CROSS_STREET_X
    p0, p1 = PARALLEL_ROAD_Y
    for side in (-1.0, 1.0):
        for inner, outer in ((CARRIAGEWAY_HALF_M, p0), (p1, HALF_EXTENT_M)):
            low, high = sorted((side * inner, side * outer))
            builder.floor((c0, low), (c1, high), 0.0, Material.ROAD, _ASPHALT, 0.5, along_y=True)
            for x, direction in ((c0, 1.0), (c1, -1.0)):  # kerbs face the carriageway
                start, edge = (low, high - low) if direction > 0 else (high, low - high)
                builder.rectangle(
                    (x, start, 0.0),
                    (0.0, edge, 0.0),
                    (0.0, 0.0, KERB_M),
                    Material.PLAIN,
                    _KERB,
                    0.4,
                )
        for inner, outer in ((STREET_HALF_M, PARALLEL_STREET_Y[0]), (PARALLEL_STREET_Y[1], 80.0)):
            low, high = sorted((side * inner, side * outer))
            for x0, x1 in ((s0, c0), (c1, s1)):
                builder.floor((x0, low), (x1, high), KERB_M, Material.PAVEMENT, _PAVING, 0.4)


def _parallel_streets(builder: GeometryBuilder) -> None:
    c0, c1 = CROSS_ROAD_X
    (p0, p1), (q0, q1) = PARALLEL_ROAD_Y, PARALLEL_STREET_Y
    for side in (-1.0, 1.0):
        low, high = sorted((side * p0, side * p1))
        builder.floor((-80.0, low), (80.0, high), 0.0, Material.ROAD, _ASPHALT, 0.2)
        for x0, x1 in ((-HALF_EXTENT_M, c0), (c1, HALF_EXTENT_M)):
            for a, b in ((q0, p0), (p1, q1)):
                low, high = sorted((side * a, side * b))
                builder.floor((x0, low), (x1, high), KERB_M, Material.PAVEMENT, _PAVING, 0.2)


def _outskirts(builder: GeometryBuilder) -> None:
    """Meadows around the town, down to the horizon."""
    near, far, z = HALF_EXTENT_M, _OUTSKIRTS_M, -0.02
    for low, high in (
        ((-far, -far), (far, -near)),
        ((-far, near), (far, far)),
        ((-far, -near), (-near, near)),
        ((near, -near), (far, near)),
    ):
        builder.floor(low, high, z, Material.GRASS, _GRASS, 0.3)


def _soil(builder: GeometryBuilder) -> None:
    """A coarse dark layer under everything, so that no gap between splats shows the void."""
    far, z = HALF_EXTENT_M, -0.45
    builder.floor((-far, -far), (far, far), z, Material.ASPHALT, (0.30, 0.29, 0.29), 0.25)


def _blocks(builder: GeometryBuilder) -> None:
    _rows_of_houses(builder)
    for end in (-1.0, 1.0):  # houses that close the view along the main street
        _end_house(builder, end)


def _rows_of_houses(builder: GeometryBuilder) -> None:
    inner, outer = STREET_HALF_M, PARALLEL_STREET_Y[0]
    for x0, x1 in _WEST_EAST:
        for side in (-1.0, 1.0):
            _row(builder, x0, x1, side * inner, side, 1.0)
            _row(builder, x0, x1, side * outer, -side, 0.25)
            _row(builder, x0, x1, side * PARALLEL_STREET_Y[1], side, 0.25)
            for a, b in ((inner, outer), (PARALLEL_STREET_Y[1], HALF_EXTENT_M)):
                low, high = sorted((side * a, side * b))
                builder.floor((x0, low), (x1, high), KERB_M, Material.GRASS, _GRASS, 0.12)


def _row(
    builder: GeometryBuilder, x0: float, x1: float, front_y: float, away: float, exposure: float
) -> None:
    """Terraced houses from x0 to x1; the front stands at front_y, the house extends to +y*away."""
    x = x0
    while x < x1 - 1e-9:
        width = float(builder.rng.uniform(8.0, 15.0))
        if x1 - (x + width) < 8.0:
            width = x1 - x
        _house(builder, x, x + width, front_y, away, exposure)
        x += width


def _house(
    builder: GeometryBuilder, x0: float, x1: float, front_y: float, away: float, exposure: float
) -> None:
    rng = builder.rng
    storeys = int(rng.integers(2, 6))
    height = GROUND_STOREY_M + STOREY_M * storeys + 0.9
    tint = _FACADE_TINTS[int(rng.integers(len(_FACADE_TINTS)))]
    back_y = front_y + away * HOUSE_DEPTH_M
    up, width = (0.0, 0.0, height), x1 - x0
    along = (width, 0.0, 0.0) if away > 0 else (-width, 0.0, 0.0)
    against = (-along[0], 0.0, 0.0)
    left, right = (x0, x1) if away > 0 else (x1, x0)
    builder.rectangle((left, front_y, 0.0), along, up, Material.FACADE, tint, exposure)
    builder.rectangle((right, back_y, 0.0), against, up, Material.FACADE, tint, 0.1 * exposure)
    depth = back_y - front_y
    open_left = x0 == CROSS_STREET_X[1]
    open_right = x1 == CROSS_STREET_X[0]
    for x, start, edge, is_open in (
        (x0, max(front_y, back_y), -abs(depth), open_left),
        (x1, min(front_y, back_y), abs(depth), open_right),
    ):
        material = Material.FACADE if is_open else Material.WALL
        share = (0.6 if is_open else 0.5) * exposure
        builder.rectangle((x, start, 0.0), (0.0, edge, 0.0), up, material, tint, share)
    low, high = min(front_y, back_y), max(front_y, back_y)
    builder.floor((x0, low), (x1, high), height, Material.ROOF, (0.33, 0.30, 0.29), 0.15 * exposure)
    _house_details(builder, (x0, x1), front_y, away, height, tint, exposure)


def _house_details(
    builder: GeometryBuilder,
    span: tuple[float, float],
    front_y: float,
    away: float,
    height: float,
    tint: Colour,
    exposure: float,
) -> None:
    """Cornice, a band above the shops, an awning, a chimney."""
    rng = builder.rng
    middle, width = 0.5 * (span[0] + span[1]), span[1] - span[0]
    pale = (0.5 * tint[0] + 0.42, 0.5 * tint[1] + 0.42, 0.5 * tint[2] + 0.40)
    for z, reach, thick in ((height - 0.45, 0.45, 0.45), (GROUND_STOREY_M - 0.1, 0.16, 0.25)):
        centre = (middle, front_y - away * 0.5 * reach)
        builder.box(centre, z, (width, reach, thick), Material.PLAIN, pale, 0.6 * exposure)
    chimney = (middle + 0.3 * width * float(rng.uniform(-1, 1)), front_y + away * 4.0)
    builder.box(chimney, height, (0.9, 0.7, 1.4), Material.WALL, (0.5, 0.3, 0.24), 0.2 * exposure)
    if rng.random() < 0.6:
        stripes = _AWNING_TINTS[int(rng.integers(len(_AWNING_TINTS)))]
        reach, drop, share = 1.2, 0.7, float(rng.uniform(0.35, 0.7))
        x0 = middle - 0.5 * share * width
        start, edge = (x0, share * width) if away > 0 else (x0 + share * width, -share * width)
        lower = (start, front_y - away * reach, GROUND_STOREY_M - 0.5 - drop)
        slope = (0.0, away * reach, drop)
        builder.rectangle(lower, (edge, 0.0, 0.0), slope, Material.STRIPES, stripes, exposure)


def _end_house(builder: GeometryBuilder, end: float) -> None:
    """A tall house across the end of the main street, facing along it."""
    x, half, height = end * HALF_EXTENT_M, 16.0, GROUND_STOREY_M + 5 * STOREY_M + 0.9
    start, edge = (half, -2 * half) if end > 0 else (-half, 2 * half)
    up, tint = (0.0, 0.0, height), _FACADE_TINTS[2]
    builder.rectangle((x, start, 0.0), (0.0, edge, 0.0), up, Material.FACADE, tint, 2.0)
    builder.box((x + end * 6.1, 0.0), 0.0, (12.0, 2 * half, height), Material.WALL, tint, 0.03)
