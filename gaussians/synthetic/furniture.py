"""Everything that stands in the streets: trees, lamps, parked cars, bollards, bins, benches."""

from __future__ import annotations

from collections.abc import Callable

from gaussians.synthetic.patches import Colour, GeometryBuilder, Material

_BARK: Colour = (0.30, 0.22, 0.16)
_METAL: Colour = (0.20, 0.22, 0.24)
_GLASS: Colour = (0.12, 0.15, 0.19)
_LEAF_TINTS: tuple[Colour, ...] = ((0.24, 0.42, 0.12), (0.33, 0.46, 0.13), (0.18, 0.36, 0.14))
_CAR_TINTS: tuple[Colour, ...] = (
    (0.62, 0.08, 0.08),
    (0.75, 0.76, 0.78),
    (0.10, 0.18, 0.38),
    (0.12, 0.12, 0.13),
    (0.78, 0.78, 0.74),
    (0.16, 0.32, 0.26),
)
_CROSSING = (6.0, 22.0)  # kept free of trees, cars and lamps along the main street
_PAVEMENT_Z = 0.13
Placer = Callable[[GeometryBuilder, float, float], None]


def add_furniture(builder: GeometryBuilder) -> None:
    """Furnish the main street densely, courtyards and side streets with a few trees."""
    rng = builder.rng
    for side in (-1.0, 1.0):
        _along(builder, side, first=-76.0, step=11.0, place=_street_tree)
        _along(builder, side, first=-71.0, step=22.0, place=_lamp)
        _along(builder, side, first=-74.0 + 2.5 * (side > 0), step=6.1, place=_parked_car)
        _along(builder, side, first=-72.3, step=4.7, place=_clutter)
    for _ in range(44):
        x, y = float(rng.uniform(-76, 76)), float(rng.choice([-1.0, 1.0]) * rng.uniform(24, 32))
        if not 4.0 < x < 24.0:
            tree(builder, x, y, _PAVEMENT_Z, float(rng.uniform(1.0, 1.6)), 0.15)
    for _ in range(40):
        x, y = float(rng.uniform(-115, 115)), float(rng.choice([-1.0, 1.0]) * rng.uniform(86, 115))
        tree(builder, x, y, 0.0, float(rng.uniform(1.6, 2.6)), 0.3)


def _along(
    builder: GeometryBuilder, side: float, *, first: float, step: float, place: Placer
) -> None:
    """Call ``place(builder, x, side)`` about every ``step`` metres, sparing the crossing."""
    x = first
    while x < 77.0:
        at = x + float(builder.rng.uniform(-0.12, 0.12)) * step
        if not _CROSSING[0] - 2.0 < at < _CROSSING[1] + 2.0:
            place(builder, at, side)
        x += step


def tree(
    builder: GeometryBuilder, x: float, y: float, z: float, size: float, exposure: float
) -> None:
    """A trunk, and a crown made of one large and four smaller leafy ellipsoids."""
    rng = builder.rng
    trunk = 2.7 * size
    builder.post((x, y, z), 0.16 * size, trunk + 0.8, Material.BARK, _BARK, exposure)
    tint = _LEAF_TINTS[int(rng.integers(len(_LEAF_TINTS)))]
    radius = 1.45 * size
    top = z + trunk + 0.75 * radius
    builder.crown((x, y, top), (radius, radius, 1.15 * radius), tint, exposure)
    for dx, dy in ((1.0, 0.3), (-0.3, 1.0), (-1.0, -0.3), (0.3, -1.0)):
        part = radius * float(rng.uniform(0.5, 0.72))
        reach = 0.75 * radius
        centre = (x + dx * reach, y + dy * reach, top + float(rng.uniform(-0.5, 0.6)) * radius)
        builder.crown(centre, (part, part, 0.85 * part), tint, exposure)


def _street_tree(builder: GeometryBuilder, x: float, side: float) -> None:
    size = float(builder.rng.uniform(0.95, 1.25))
    tree(builder, x, side * 5.3, _PAVEMENT_Z, size, 1.0)
    builder.box((x, side * 5.3), _PAVEMENT_Z, (1.3, 1.3, 0.04), Material.GRASS, (0.2, 0.15, 0.1))


def _lamp(builder: GeometryBuilder, x: float, side: float) -> None:
    builder.post((x, side * 4.5, _PAVEMENT_Z), 0.07, 5.2, Material.PLAIN, _METAL)
    reach = 1.4
    arm = (x, side * (4.5 - 0.5 * reach))
    builder.box(arm, 5.3, (0.08, reach, 0.08), Material.PLAIN, _METAL)
    head = (x, side * (4.5 - reach))
    builder.box(head, 5.2, (0.28, 0.6, 0.14), Material.PLAIN, (0.85, 0.84, 0.76))


def _parked_car(builder: GeometryBuilder, x: float, side: float) -> None:
    rng = builder.rng
    if rng.random() < 0.35:
        return
    tint = _CAR_TINTS[int(rng.integers(len(_CAR_TINTS)))]
    y, heading = side * 2.95, float(rng.choice([-1.0, 1.0]))
    builder.floor((x - 2.3, y - 0.95), (x + 2.3, y + 0.95), 0.006, Material.PLAIN, (0.07,) * 3)
    builder.box((x, y), 0.24, (4.3, 1.74, 0.62), Material.PLAIN, tint)
    cabin = (x - heading * 0.25, y)
    builder.box(cabin, 0.86, (2.4, 1.56, 0.56), Material.CAR_SIDE, tint, top=Material.PLAIN)
    for dx in (-1.35, 1.35):
        builder.box((x + dx, y), 0.0, (0.62, 1.78, 0.6), Material.PLAIN, (0.05, 0.05, 0.05))
    for end, lamp in ((heading, (0.9, 0.88, 0.78)), (-heading, (0.55, 0.05, 0.04))):
        for dy in (-0.62, 0.62):
            builder.box((x + end * 2.15, y + dy), 0.56, (0.06, 0.3, 0.16), Material.PLAIN, lamp)


def _clutter(builder: GeometryBuilder, x: float, side: float) -> None:
    """A bollard, a litter bin, a bench, a planter or a pile of boxes."""
    kind = int(builder.rng.integers(5))
    y = side * 4.35
    if kind == 0:
        for dx in (-1.2, 0.0, 1.2):
            builder.post((x + dx, y, _PAVEMENT_Z), 0.08, 0.9, Material.PLAIN, (0.24, 0.25, 0.26))
            builder.post((x + dx, y, _PAVEMENT_Z + 0.7), 0.085, 0.1, Material.PLAIN, (0.9,) * 3)
    elif kind == 1:
        builder.box((x, y), _PAVEMENT_Z, (0.45, 0.45, 0.95), Material.PLAIN, (0.16, 0.30, 0.18))
        builder.box((x, y), _PAVEMENT_Z + 0.95, (0.52, 0.52, 0.08), Material.PLAIN, _METAL)
    elif kind == 2:
        for dx in (-0.7, 0.7):
            builder.box(
                (x + dx, side * 6.6), _PAVEMENT_Z, (0.08, 0.4, 0.42), Material.PLAIN, _METAL
            )
        wood = (0.48, 0.30, 0.16)
        builder.box((x, side * 6.6), _PAVEMENT_Z + 0.42, (1.8, 0.45, 0.06), Material.BARK, wood)
        builder.box((x, side * 6.82), _PAVEMENT_Z + 0.48, (1.8, 0.06, 0.42), Material.BARK, wood)
    elif kind == 3:
        pot = (0.58, 0.36, 0.26)
        builder.box((x, side * 6.7), _PAVEMENT_Z, (1.1, 0.5, 0.5), Material.PLAIN, pot)
        builder.crown((x, side * 6.7, 0.95), (0.6, 0.36, 0.42), (0.30, 0.44, 0.16))
    else:
        card = (0.62, 0.46, 0.28)
        builder.box((x, side * 6.8), _PAVEMENT_Z, (0.8, 0.6, 0.55), Material.PLAIN, card)
        builder.box(
            (x + 0.1, side * 6.85), _PAVEMENT_Z + 0.55, (0.5, 0.4, 0.4), Material.PLAIN, card
        )
