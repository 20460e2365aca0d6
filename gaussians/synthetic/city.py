"""A procedural city street with any number of splats, dense where a walker comes by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.cameras import Pose, look_at
from gaussians.errors import InputError
from gaussians.scene import Scene
from gaussians.synthetic.layout import town
from gaussians.synthetic.noise import near_normal, systematic_counts, unit_circle, value_noise
from gaussians.synthetic.patches import Crowns, Geometry, Material, Patches
from gaussians.synthetic.splats import (
    FAINTEST,
    OPAQUE_SHARE,
    Chunk,
    Shape,
    assemble,
    blobs,
    leaf_splats,
    opaque,
    surface_splats,
    translucent,
)

Float64 = NDArray[np.float64]
Ids = NDArray[np.int64]
Opacity = Callable[[np.random.Generator, int], Float64]

EYE_HEIGHT_M = 1.6
MIN_LEAVES, MAX_LEAVES = 1_000, 20_000_000
_WALK_X = (-48.0, 60.0)
_FLOATER_SHARE = 0.06
_HAZE_FLOATERS = 18_000  # more floaters than this are smaller in turn
_SKY_SHARE, _SKY_MOST, _SKY_RADIUS_M = 0.015, 4_000, 170.0
_NEAREST_M = 2.0  # density does not grow further towards the walker
_LARGEST = 0.08  # standard deviation relative to the distance that sets the density
_STEPS = (0.7548776662466927, 0.5698402909980532)  # additive recurrence of two dimensions
RICHNESS = np.ones(len(Material))  # splats per area, by how much there is to see
RICHNESS[[Material.FACADE, Material.ROAD, Material.PLAIN, Material.WALL]] = 2.4, 0.8, 0.6, 0.4
RICHNESS[[Material.GRASS, Material.ROOF, Material.ASPHALT]] = 0.35, 0.4, 0.6
_BASE = Shape(reach=0.58, aspect=1.5, turn=0.05, jitter=0.08)
_DETAIL = Shape(reach=0.50, aspect=2.5, turn=0.08, jitter=0.15)


@dataclass(frozen=True)
class City:
    """A generated scene and where to walk in it."""

    scene: Scene
    up: str  # "+z"
    eye: Float64  # [3] metres: where the walk starts, 1.6 m above the carriageway
    target: Float64  # [3] metres: what the first view looks at
    path: Float64  # [P, 3] metres: eye positions of a walk down the main street, 1 m apart

    @property
    def start(self) -> Pose:
        """Head pose at the start of the walk."""
        return look_at(self.eye, self.target, np.array([0.0, 0.0, 1.0]))


def generate_city(leaves: int, seed: int, sh_degree: int = 3) -> City:
    """A city of exactly ``leaves`` Gaussians, the same bits for the same arguments everywhere.

    160 m x 160 m of houses, streets, trees and cars under a sky. The distance between neighbouring
    splats grows with their distance from the walk, and follows from the number of leaves. Takes
    about 0.5 KB of memory per leaf at degree 3. Raises InputError unless 1 000 <= leaves <=
    20 000 000, seed >= 0 and sh_degree in 0..3.
    """
    if not MIN_LEAVES <= leaves <= MAX_LEAVES:
        raise InputError(f"city leaves must lie in {MIN_LEAVES}..{MAX_LEAVES}, not {leaves}")
    if seed < 0:
        raise InputError(f"city seed must be an integer >= 0, not {seed}")
    rng = np.random.Generator(np.random.PCG64(seed))
    geometry = town(rng)
    floaters = round(_FLOATER_SHARE * leaves)
    sky = min(round(_SKY_SHARE * leaves), _SKY_MOST)
    base = round(OPAQUE_SHARE * leaves) - sky
    detail = leaves - floaters - sky - base
    sampler = _Sampler(geometry)
    chunks = [
        *sampler.sample(rng, base, opaque, _BASE),
        *sampler.sample(rng, detail, translucent, _DETAIL),
        _sky(rng, sky),
        _floaters(rng, floaters),
    ]
    path = _path()
    target = np.array([path[0, 0] + 10.0, path[0, 1] + 0.5, EYE_HEIGHT_M + 0.1])
    return City(assemble(rng, chunks, sh_degree)[0], "+z", path[0], target, path)


def walk_distance(points: Float64) -> Float64:
    """[Q] metres that set the density at points [Q, 3]: distance to the walk and to its start."""
    x, y, z = points.T
    aside = x - np.clip(x, *_WALK_X)
    up = z - EYE_HEIGHT_M
    to_walk = np.sqrt(aside * aside + y * y + up * up)
    return np.maximum(to_walk + 0.2 * np.abs(x - _WALK_X[0]), _NEAREST_M)


class _Sampler:
    """Rectangles cut into cells of nearly constant density, and crowns, with their weights."""

    def __init__(self, geometry: Geometry) -> None:
        self.patches, self.crowns = geometry.patches, geometry.crowns
        self.ids, self.corners, self.sizes = _cells(self.patches)
        centres = on_patches(self.patches, self.ids, self.corners + 0.5 * self.sizes)
        area = self.sizes[:, 0] * self.sizes[:, 1]
        distance = walk_distance(centres)
        value = self.patches.exposures * RICHNESS[self.patches.materials]
        weights = value[self.ids] * area / (distance * distance)
        self.most = np.concatenate([distance, walk_distance(self.crowns.centres)]) * _LARGEST
        self.areas = np.concatenate([area, leaf_area(self.crowns)])
        distance = walk_distance(self.crowns.centres)
        leafy = self.crowns.exposures * leaf_area(self.crowns) / (distance * distance)
        self.weights = np.concatenate([weights, leafy])

    def sample(
        self, rng: np.random.Generator, count: int, opacity: Opacity, shape: Shape
    ) -> tuple[Chunk, Chunk]:
        """Chunks with ``count`` splats in all, spread over rectangles and crowns by weight."""
        counts = systematic_counts(self.weights, count, rng.random())
        shares = self.weights * (count / np.cumsum(self.weights)[-1])
        spread = np.minimum(shape.reach * np.sqrt(self.areas / shares), self.most)
        cut = len(self.ids)
        surface = self._on_cells(rng, counts[:cut], spread[:cut], opacity, shape)
        return surface, self._in_crowns(rng, counts[cut:], spread[cut:], opacity)

    def _on_cells(
        self,
        rng: np.random.Generator,
        counts: Ids,
        spread: Float64,
        opacity: Opacity,
        shape: Shape,
    ) -> Chunk:
        cell = np.repeat(np.arange(len(counts)), counts)
        index = np.arange(len(cell)) - np.repeat(np.cumsum(counts) - counts, counts)
        first = rng.random((len(counts), 2))
        place = []
        for axis, step in enumerate(_STEPS):
            fraction = first[cell, axis] + index * step
            fraction -= np.floor(fraction)
            place.append(self.corners[cell, axis] + fraction * self.sizes[cell, axis])
        ids, opacities = self.ids[cell], opacity(rng, len(cell))
        return surface_splats(
            rng, self.patches, ids, (place[0], place[1]), spread[cell], opacities, shape
        )

    def _in_crowns(
        self, rng: np.random.Generator, counts: Ids, spread: Float64, opacity: Opacity
    ) -> Chunk:
        ids = np.repeat(np.arange(len(counts)), counts)
        inside = near_normal(rng, (len(ids), 3)).astype(np.float64)
        x, y, z = inside.T
        deep = rng.random(len(ids))
        radius = 1.0 - 0.5 * deep * deep
        inside *= (radius / np.sqrt(x * x + y * y + z * z + 1e-12))[:, None]
        return leaf_splats(rng, self.crowns, ids, inside, spread[ids], opacity(rng, len(ids)))


def _cells(patches: Patches) -> tuple[Ids, Float64, Float64]:
    """Rectangle, corner (u, v) and size of every cell; cells are small against their distance."""
    ids = np.arange(len(patches))
    corners, sizes = np.zeros((len(patches), 2)), patches.lengths.copy()
    done: list[tuple[Ids, Float64, Float64]] = []
    while len(ids):
        distance = walk_distance(on_patches(patches, ids, corners + 0.5 * sizes))
        large = sizes.max(axis=1) > 0.4 * distance
        done.append((ids[~large], corners[~large], sizes[~large]))
        ids, corners, sizes = ids[large], corners[large], sizes[large]
        along_u = sizes[:, 0] >= sizes[:, 1]
        half = sizes * np.where(along_u[:, None], [0.5, 1.0], [1.0, 0.5])
        shift = np.where(along_u[:, None], [1.0, 0.0], [0.0, 1.0]) * half
        ids = np.concatenate([ids, ids])
        corners, sizes = np.concatenate([corners, corners + shift]), np.concatenate([half, half])
    columns = zip(*done, strict=True)
    ids, corners, sizes = (np.concatenate(column) for column in columns)
    return ids, corners, sizes


def on_patches(patches: Patches, ids: Ids, place: Float64) -> Float64:
    """[Q, 3] world position of place [Q, 2] metres on the rectangles ids [Q]."""
    along = place[:, :1] * patches.axis_u[ids] + place[:, 1:] * patches.axis_v[ids]
    return patches.origins[ids] + along


def leaf_area(crowns: Crowns) -> Float64:
    """[K] square metres of leaves that close a crown to the eye: about its surface."""
    x, y, z = crowns.radii.T
    return 4.0 * (x * y + y * z + z * x)


def _sky(rng: np.random.Generator, count: int) -> Chunk:
    """A dome of large splats: pale at the horizon, blue above, some clouds."""
    index = np.arange(count)
    height = (index + 0.5) / max(count, 1) * 1.04 - 0.04  # sine of the elevation: even per area
    turns = index * 0.6180339887498949 + rng.random()
    x, y = unit_circle(turns - np.floor(turns))
    flat = np.sqrt(1.0 - height * height)
    means = _SKY_RADIUS_M * np.column_stack([x * flat, y * flat, height])
    rise = np.sqrt(np.maximum(height, 0.0))[:, None]
    colours = (1.0 - rise) * np.array([0.80, 0.87, 0.93]) + rise * np.array([0.30, 0.50, 0.82])
    seed = np.full(count, 4711, np.uint32)
    cloud = value_noise(seed, x / (height + 0.25) * 1.6, y / (height + 0.25) * 1.6)
    white = np.clip(2.4 * (cloud - 0.52), 0.0, 0.75)[:, None]
    colours = colours * (1.0 - white) + white * np.array([0.96, 0.96, 0.97])
    spread = np.full(count, 0.85 * _SKY_RADIUS_M * np.sqrt(6.5 / max(count, 1)))
    return blobs(rng, means, spread, opaque(rng, count), colours, (1.0, 0.9, 0.9))


def _floaters(rng: np.random.Generator, count: int) -> Chunk:
    """Faint blobs over the main street, as training leaves them; none close to the walk."""
    low, high = np.array([-76.0, -7.0, 0.3]), np.array([76.0, 7.0, 14.0])
    means = low + (high - low) * rng.random((count, 3))
    y, up = means[:, 1], means[:, 2] - EYE_HEIGHT_M
    means[:, 2] += 3.0 * (y * y + up * up < 2.0)
    haze = min(
        1.0, float(np.sqrt(_HAZE_FLOATERS / max(count, 1)))
    )  # no thicker air in denser cities
    spread = walk_distance(means) * (0.002 + 0.012 * rng.random(count)) * haze
    opacities = FAINTEST + 0.06 * rng.random(count)
    colours = 0.35 + 0.4 * rng.random((count, 1)) + 0.15 * rng.random((count, 3))
    return blobs(rng, means, spread, opacities, colours, (1.0, 0.7, 0.5))


def _path() -> Float64:
    """[109, 3] a walk along the main street that sways by less than a metre."""
    x = np.arange(_WALK_X[0], _WALK_X[1] + 0.5)
    phase = (x - _WALK_X[0]) / 36.0
    sway = 3.0 * (phase - np.floor(phase)) * (1.0 - (phase - np.floor(phase)))
    sign = np.where(np.floor(phase) % 2 == 0, 1.0, -1.0)
    return np.column_stack([x, sway * sign, np.full(len(x), EYE_HEIGHT_M)])
