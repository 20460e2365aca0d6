"""Cities of any size at one density, generated tile by tile in bounded memory.

Towns of 160 m x 160 m (`layout`) stand side by side, each with houses of its own and with the same
number of splats; their main streets join. A city is the splats of this endless plane that stand
nearest to the origin, in squares around it: a larger city contains the smaller ones of the same
density and seed, splat for splat, so that a view can be held fixed while the scene grows. In both
densities a surface has the more splats the more of it shows; in ``dense`` they also stand farther
apart the farther it is from a main street, as in scans, whose cameras are carried along streets.
Unlike in `city.generate_city` no part of a street is preferred. This is what level-of-detail
searches are measured on.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from gaussians.parallel import run_chunks
from gaussians.scene import Scene
from gaussians.synthetic.city import EYE_HEIGHT_M, RICHNESS, leaf_area, on_patches
from gaussians.synthetic.layout import HALF_EXTENT_M, open_town
from gaussians.synthetic.noise import near_normal, systematic_counts
from gaussians.synthetic.patches import Crowns, Geometry
from gaussians.synthetic.splats import (
    OPAQUE_SHARE,
    Chunk,
    Shape,
    assemble,
    leaf_splats,
    opaque,
    surface_splats,
    translucent,
)

Float64 = NDArray[np.float64]
Ids = NDArray[np.int64]
Place = tuple[int, int]  # of a town, in units of its edge

TOWN_M = 2 * HALF_EXTENT_M
MIN_LEAVES, MAX_LEAVES = 1_000, 200_000_000
_TILE_LEAVES = 400_000  # generated at a time
_BLOCK_M, _SORT_M = 40.0, 10.0  # tiles are made of squares, block by block
_PATH_STEP_M = 1.0
_PATH_MOST_M = 400.0
_COARSEST = 40.0  # a size from the tail of the distribution, relative to the smallest
_PLAIN = Shape(reach=1.0, aspect=1.8, turn=0.06, jitter=0.12)


@dataclass(frozen=True)
class CityDensity:
    """How finely a tiled city is resolved."""

    leaves_per_m2: float  # of ground
    cell_m: float  # surfaces are cut into cells of at most this edge
    base: float  # spread of the covering splats relative to the distance between them
    detail: float  # least spread of the others, relative to that distance
    tail: float  # exponent of their sizes: spread = least / u ** tail, u uniform in 0..1
    even_m: float  # from the middle of a main street at eye level; beyond, density falls as 1 / m^2


DENSITIES = {
    "city": CityDensity(
        leaves_per_m2=5.0, cell_m=16.0, base=0.55, detail=0.30, tail=0.30, even_m=math.inf
    ),
    "dense": CityDensity(
        leaves_per_m2=160.0, cell_m=2.5, base=0.50, detail=0.29, tail=0.60, even_m=3.0
    ),
}


@dataclass(frozen=True)
class TiledCity:
    """A city of exactly ``leaves`` splats; the same bits for the same fields everywhere.

    Raises InputError for values out of range.
    """

    leaves: int
    density: str  # of DENSITIES
    seed: int = 0
    sh_degree: int = 3

    def __post_init__(self) -> None:
        if not MIN_LEAVES <= self.leaves <= MAX_LEAVES:
            raise InputError(
                f"city leaves must lie in {MIN_LEAVES}..{MAX_LEAVES}, not {self.leaves}"
            )
        if self.density not in DENSITIES:
            raise InputError(f"density must be one of {', '.join(DENSITIES)}, not {self.density!r}")
        if self.seed < 0:
            raise InputError(f"city seed must be an integer >= 0, not {self.seed}")
        if self.sh_degree not in (0, 1, 2, 3):
            raise InputError(f"sh_degree must be 0, 1, 2 or 3, not {self.sh_degree}")

    @property
    def half_m(self) -> float:
        """Half the edge of the square of ground that is filled."""
        return self._filled.half_m

    @property
    def path(self) -> Float64:
        """[P, 3] metres: eye positions of a walk along the main street, 1 m apart."""
        reach = min(0.8 * self.half_m, 0.5 * _PATH_MOST_M)
        x = np.arange(-reach, reach + 0.5 * _PATH_STEP_M, _PATH_STEP_M)
        return np.column_stack([x, np.full(len(x), 1.0), np.full(len(x), EYE_HEIGHT_M)])

    @property
    def target(self) -> Float64:
        """[3] metres: what the first view looks at, ahead on the walk."""
        eye: Float64 = self.path[0]
        return eye + np.array([10.0, 0.5, 0.1])

    def tiles(self) -> Iterator[Scene]:
        """All splats, tile by tile: a few hundred thousand that stand together at a time."""
        for place, taken in self._filled.towns:
            if taken.any():
                yield from _town_tiles(self, place, taken)

    @cached_property
    def _filled(self) -> _Filled:
        half_m = 0.5 * math.sqrt(self.leaves / DENSITIES[self.density].leaves_per_m2)  # about
        reach = math.ceil(max(0.0, half_m / TOWN_M - 0.5))
        while (filled := _fill(self, reach)) is None:
            reach += 1
        return filled


@dataclass(frozen=True)
class _Filled:
    """Which splats of the plane belong to a city."""

    half_m: float
    towns: list[tuple[Place, Ids]]  # how many splats of every cell


def _fill(city: TiledCity, reach: int) -> _Filled | None:
    """The cells nearest to the origin among towns up to ``reach`` away; None if these are too few.

    Cells equally far away follow each other by town and number, whatever the reach is.
    """
    span = range(-reach, reach + 1)
    places = [(x, y) for y in span for x in span]
    towns = [_Town.of(city, place) for place in places]
    distance = np.concatenate([town.cells.off_centre for town in towns])
    counts = np.concatenate([town.counts for town in towns])
    order = np.argsort(distance, kind="stable")
    total = np.cumsum(counts[order])
    last = int(np.searchsorted(total, city.leaves))
    if last == len(order) or distance[order[last]] > (reach + 0.5) * TOWN_M:
        return None
    taken = np.zeros_like(counts)
    taken[order[:last]] = counts[order[:last]]
    taken[order[last]] = city.leaves - (total[last] - counts[order[last]])
    edges = np.cumsum([len(town.counts) for town in towns])[:-1]
    half_m = float(distance[order[last]])
    return _Filled(half_m, list(zip(places, np.split(taken, edges), strict=True)))


@dataclass(frozen=True)
class _Cells:
    """Pieces of rectangles and whole crowns of one town."""

    patch: Ids  # [C] rectangle, or -1 - crown
    corners: Float64  # [C, 2] metres on the rectangle
    sizes: Float64  # [C, 2]
    expected: Float64  # [C] splats
    apart: Float64  # [C] metres between neighbouring splats
    off_centre: Float64  # [C] metres from the origin along x or y, whichever is more

    def take(self, rows: Ids) -> _Cells:
        return _Cells(*(getattr(self, f)[rows] for f in self.__dataclass_fields__))


@dataclass(frozen=True)
class _Town:
    """The same whatever city it belongs to."""

    geometry: Geometry
    cells: _Cells
    counts: Ids  # [C] splats

    @classmethod
    def of(cls, city: TiledCity, place: Place) -> _Town:
        rng = _generator(city.seed, place, 0)
        geometry = _moved(open_town(rng), place)
        density = DENSITIES[city.density]
        cells = _cells(geometry, density, place[1] * TOWN_M)
        total = round(density.leaves_per_m2 * TOWN_M * TOWN_M)
        return cls(geometry, cells, systematic_counts(cells.expected, total, float(rng.random())))


def _town_tiles(city: TiledCity, place: Place, taken: Ids) -> Iterator[Scene]:
    """Of every cell the first ``taken`` [C] splats. Tiles are made whole and then cut."""
    town = _Town.of(city, place)
    total = int(town.counts.sum())
    edges = np.searchsorted(np.cumsum(town.counts), np.arange(0, total, _TILE_LEAVES), side="right")
    bounds = np.unique(np.append(edges, len(town.counts)))
    wanted = [piece for piece, n in enumerate(np.add.reduceat(taken, bounds[:-1])) if n]
    scenes: list[Scene | None] = [None] * len(wanted)

    def generate(begin: int, end: int) -> None:
        for i in range(begin, end):
            rows = np.arange(bounds[wanted[i]], bounds[wanted[i] + 1])
            scenes[i] = _tile(city, place, 1 + wanted[i], town, rows, taken[rows])

    for first in range(0, len(wanted), 16):  # as many at a time as keep all threads busy
        last = min(first + 16, len(wanted))
        run_chunks(lambda b, e, first=first: generate(first + b, first + e), last - first)
        for i in range(first, last):
            scene, scenes[i] = scenes[i], None
            if scene is not None:
                yield scene


def _tile(city: TiledCity, place: Place, stream: int, town: _Town, rows: Ids, taken: Ids) -> Scene:
    rng = _generator(city.seed, place, stream)
    counts = town.counts[rows]
    chunks, places = _sample(
        rng, town.geometry, town.cells.take(rows), counts, DENSITIES[city.density]
    )
    scene, order = assemble(rng, chunks, city.sh_degree)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    kept = (number < np.repeat(taken, counts))[places]
    return scene if kept.all() else scene.take(np.flatnonzero(kept[order]))


def _generator(seed: int, town: Place, piece: int) -> np.random.Generator:
    """Independent of all others; entropy must not be negative."""
    key = [seed, *(2 * abs(v) + (v < 0) for v in town), piece]
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(key)))


def _moved(geometry: Geometry, town: Place) -> Geometry:
    shift = TOWN_M * np.array([town[0], town[1], 0.0])
    patches = replace(geometry.patches, origins=geometry.patches.origins + shift)
    return Geometry(patches, replace(geometry.crowns, centres=geometry.crowns.centres + shift))


def _cells(geometry: Geometry, density: CityDensity, street_y: float) -> _Cells:
    """Rectangles cut evenly into cells, and crowns; neighbours on the ground follow each other."""
    patches, crowns = geometry.patches, geometry.crowns
    pieces = np.maximum(np.ceil(patches.lengths / density.cell_m).astype(np.int64), 1)
    number = pieces.prod(axis=1)
    patch = np.repeat(np.arange(len(patches)), number)
    index = np.arange(len(patch)) - np.repeat(np.cumsum(number) - number, number)
    sizes = (patches.lengths / pieces)[patch]
    corners = np.stack([index % pieces[patch, 0], index // pieces[patch, 0]], axis=1) * sizes
    leafy = leaf_area(crowns)
    area = np.concatenate([sizes[:, 0] * sizes[:, 1], leafy])
    whole = np.concatenate([patches.lengths.prod(axis=1)[patch], leafy])
    value = patches.exposures * RICHNESS[patches.materials]
    centres = np.concatenate([on_patches(patches, patch, corners + 0.5 * sizes), crowns.centres])
    aside, up = centres[:, 1] - street_y, centres[:, 2] - EYE_HEIGHT_M
    nearness = np.minimum(1.0, density.even_m / np.sqrt(aside * aside + up * up))
    wanted = np.concatenate([value[patch], crowns.exposures]) * nearness * nearness
    scale = density.leaves_per_m2 * TOWN_M * TOWN_M / np.cumsum(area * wanted)[-1]
    nothing = np.zeros((len(crowns), 2))
    cells = _Cells(
        np.concatenate([patch, -1 - np.arange(len(crowns))]),
        np.concatenate([corners, nothing]),
        np.concatenate([sizes, nothing]),
        area * wanted * scale,
        np.minimum(1.0 / np.sqrt(wanted * scale), np.sqrt(whole)),  # not beyond a small thing
        np.abs(centres[:, :2]).max(axis=1),
    )
    keys = [np.floor(centres[:, axis] / edge) for edge in (_SORT_M, _BLOCK_M) for axis in (1, 0)]
    return cells.take(np.lexsort(keys))


def _sample(
    rng: np.random.Generator,
    geometry: Geometry,
    cells: _Cells,
    counts: Ids,
    density: CityDensity,
) -> tuple[list[Chunk], Ids]:
    """Splats spread evenly over their cells: some that cover it, smaller ones of all sizes; and
    which of all splats, cell by cell, stand in which place of the chunks.
    """
    cell = np.repeat(np.arange(len(counts)), counts)
    apart = cells.apart[cell]
    covering = rng.random(len(cell)) < OPAQUE_SHARE
    tail = 1.0 / np.maximum(rng.random(len(cell)), 1e-9)
    detail = density.detail * np.minimum(_power(tail, density.tail), _COARSEST)
    spread = apart * np.where(covering, density.base, detail)
    opacities = np.where(covering, opaque(rng, len(cell)), translucent(rng, len(cell)))
    leafy = cells.patch[cell] < 0
    flat, grown = np.flatnonzero(~leafy), np.flatnonzero(leafy)
    fractions = rng.random((len(flat), 2))
    place = cells.corners[cell[flat]] + fractions * cells.sizes[cell[flat]]
    surface = surface_splats(
        rng,
        geometry.patches,
        cells.patch[cell[flat]],
        (place[:, 0], place[:, 1]),
        spread[flat],
        opacities[flat],
        _PLAIN,
    )
    ids = -1 - cells.patch[cell[grown]]
    crowns = _leaves(rng, geometry.crowns, ids, spread[grown], opacities[grown])
    return [surface, crowns], np.concatenate([flat, grown])


def _leaves(
    rng: np.random.Generator, crowns: Crowns, ids: Ids, spread: Float64, opacities: Float64
) -> Chunk:
    inside = near_normal(rng, (len(ids), 3)).astype(np.float64)
    x, y, z = inside.T
    deep = rng.random(len(ids))
    inside *= ((1.0 - 0.5 * deep * deep) / np.sqrt(x * x + y * y + z * z + 1e-12))[:, None]
    return leaf_splats(rng, crowns, ids, inside, spread, opacities)


def _power(base: Float64, exponent: float) -> Float64:
    """base ** exponent from square roots, whose bits are the same everywhere: the exponent is
    rounded to sixteenths.
    """
    result, root = np.ones_like(base), base
    sixteenths = round(16 * exponent)
    for bit in (8, 4, 2, 1):
        root = np.sqrt(root)
        if sixteenths & bit:
            result *= root
    return result
