"""Benchmark scenes: splats spread over what one eye sees, so that full-size frames cost what
trained street scans cost. Their statistics are part of their definition (configs/scenes).

Each ray of a jittered grid about 2 px apart leaves a splat on up to four surfaces it pierces; the
grid is wider than the frustum. Near surfaces are thinned to a smallest leaf size. The origin lies
on the ground under the eye. Depths that are equal as float32 are not planted: among a million
depths within a few octaves they happen, as they do in trained scenes, and surfaces that face the
view axis add to them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.cameras import DISPLAYS, Pose, StereoRig, look_at
from gaussians.errors import InputError
from gaussians.scene import Scene
from gaussians.synthetic.layout import add_town
from gaussians.synthetic.patches import Geometry, GeometryBuilder, Material
from gaussians.synthetic.raycast import LAYERS, RayGrid, cast, rotated
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

_UP = np.array([0.0, 0.0, 1.0])
_GRAZING = 0.05  # below this cosine splats do not get longer along the surface
_FLOATER_NEAREST_M = 1.0
_FLOATER_OCTAVES = 7


@dataclass(frozen=True)
class BenchmarkView:
    """One benchmark scene as data; configs/scenes/NAME.yaml holds exactly these fields."""

    name: str
    seed: int
    eye_m: tuple[float, float, float]  # midway between the eyes, in the axes of the town
    target_m: tuple[float, float, float]
    splats: int  # exactly this many
    spacing_px: float  # between rays, at the focal length of the display
    window: float  # width of the ray grid relative to the frustum's, in tangents
    layer_shares: tuple[float, ...]  # probability that the 1st, 2nd, ... surface of a ray is kept
    spread: float  # standard deviation of a splat relative to the distance between neighbours
    aspect: float  # longest to shortest axis of a splat in its surface, at most
    smallest_leaf_m: float  # neighbours are not closer than this
    floater_share: float
    near_boxes: tuple[tuple[float, float, float, float, float], ...]
    # boxes near the eye: metres ahead, to the right, above the carriageway; edge, height
    expected: dict[str, tuple[float, float]]  # band of every statistic at full size

    display: str = "prototype"
    near_m: float = 0.2
    sh_degree: int = 3

    def __post_init__(self) -> None:
        if not 1 <= self.splats <= 20_000_000:
            raise InputError(f"view splats must lie in 1..20000000, not {self.splats}")
        for name in ("spacing_px", "spread", "smallest_leaf_m"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"view {name} must be a positive number, not {value}")
        for name in ("window", "aspect"):
            if not getattr(self, name) >= 1:
                raise InputError(f"view {name} must be >= 1, not {getattr(self, name)}")
        shares = (*self.layer_shares, self.floater_share)
        if len(self.layer_shares) != LAYERS or not all(0 <= share <= 1 for share in shares):
            raise InputError(
                f"view needs {LAYERS} layer_shares, and a floater_share, in 0..1, not {shares}"
            )
        if self.display not in DISPLAYS:
            raise InputError(
                f"view display must be one of {', '.join(DISPLAYS)}, not {self.display}"
            )


def benchmark_scene(view: BenchmarkView) -> tuple[Scene, StereoRig]:
    """The scene of a benchmark view and the rig that looks at it; same bits for the same view.

    Raises InputError when the rays leave fewer splats than the view asks for.
    """
    rng = np.random.Generator(np.random.PCG64(view.seed))
    below = np.array([view.eye_m[0], view.eye_m[1], 0.0])
    pose = look_at(np.array(view.eye_m) - below, np.array(view.target_m) - below, _UP)
    rig = StereoRig(DISPLAYS[view.display], pose, near_m=view.near_m)
    d = rig.display
    half_width, half_height = (
        view.window * 0.5 * d.width / d.fx,
        view.window * 0.5 * d.height / d.fy,
    )
    grid = RayGrid.over(rng, half_width, half_height, view.spacing_px / d.fx)
    geometry = _geometry(rng, view).moved(-below)
    hits = _hits(rng, geometry, pose, grid, view)
    floaters = round(view.floater_share * view.splats)
    wanted = view.splats - floaters
    if len(hits.depths) < wanted:
        raise InputError(
            f"view {view.name!r}: its rays leave {len(hits.depths)} splats, fewer than {wanted}; "
            f"spacing_px must be smaller"
        )
    hits = hits.take(np.sort(rng.permutation(len(hits.depths))[:wanted]))
    solid = _solid(rng, geometry, pose, grid, hits, view)
    free = _floaters(rng, pose, (half_width, half_height), floaters, d.fx)
    return assemble(rng, [*solid, free], view.sh_degree)[0], rig


@dataclass(frozen=True)
class _Hits:
    """H places where rays meet surfaces or leaves."""

    rays: Float64  # [H, 3] camera axes, z = 1
    depths: Float64  # [H] metres
    what: Ids  # [H] rectangle, or number of rectangles + crown
    spacing: Float64  # [H] metres between neighbours on the surface

    def take(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> _Hits:
        return _Hits(self.rays[rows], self.depths[rows], self.what[rows], self.spacing[rows])


def _geometry(rng: np.random.Generator, view: BenchmarkView) -> Geometry:
    """The town, and the boxes near the eye."""
    builder = GeometryBuilder(rng)
    add_town(builder)
    tints = ((0.62, 0.46, 0.28), (0.16, 0.30, 0.18), (0.75, 0.36, 0.10), (0.30, 0.32, 0.36))
    for index, (ahead, right, base, edge, height) in enumerate(view.near_boxes):
        centre = (view.eye_m[0] + ahead, view.eye_m[1] - right)
        size = (edge, edge, height)
        builder.box(centre, base, size, Material.WALL, tints[index % len(tints)])
    return builder.build()


def _hits(
    rng: np.random.Generator, geometry: Geometry, pose: Pose, grid: RayGrid, view: BenchmarkView
) -> _Hits:
    depths, what = cast(geometry, pose, grid, view.near_m)
    kept = (what >= 0) & (rng.random(depths.shape) < np.array(view.layer_shares))
    rows, columns, layers = np.nonzero(kept)
    rays = grid.directions[rows, columns]
    z, ids = depths[rows, columns, layers], what[rows, columns, layers].astype(np.int64)
    normals = rotated(geometry.patches.normals, pose.rotation.T)
    patches = ids < len(normals)
    cosine = np.ones(len(ids))
    nx, ny, nz = normals[ids[patches]].T
    rx, ry, _ = rays[patches].T
    cosine[patches] = np.maximum(np.abs(nx * rx + ny * ry + nz), _GRAZING)
    spacing = z * grid.step / np.sqrt(cosine)
    share = spacing / view.smallest_leaf_m
    dense = rng.random(len(ids)) < share * share  # thin out what is finer than the smallest leaf
    return _Hits(rays, z, ids, np.maximum(spacing, view.smallest_leaf_m)).take(dense)


def _solid(
    rng: np.random.Generator,
    geometry: Geometry,
    pose: Pose,
    grid: RayGrid,
    hits: _Hits,
    view: BenchmarkView,
) -> list[Chunk]:
    """Surface splats and leaves at the hits."""
    patches, crowns = geometry.patches, geometry.crowns
    shape = Shape(view.spread, view.aspect, turn=0.4, jitter=0.1)
    points = pose.position + rotated(hits.rays * hits.depths[:, None], pose.rotation)
    opacities = np.where(
        rng.random(len(points)) < OPAQUE_SHARE / (1.0 - view.floater_share),
        opaque(rng, len(points)),
        translucent(rng, len(points)),
    )
    flat = np.flatnonzero(hits.what < len(patches))
    ids = hits.what[flat]
    offset = points[flat] - patches.origins[ids]
    place = _dot(offset, patches.axis_u[ids]), _dot(offset, patches.axis_v[ids])
    spread = view.spread * hits.spacing[flat]
    surface = surface_splats(rng, patches, ids, place, spread, opacities[flat], shape)
    leafy = np.flatnonzero(hits.what >= len(patches))
    ids = hits.what[leafy] - len(patches)
    inside = (points[leafy] - crowns.centres[ids]) / crowns.radii[ids]
    spread = view.spread * hits.spacing[leafy]
    return [surface, leaf_splats(rng, crowns, ids, inside, spread, opacities[leafy])]


def _floaters(
    rng: np.random.Generator, pose: Pose, window: tuple[float, float], count: int, focal: float
) -> Chunk:
    """Faint blobs before the eye, as many in each octave of depth, none below the ground."""
    octave = _FLOATER_OCTAVES * rng.random(count)
    whole = np.floor(octave)
    depth = (
        _FLOATER_NEAREST_M
        * np.array([2.0**k for k in range(_FLOATER_OCTAVES)])[whole.astype(np.int64)]
    )
    depth *= 1.0 + (octave - whole)
    rays = np.ones((count, 3))
    rays[:, :2] = (2.0 * rng.random((count, 2)) - 1.0) * np.array(window)
    means = pose.position + rotated(rays * depth[:, None], pose.rotation)
    means[:, 2] = np.abs(means[:, 2]) + 0.05
    spread = depth / focal * (1.0 + 5.0 * rng.random(count))
    opacities = FAINTEST + 0.06 * rng.random(count)
    colours = 0.35 + 0.4 * rng.random((count, 1)) + 0.15 * rng.random((count, 3))
    return blobs(rng, means, spread, opacities, colours, (1.0, 0.7, 0.5))


def _dot(a: Float64, b: Float64) -> Float64:
    return (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]) + a[:, 2] * b[:, 2]
