"""Geometry of the synthetic worlds: textured rectangles and leafy ellipsoids, nothing else.

Boxes, poles, kerbs, house fronts and the ground are rectangles; tree crowns are ellipsoids full of
leaves. Both the city generator and the view-dependent benchmark scenes sample this geometry.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Vector = tuple[float, float, float]
Colour = tuple[float, float, float]


class Material(IntEnum):
    """Which procedural texture a rectangle carries (textures.py)."""

    PLAIN = 0
    ASPHALT = 1
    ROAD = 2  # asphalt with a dashed centre line and edge lines along u
    ZEBRA = 3
    PAVEMENT = 4
    GRASS = 5
    FACADE = 6
    WALL = 7
    ROOF = 8
    BARK = 9
    STRIPES = 10
    CAR_SIDE = 11


@dataclass(frozen=True)
class Patches:
    """M rectangles ``origin + u*axis_u + v*axis_v`` with 0 <= u <= length_u, 0 <= v <= length_v.

    ``axis_u``, ``axis_v`` and ``normals`` = axis_u x axis_v are orthonormal; the normal points to
    the side from which the rectangle is meant to be seen.
    """

    origins: Float64  # [M, 3] metres, world, z up
    axis_u: Float64  # [M, 3]
    axis_v: Float64  # [M, 3]
    lengths: Float64  # [M, 2] metres along u and v
    materials: NDArray[np.int64]  # [M] Material
    tints: Float64  # [M, 3] base colour, 0..1
    seeds: NDArray[np.uint32]  # [M] seed of the texture
    exposures: Float64  # [M] >= 0, how much of it a walker gets to see: drives density

    def __len__(self) -> int:
        return len(self.origins)

    @property
    def normals(self) -> Float64:
        """[M, 3] unit normals."""
        a, b = self.axis_u, self.axis_v
        return np.stack(
            [
                a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
                a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
                a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
            ],
            axis=1,
        )


@dataclass(frozen=True)
class Crowns:
    """K axis-aligned ellipsoids filled with leaves."""

    centres: Float64  # [K, 3] metres
    radii: Float64  # [K, 3] metres
    tints: Float64  # [K, 3] base colour, 0..1
    seeds: NDArray[np.uint32]  # [K]
    exposures: Float64  # [K] as in Patches

    def __len__(self) -> int:
        return len(self.centres)


@dataclass(frozen=True)
class Geometry:
    """One synthetic world."""

    patches: Patches
    crowns: Crowns

    def moved(self, shift: Float64) -> Geometry:
        """The same world, shifted by ``shift`` [3] metres."""
        return Geometry(
            replace(self.patches, origins=self.patches.origins + shift),
            replace(self.crowns, centres=self.crowns.centres + shift),
        )


class GeometryBuilder:
    """Collects rectangles and crowns; every piece gets its own texture seed from ``rng``."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self._rectangles: list[tuple[object, ...]] = []
        self._crowns: list[tuple[object, ...]] = []

    def rectangle(
        self,
        origin: Vector,
        edge_u: Vector,
        edge_v: Vector,
        material: Material,
        tint: Colour,
        exposure: float = 1.0,
    ) -> None:
        """Add ``origin``, ``origin + edge_u``, ..., seen from the side of edge_u x edge_v."""
        seed = int(self.rng.integers(1 << 32))
        self._rectangles.append((origin, edge_u, edge_v, int(material), tint, seed, exposure))

    def floor(
        self,
        low: tuple[float, float],
        high: tuple[float, float],
        z: float,
        material: Material,
        tint: Colour,
        exposure: float = 1.0,
        *,
        along_y: bool = False,
    ) -> None:
        """Add a horizontal rectangle seen from above; texture u runs along x, or along y."""
        (x0, y0), (x1, y1) = low, high
        if along_y:
            corner, u, v = (x1, y0, z), (0.0, y1 - y0, 0.0), (x0 - x1, 0.0, 0.0)
        else:
            corner, u, v = (x0, y0, z), (x1 - x0, 0.0, 0.0), (0.0, y1 - y0, 0.0)
        self.rectangle(corner, u, v, material, tint, exposure)

    def box(
        self,
        centre: tuple[float, float],
        base_z: float,
        size: Vector,
        material: Material,
        tint: Colour,
        exposure: float = 1.0,
        *,
        top: Material | None = None,
    ) -> None:
        """Add an axis-parallel box without its underside: four upright sides and a lid."""
        hx, hy, height = 0.5 * size[0], 0.5 * size[1], size[2]
        corners = [(-hx, -hy), (hx, -hy), (hx, hy), (-hx, hy)]
        for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
            foot = (centre[0] + ax, centre[1] + ay, base_z)
            self.rectangle(
                foot, (bx - ax, by - ay, 0.0), (0.0, 0.0, height), material, tint, exposure
            )
        low = (centre[0] - hx, centre[1] - hy)
        high = (centre[0] + hx, centre[1] + hy)
        lid = material if top is None else top
        self.floor(low, high, base_z + height, lid, tint, exposure)

    def post(
        self,
        foot: Vector,
        radius: float,
        height: float,
        material: Material,
        tint: Colour,
        exposure: float = 1.0,
    ) -> None:
        """Add an upright hexagonal prism, open at both ends."""
        half = 0.5 * radius
        wide = 0.8660254037844386 * radius
        ring = [(radius, 0.0), (half, wide), (-half, wide), (-radius, 0.0), (-half, -wide)]
        ring.append((half, -wide))
        for (ax, ay), (bx, by) in zip(ring, ring[1:] + ring[:1], strict=True):
            origin = (foot[0] + ax, foot[1] + ay, foot[2])
            self.rectangle(
                origin, (bx - ax, by - ay, 0.0), (0.0, 0.0, height), material, tint, exposure
            )

    def crown(self, centre: Vector, radii: Vector, tint: Colour, exposure: float = 1.0) -> None:
        """Add a leafy ellipsoid."""
        self._crowns.append((centre, radii, tint, int(self.rng.integers(1 << 32)), exposure))

    def build(self) -> Geometry:
        """Freeze everything collected so far into arrays."""
        columns = list(zip(*self._rectangles, strict=True))
        edge_u, edge_v = (np.array(columns[i], np.float64).reshape(-1, 3) for i in (1, 2))
        length_u, length_v = _lengths(edge_u), _lengths(edge_v)
        patches = Patches(
            origins=np.array(columns[0], np.float64),
            axis_u=edge_u / length_u[:, None],
            axis_v=edge_v / length_v[:, None],
            lengths=np.stack([length_u, length_v], axis=1),
            materials=np.array(columns[3], np.int64),
            tints=np.array(columns[4], np.float64),
            seeds=np.array(columns[5], np.uint32),
            exposures=np.array(columns[6], np.float64),
        )
        return Geometry(patches, self._build_crowns())

    def _build_crowns(self) -> Crowns:
        columns = list(zip(*self._crowns, strict=True)) or [(), (), (), (), ()]
        centres, radii, tints = (np.array(columns[i], np.float64).reshape(-1, 3) for i in range(3))
        seeds, exposures = np.array(columns[3], np.uint32), np.array(columns[4], np.float64)
        return Crowns(centres, radii, tints, seeds, exposures)


def _lengths(vectors: Float64) -> Float64:
    x, y, z = vectors.T
    return np.sqrt(x * x + y * y + z * z)
