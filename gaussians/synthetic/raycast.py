"""What the rays of one eye hit: the nearest few surfaces per ray, for view-dependent sampling."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.cameras import Pose
from gaussians.synthetic.patches import Geometry

Float64 = NDArray[np.float64]

LAYERS = 4  # hits kept per ray
_NOTHING = np.int32(-1)
_TUFTS = 2  # leaves a ray may meet in one crown


@dataclass(frozen=True)
class RayGrid:
    """One jittered ray per cell of a window on the plane z = 1 in front of the eye."""

    half_width: float  # tangent
    half_height: float
    step: float  # tangent between neighbouring rays
    jitter: Float64  # [ny, nx, 2] in 0..1, place of the ray within its cell

    @classmethod
    def over(
        cls, rng: np.random.Generator, half_width: float, half_height: float, step: float
    ) -> RayGrid:
        """Rays over the window |x| <= half_width, |y| <= half_height."""
        nx, ny = int(2 * half_width / step), int(2 * half_height / step)
        return cls(half_width, half_height, step, rng.random((ny, nx, 2)))

    @property
    def directions(self) -> Float64:
        """[ny, nx, 3] in camera axes, z = 1, so that a length along a ray is a depth."""
        ny, nx = self.jitter.shape[:2]
        rays = np.ones((ny, nx, 3))
        rays[:, :, 0] = (np.arange(nx) + self.jitter[:, :, 0]) * self.step - self.half_width
        rays[:, :, 1] = (np.arange(ny)[:, None] + self.jitter[:, :, 1]) * self.step - (
            self.half_height
        )
        return rays


def cast(
    geometry: Geometry, pose: Pose, grid: RayGrid, near_m: float
) -> tuple[Float64, NDArray[np.int32]]:
    """Depths [ny, nx, LAYERS] in metres, nearest first, and what was hit [ny, nx, LAYERS] int32.

    A hit is the index of a rectangle, or the number of rectangles plus the index of a crown; -1
    (depth infinite) where a ray meets nothing more. Rectangles are hit from both sides.
    """
    patches, crowns = geometry.patches, geometry.crowns
    shape = (*grid.jitter.shape[:2], LAYERS)
    depths, hits = np.full(shape, np.inf), np.full(shape, _NOTHING, np.int32)
    rays = grid.directions
    window = np.array([-grid.half_width, -grid.half_height, grid.step, near_m])
    origins = to_camera(patches.origins, pose)
    along_u = rotated(patches.axis_u * patches.lengths[:, :1], pose.rotation.T)
    along_v = rotated(patches.axis_v * patches.lengths[:, 1:], pose.rotation.T)
    _cast_rectangles(origins, along_u, along_v, rays, window, depths, hits)
    centres = to_camera(crowns.centres, pose)
    first = len(patches)
    _cast_crowns(centres, crowns.radii, pose.rotation, first, rays, window, depths, hits)
    return depths, hits


def rotated(vectors: Float64, rotation: Float64) -> Float64:
    """[Q, 3] rotation times every vector, in an order of operations that no library changes."""
    x, y, z = vectors.T
    return np.stack([(r[0] * x + r[1] * y) + r[2] * z for r in rotation], axis=1)


def to_camera(points: Float64, pose: Pose) -> Float64:
    """[Q, 3] world points in the axes of the pose."""
    return rotated(points - pose.position, pose.rotation.T)


@njit(cache=True, error_model="numpy")
def _insert(depths: Float64, hits: NDArray[np.int32], j: int, i: int, z: float, what: int) -> None:
    k = depths.shape[2] - 1
    if not z < depths[j, i, k]:
        return
    while k > 0 and depths[j, i, k - 1] > z:
        depths[j, i, k] = depths[j, i, k - 1]
        hits[j, i, k] = hits[j, i, k - 1]
        k -= 1
    depths[j, i, k] = z
    hits[j, i, k] = what


@njit(cache=True, error_model="numpy")
def _cells(
    low_x: float,
    high_x: float,
    low_y: float,
    high_y: float,
    window: Float64,
    shape: tuple[int, int, int],
) -> tuple[int, int, int, int]:
    """First and last column and row of the ray cells that a box of tangents covers."""
    step = window[2]
    i0 = max(np.floor((low_x - window[0]) / step), 0.0)
    i1 = min(np.floor((high_x - window[0]) / step), shape[1] - 1.0)
    j0 = max(np.floor((low_y - window[1]) / step), 0.0)
    j1 = min(np.floor((high_y - window[1]) / step), shape[0] - 1.0)
    return int(i0), int(i1), int(j0), int(j1)


@njit(cache=True, error_model="numpy")
def _cast_rectangles(
    origins: Float64,
    along_u: Float64,
    along_v: Float64,
    rays: Float64,
    window: Float64,
    depths: Float64,
    hits: NDArray[np.int32],
) -> None:
    near = window[3]
    corners = np.empty((4, 3))
    for g in range(len(origins)):
        o, u, v = origins[g], along_u[g], along_v[g]
        for a in range(3):
            corners[0, a] = o[a]
            corners[1, a] = o[a] + u[a]
            corners[2, a] = o[a] + u[a] + v[a]
            corners[3, a] = o[a] + v[a]
        low_x = low_y = np.inf
        high_x = high_y = -np.inf
        for k in range(4):  # outline clipped at the near plane
            p, q = corners[k], corners[(k + 1) % 4]
            for end in range(2):
                if end == 0 and p[2] >= near:
                    x, y = p[0] / p[2], p[1] / p[2]
                elif end == 1 and (p[2] >= near) != (q[2] >= near):
                    t = (near - p[2]) / (q[2] - p[2])
                    x, y = (p[0] + t * (q[0] - p[0])) / near, (p[1] + t * (q[1] - p[1])) / near
                else:
                    continue
                low_x, high_x = min(low_x, x), max(high_x, x)
                low_y, high_y = min(low_y, y), max(high_y, y)
        if not low_x <= high_x:
            continue
        i0, i1, j0, j1 = _cells(low_x, high_x, low_y, high_y, window, depths.shape)
        nx = u[1] * v[2] - u[2] * v[1]
        ny = u[2] * v[0] - u[0] * v[2]
        nz = u[0] * v[1] - u[1] * v[0]
        offset = (nx * o[0] + ny * o[1]) + nz * o[2]
        uu = (u[0] * u[0] + u[1] * u[1]) + u[2] * u[2]
        vv = (v[0] * v[0] + v[1] * v[1]) + v[2] * v[2]
        for j in range(j0, j1 + 1):
            for i in range(i0, i1 + 1):
                x, y = rays[j, i, 0], rays[j, i, 1]
                z = offset / ((nx * x + ny * y) + nz)
                if not (z >= near and z < depths[j, i, depths.shape[2] - 1]):
                    continue
                dx, dy, dz = x * z - o[0], y * z - o[1], z - o[2]
                s = (dx * u[0] + dy * u[1]) + dz * u[2]
                t = (dx * v[0] + dy * v[1]) + dz * v[2]
                if s >= 0.0 and s <= uu and t >= 0.0 and t <= vv:
                    _insert(depths, hits, j, i, z, g)


@njit(cache=True, error_model="numpy")
def _cast_crowns(
    centres: Float64,
    radii: Float64,
    rotation: Float64,
    first: int,
    rays: Float64,
    window: Float64,
    depths: Float64,
    hits: NDArray[np.int32],
) -> None:
    near = window[3]
    for g in range(len(centres)):
        c, radius = centres[g], radii[g].max()
        if c[2] + radius < near:
            continue
        i0, i1, j0, j1 = 0, depths.shape[1] - 1, 0, depths.shape[0] - 1
        front, back = c[2] - radius, c[2] + radius
        if front >= near:
            i0, i1, j0, j1 = _cells(
                min((c[0] - radius) / front, (c[0] - radius) / back),
                max((c[0] + radius) / front, (c[0] + radius) / back),
                min((c[1] - radius) / front, (c[1] - radius) / back),
                max((c[1] + radius) / front, (c[1] + radius) / back),
                window,
                depths.shape,
            )
        for j in range(j0, j1 + 1):
            for i in range(i0, i1 + 1):
                x, y = rays[j, i, 0], rays[j, i, 1]
                bb = ab = aa = 0.0
                for a in range(3):
                    r = rotation[a]
                    b = ((r[0] * x + r[1] * y) + r[2]) / radii[g, a]
                    q = ((r[0] * c[0] + r[1] * c[1]) + r[2] * c[2]) / radii[g, a]
                    bb += b * b
                    ab += b * q
                    aa += q * q
                root = ab * ab - bb * (aa - 1.0)
                if not root > 0.0:
                    continue
                half = np.sqrt(root) / bb
                for k in range(_TUFTS):
                    wild = (x * 7919.0 + y * 104729.0) + (g * 0.6180339887498949 + k * 0.37)
                    z = ab / bb + half * (2.0 * (wild - np.floor(wild)) - 1.0)
                    if z >= near:
                        _insert(depths, hits, j, i, z, first + g)
