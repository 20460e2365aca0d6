"""What hostile scenes are put together from: a rig of round numbers, and groups of Gaussians."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from gaussians.cameras import Display, Pose, StereoRig
from gaussians.scene import Scene, normalised_quaternions

Float64 = NDArray[np.float64]

ORIGIN = Pose(np.zeros(3), np.eye(3))
F_PX, BASELINE_M = 128.0, 0.0625
BF = F_PX * BASELINE_M  # disparity times depth: 8 px m, exact for round numbers


def straight_rig(
    width: int = 96,
    height: int = 64,
    *,
    baseline_m: float = BASELINE_M,
    near_m: float = 0.2,
    pose: Pose = ORIGIN,
) -> StereoRig:
    """On-axis rig of f = 128 px."""
    display = Display(width, height, F_PX, F_PX, 0.5 * width, 0.5 * width, 0.5 * height)
    return StereoRig(display, pose, baseline_m, near_m)


def seen_at(rig: StereoRig, columns: ArrayLike, rows: ArrayLike, depths: ArrayLike) -> Float64:
    """[N, 3] the points that the left eye sees at these pixel coordinates and depths."""
    d = rig.display
    u, v, z = np.broadcast_arrays(*(np.asarray(a, np.float64) for a in (columns, rows, depths)))
    x = (u - d.cx_left) / d.fx * z - 0.5 * rig.baseline_m
    return np.stack([x, (v - d.cy) / d.fy * z, z], axis=-1).reshape(-1, 3)


def roll(angles: ArrayLike) -> Float64:
    """[N, 4] rotations about the viewing axis."""
    half = 0.5 * np.atleast_1d(angles)
    return np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)


def yaw(angles: ArrayLike) -> Float64:
    """[N, 4] rotations about the vertical."""
    half = 0.5 * np.atleast_1d(angles)
    return np.stack([np.cos(half), 0 * half, np.sin(half), 0 * half], axis=1)


def gaussians(
    rng: Generator,
    rig: StereoRig,
    positions: Float64,
    scales: ArrayLike,
    opacities: ArrayLike,
    *,
    turns: ArrayLike = (1.0, 0.0, 0.0, 0.0),
    sh: tuple[int, float] = (0, 0.0),
) -> Scene:
    """Random colours; ``scales`` [N, 3] metres, ``sh`` is the degree and its standard deviation."""
    count, (degree, strength) = len(positions), sh
    harmonics = rng.normal(0.0, strength, (count, (degree + 1) ** 2, 3))
    harmonics[:, 0] = rng.uniform(-1.7, 1.7, (count, 3))
    return Scene(
        (positions @ rig.pose.rotation.T + rig.pose.position).astype(np.float32),
        normalised_quaternions(np.broadcast_to(turns, (count, 4)), "hostile scene"),
        np.broadcast_to(scales, (count, 3)).astype(np.float32),
        np.broadcast_to(opacities, count).astype(np.float32),
        harmonics.astype(np.float32),
    )


def dots(
    rng: Generator, rig: StereoRig, positions: Float64, opacities: ArrayLike, size_px: ArrayLike
) -> Scene:
    """Balls of this standard deviation in pixels, before the dilation."""
    sizes = np.atleast_1d(size_px) * positions[:, 2] / rig.display.fx
    return gaussians(rng, rig, positions, sizes[:, None], opacities)


def clutter(
    rng: Generator,
    rig: StereoRig,
    count: int,
    depths: tuple[float, float],
    sh: tuple[int, float] = (1, 0.2),
) -> Scene:
    """Ellipsoids of 0.3 to 5 px all over both windows and around them, log-uniform in depth."""
    d = rig.display
    z = np.exp(rng.uniform(np.log(depths[0]), np.log(depths[1]), count))
    low, high = min(0.0, d.window_offset_px), max(0.0, d.window_offset_px)
    reach = rng.uniform(low - 0.2 * d.width, high + 1.2 * d.width + rig.baseline_m * d.fx / z)
    positions = seen_at(rig, reach, rng.uniform(-0.1, 1.1, count) * d.height, z)
    sizes = np.exp(rng.uniform(np.log(0.3), np.log(5.0), (count, 3))) * (z / d.fx)[:, None]
    turns, opacities = rng.normal(size=(count, 4)), rng.beta(0.8, 1.2, count)
    return gaussians(rng, rig, positions, sizes, opacities, turns=turns, sh=sh)
