"""Projection of 3D Gaussians to both image planes (EWA splatting; formulas in conventions.md)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.cameras import StereoRig
from gaussians.constants import (
    CONIC_A,
    CONIC_B,
    CONIC_C,
    DILATION_PX2,
    OPACITY,
    OPACITY_MIN,
    THRESHOLD,
    U,
    V,
)
from gaussians.float32_math import ln_float64
from gaussians.lanes import prefetch
from gaussians.parallel import run_chunks
from gaussians.scene import Scene
from gaussians.sorting import depth_order

Float32 = NDArray[np.float32]

_ONE, _TWO = np.float32(1), np.float32(2)
_RECORD = 16  # float32 words of a feature record: 64 bytes, so that one line holds its 10 features
_AHEAD = 16  # splats whose scattered numbers are asked for in advance
_INFINITY = np.float32(np.inf)


@dataclass(frozen=True)
class ProjectedSplats:
    """The splats that survive the culls, in drawing order; row number = *rank*."""

    ids: NDArray[np.int32]  # [M] rank -> id in the scene
    depths: Float32  # [M] z in metres, the same bits in both eyes
    # [eyes, M, 16] u, v, conic A B C, threshold, opacity, red, green, blue; the rest is zero
    features: Float32
    covariances: Float32  # [eyes, M, 3] cxx, cxy, cyy in px^2
    behind_near: int
    transparent: int
    degenerate: int

    @property
    def eyes(self) -> int:
        """1 (left only) or 2."""
        return len(self.features)


class _Job(NamedTuple):
    """What the kernel reads of rig and scene, and what it writes."""

    world_to_left: Float32  # [3, 4]
    baseline: np.float32
    fx: np.float32
    fy: np.float32
    cx_left: np.float32
    cx_right: np.float32
    cy: np.float32
    limit_x: np.float32
    limit_y: np.float32
    ids: NDArray[np.int32]  # [M]
    means: Float32
    quaternions: Float32
    scales: Float32
    opacities: Float32
    features: Float32  # [eyes, M, 16], written
    covariances: Float32  # [eyes, M, 3], written
    keep: NDArray[np.bool_]  # [M], written


@njit(cache=True, error_model="numpy")
def _threshold(opacity: np.float32) -> np.float32:
    """-ln(255 o) in float64, rounded up to float32."""
    exact = -ln_float64(255.0 * np.float64(opacity))
    rounded = np.float32(exact)
    if np.float64(rounded) < exact:
        rounded = np.nextafter(rounded, _INFINITY)
    return rounded


@njit(cache=True, error_model="numpy")
def _to_camera(world_to_left: Float32, quaternion: Float32, scale: Float32, t: Float32) -> None:
    """t [3, 3] = camera rotation x splat rotation x scales, in the written order."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    m00 = (_ONE - _TWO * (y * y + z * z)) * scale[0]
    m01 = (_TWO * (x * y - w * z)) * scale[1]
    m02 = (_TWO * (x * z + w * y)) * scale[2]
    m10 = (_TWO * (x * y + w * z)) * scale[0]
    m11 = (_ONE - _TWO * (x * x + z * z)) * scale[1]
    m12 = (_TWO * (y * z - w * x)) * scale[2]
    m20 = (_TWO * (x * z - w * y)) * scale[0]
    m21 = (_TWO * (y * z + w * x)) * scale[1]
    m22 = (_ONE - _TWO * (x * x + y * y)) * scale[2]
    for i in range(3):
        r0, r1, r2 = world_to_left[i, 0], world_to_left[i, 1], world_to_left[i, 2]
        t[i, 0] = (r0 * m00 + r1 * m10) + r2 * m20
        t[i, 1] = (r0 * m01 + r1 * m11) + r2 * m21
        t[i, 2] = (r0 * m02 + r1 * m12) + r2 * m22


@njit(cache=True, error_model="numpy", nogil=True)
def _project(begin: int, end: int, job: _Job) -> None:
    r = job.world_to_left
    t = np.empty((3, 3), np.float32)
    for rank in range(begin, end):
        ahead = np.intp(job.ids[min(rank + _AHEAD, end - 1)])
        prefetch(job.means, 3 * ahead)
        prefetch(job.quaternions, 4 * ahead)
        prefetch(job.scales, 3 * ahead)
        prefetch(job.opacities, ahead)
        i = job.ids[rank]
        mx, my, mz = job.means[i, 0], job.means[i, 1], job.means[i, 2]
        x_left = ((r[0, 0] * mx + r[0, 1] * my) + r[0, 2] * mz) + r[0, 3]
        y = ((r[1, 0] * mx + r[1, 1] * my) + r[1, 2] * mz) + r[1, 3]
        z = ((r[2, 0] * mx + r[2, 1] * my) + r[2, 2] * mz) + r[2, 3]
        _to_camera(r, job.quaternions[i], job.scales[i], t)
        kx = job.fx / z
        ky = job.fy / z
        ty = y / z
        clamped_y = min(max(ty, -job.limit_y), job.limit_y)
        b0 = t[1, 0] - clamped_y * t[2, 0]
        b1 = t[1, 1] - clamped_y * t[2, 1]
        b2 = t[1, 2] - clamped_y * t[2, 2]
        cyy = (ky * ky) * ((b0 * b0 + b1 * b1) + b2 * b2) + DILATION_PX2
        v = job.fy * ty + job.cy
        threshold = _threshold(job.opacities[i])
        good = True
        for eye in range(2):
            x_eye = x_left - job.baseline if eye == 1 else x_left
            cx = job.cx_right if eye == 1 else job.cx_left
            tx = x_eye / z
            clamped_x = min(max(tx, -job.limit_x), job.limit_x)
            a0 = t[0, 0] - clamped_x * t[2, 0]
            a1 = t[0, 1] - clamped_x * t[2, 1]
            a2 = t[0, 2] - clamped_x * t[2, 2]
            cxx = (kx * kx) * ((a0 * a0 + a1 * a1) + a2 * a2) + DILATION_PX2
            cxy = (kx * ky) * ((a0 * b0 + a1 * b1) + a2 * b2)
            wide_xx, wide_xy, wide_yy = np.float64(cxx), np.float64(cxy), np.float64(cyy)
            det = wide_xx * wide_yy - wide_xy * wide_xy
            if not (det > 0.0 and det < np.inf):
                good = False
                continue
            if eye >= job.features.shape[0]:
                continue
            job.covariances[eye, rank, 0] = cxx
            job.covariances[eye, rank, 1] = cxy
            job.covariances[eye, rank, 2] = cyy
            record = job.features[eye, rank]
            record[U] = job.fx * tx + cx
            record[V] = v
            record[CONIC_A] = np.float32(wide_yy / det)
            record[CONIC_B] = np.float32(-wide_xy / det)
            record[CONIC_C] = np.float32(wide_xx / det)
            record[THRESHOLD] = threshold
            record[OPACITY] = job.opacities[i]
        job.keep[rank] = good


def camera_depths(scene: Scene, rig: StereoRig) -> Float32:
    """[N] float32 depth z of every mean, in the written order of operations."""
    r = rig.world_to_left[2]
    x, y, z = scene.means[:, 0], scene.means[:, 1], scene.means[:, 2]
    return ((r[0] * x + r[1] * y) + r[2] * z) + r[3]


def project(scene: Scene, rig: StereoRig, *, eyes: int = 2) -> ProjectedSplats:
    """Cull, sort by depth and project; colours (features 7 to 9) are left at zero.

    Depth, opacity and determinant culls are decided once for both eyes and counted, also with
    ``eyes=1``, which keeps the results of the left eye only.
    """
    depths = camera_depths(scene, rig)
    in_front = (depths >= np.float32(rig.near_m)) & (depths < np.inf)
    opaque = scene.opacities >= OPACITY_MIN
    ids = np.flatnonzero(in_front & opaque).astype(np.int32)
    ids = depth_order(depths[ids], ids)
    count = len(ids)
    features = np.zeros((eyes, count, _RECORD), np.float32)
    covariances = np.zeros((eyes, count, 3), np.float32)
    keep = np.zeros(count, np.bool_)
    limit_x, limit_y = rig.jacobian_limits
    job = _Job(
        world_to_left=rig.world_to_left,
        baseline=np.float32(rig.baseline_m),
        fx=np.float32(rig.display.fx),
        fy=np.float32(rig.display.fy),
        cx_left=np.float32(rig.display.cx_left),
        cx_right=np.float32(rig.display.cx_right),
        cy=np.float32(rig.display.cy),
        limit_x=np.float32(limit_x),
        limit_y=np.float32(limit_y),
        ids=ids,
        means=scene.means,
        quaternions=scene.quaternions,
        scales=scene.scales,
        opacities=scene.opacities,
        features=features,
        covariances=covariances,
        keep=keep,
    )
    run_chunks(_project, count, job)
    if not keep.all():
        ids = ids[keep]
        features = np.ascontiguousarray(features[:, keep])
        covariances = np.ascontiguousarray(covariances[:, keep])
    return ProjectedSplats(
        ids=ids,
        depths=depths[ids],
        features=features,
        covariances=covariances,
        behind_near=int((~in_front).sum()),
        transparent=int((in_front & ~opaque).sum()),
        degenerate=count - len(ids),
    )
