"""From sampled points to Gaussians: orientation, size, opacity mix, spherical harmonics."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gaussians.constants import SH_C0
from gaussians.errors import InputError
from gaussians.scene import Scene
from gaussians.synthetic.noise import beta_like, near_normal, unit_vectors
from gaussians.synthetic.patches import Crowns, Patches
from gaussians.synthetic.textures import leaf_colours, surface_colours

Float64 = NDArray[np.float64]
Ids = NDArray[np.int64]

OPAQUE_SHARE = 0.40  # of all splats; the others follow Beta(0.8, 2.8)
FAINTEST = 0.006  # trained scenes are pruned just above 1/255
_THICKNESS = 0.12  # of a surface splat, relative to its spread
_OFF_SURFACE_M = 0.03  # centres scatter off their surface by no more
_LONGEST = 3.0  # growth along a narrow rectangle; longer splats smear at the image edge
_SH_AMPLITUDE = 0.06  # standard deviation of the coefficients of degree l is this / l
_SH_LOBES = 256  # materials share reflection lobes; half of the variance is per splat


@dataclass(frozen=True)
class Chunk:
    """Q Gaussians before spherical harmonics."""

    means: Float64  # [Q, 3]
    quaternions: Float64  # [Q, 4] unit
    scales: Float64  # [Q, 3]
    opacities: Float64  # [Q]
    colours: Float64  # [Q, 3] seen head-on
    lobes: Ids  # [Q] 0 .. 255, which reflection lobe the material has


@dataclass(frozen=True)
class Shape:
    """How splats of one kind lie on their surface."""

    reach: float  # spread (standard deviation) relative to the distance between neighbours
    aspect: float  # longest to shortest axis in the surface, at most
    turn: float  # tangent of the largest half-angle by which they are turned in the surface
    jitter: float  # standard deviation off the surface, relative to the spread


def opaque(rng: np.random.Generator, count: int) -> Float64:
    """[count] opacities near 1."""
    return 0.90 + 0.095 * rng.random(count)


def translucent(rng: np.random.Generator, count: int) -> Float64:
    """[count] opacities like Beta(0.8, 2.8), at least FAINTEST."""
    return np.maximum(beta_like(rng, count), FAINTEST)


def surface_splats(
    rng: np.random.Generator,
    patches: Patches,
    ids: Ids,
    place: tuple[Float64, Float64],
    spread: Float64,
    opacities: Float64,
    shape: Shape,
) -> Chunk:
    """Flat Gaussians at ``place`` = (u, v) [Q] metres on the rectangles ``ids`` [Q].

    ``spread`` [Q] is the standard deviation in metres that leaves no gaps. Across a rectangle
    narrower than that the splat shrinks, and grows along it instead; centres keep off the edges, so
    that silhouettes stay sharp.
    """
    count = len(ids)
    lengths = patches.lengths[ids]
    stretch = np.sqrt(1.0 + (shape.aspect - 1.0) * rng.random(count))
    stretch = np.where(rng.random(count) < 0.5, stretch, 1.0 / stretch)
    wanted = np.stack([spread * stretch, spread / stretch], axis=1)
    sigma = np.minimum(wanted, 0.42 * lengths)
    lost = np.minimum(wanted / sigma, _LONGEST)[:, ::-1]
    sigma = np.minimum(sigma * lost, 0.42 * lengths)
    margin = np.minimum(sigma, 0.5 * lengths)
    where = np.clip(np.stack(place, axis=1), margin, lengths - margin)
    colours = surface_colours(patches, ids, place[0], place[1])
    depth = near_normal(rng, (count,)) * shape.jitter * spread
    lift = np.clip(depth, -_OFF_SURFACE_M, _OFF_SURFACE_M)
    means = patches.origins[ids] + lift[:, None] * patches.normals[ids]
    means += where[:, :1] * patches.axis_u[ids] + where[:, 1:] * patches.axis_v[ids]
    turned = (rng.random(count) * 2.0 - 1.0) * shape.turn * (lost.max(axis=1) <= 1.0)
    quaternions = _turned_about_z(_frame_quaternions(patches)[ids], turned)
    thin = np.maximum(_THICKNESS * sigma.min(axis=1), 5e-4)
    scales = np.column_stack([sigma, thin])
    return Chunk(means, quaternions, scales, opacities, colours, _lobes(patches.seeds[ids]))


def leaf_splats(
    rng: np.random.Generator,
    crowns: Crowns,
    ids: Ids,
    inside: Float64,
    spread: Float64,
    opacities: Float64,
) -> Chunk:
    """Small randomly turned leaves at the places ``inside`` [Q, 3] of the crowns' unit balls."""
    count = len(ids)
    means = crowns.centres[ids] + inside * crowns.radii[ids]
    sigma = np.minimum(spread, 0.3 * crowns.radii[ids].min(axis=1))
    proportions = np.array([1.0, 0.6, 0.2]) * (0.75 + 0.5 * rng.random((count, 1)))
    colours = leaf_colours(crowns.seeds[ids], crowns.tints[ids], inside, means)
    scales = sigma[:, None] * proportions
    return Chunk(
        means, unit_vectors(rng, count, 4), scales, opacities, colours, _lobes(crowns.seeds[ids])
    )


def blobs(
    rng: np.random.Generator,
    means: Float64,
    spread: Float64,
    opacities: Float64,
    colours: Float64,
    proportions: tuple[float, float, float],
) -> Chunk:
    """Free Gaussians in random orientation: sky, floaters."""
    count = len(means)
    scales = spread[:, None] * np.array(proportions)
    lobes = rng.integers(_SH_LOBES, size=count)
    return Chunk(means, unit_vectors(rng, count, 4), scales, opacities, colours, lobes)


def assemble(rng: np.random.Generator, chunks: list[Chunk], sh_degree: int) -> tuple[Scene, Ids]:
    """All chunks in random order (trained files are in no order either), with harmonics; and that
    order.
    """
    if sh_degree not in (0, 1, 2, 3):
        raise InputError(f"sh_degree must be 0, 1, 2 or 3, not {sh_degree}")
    count = sum(len(c.means) for c in chunks)
    order = rng.permutation(count)
    means, quaternions, scales, opacities, colours = (
        np.concatenate([getattr(c, field) for c in chunks]).astype(np.float32)[order]
        for field in ("means", "quaternions", "scales", "opacities", "colours")
    )
    lobes = np.concatenate([c.lobes for c in chunks])[order]
    sh = _harmonics(rng, colours, lobes, sh_degree)
    return Scene(means, quaternions, scales, opacities, sh).validate("synthetic scene"), order


def _harmonics(
    rng: np.random.Generator, colours: NDArray[np.float32], lobes: Ids, degree: int
) -> NDArray[np.float32]:
    """[Q, (degree+1)**2, 3]: colour in degree 0, a mostly grey material lobe plus noise above."""
    sh = np.empty((len(colours), (degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (colours - np.float32(0.5)) / SH_C0
    if degree == 0:
        return sh
    amplitude = np.concatenate(
        [np.full(2 * level + 1, _SH_AMPLITUDE / level) for level in range(1, degree + 1)]
    ).astype(np.float32)
    half = np.float32(0.7071067811865476)
    palette = near_normal(rng, (_SH_LOBES, len(amplitude), 3)) * np.float32(0.6)
    palette += near_normal(rng, (_SH_LOBES, len(amplitude), 1)) * np.float32(0.8)
    palette *= amplitude[:, None] * half
    edges = [*range(0, len(colours), 65536), len(colours)]
    wide = amplitude[:, None] * (half * np.float32(3.4641016151377544))
    for low, high in pairwise(edges):
        noise = rng.random((high - low, len(amplitude), 3), np.float32) * np.float32(0.6)
        noise += rng.random((high - low, len(amplitude), 1), np.float32) * np.float32(0.8)
        noise = (noise - np.float32(0.7)) * wide
        sh[low:high, 1:] = noise + palette[lobes[low:high]]
    return sh


def _lobes(seeds: NDArray[np.uint32]) -> Ids:
    return (seeds >> np.uint32(24)).astype(np.int64)


def _turned_about_z(quaternions: Float64, tangent: Float64) -> Float64:
    """Quaternions times a turn about the local z axis by twice the angle with this tangent."""
    norm = np.sqrt(1.0 + tangent * tangent)
    c, s = 1.0 / norm, tangent / norm
    w, x, y, z = quaternions.T
    return np.stack([w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s], axis=1)


def _frame_quaternions(patches: Patches) -> Float64:
    """[M, 4] rotation that takes the axes x, y, z to axis_u, axis_v, normal.

    Of the four equivalent formulas (Shepperd 1978, DOI 10.2514/3.55767b) the one with the largest
    divisor is taken.
    """
    (a0, a1, a2), (b0, b1, b2) = patches.axis_u.T, patches.axis_v.T
    c0, c1, c2 = patches.normals.T
    rows = np.stack(
        [
            np.stack([1 + a0 + b1 + c2, b2 - c1, c0 - a2, a1 - b0]),
            np.stack([b2 - c1, 1 + a0 - b1 - c2, b0 + a1, c0 + a2]),
            np.stack([c0 - a2, b0 + a1, 1 - a0 + b1 - c2, c1 + b2]),
            np.stack([a1 - b0, c0 + a2, c1 + b2, 1 - a0 - b1 + c2]),
        ]
    )  # [formula, component, M]
    best = np.argmax(rows[[0, 1, 2, 3], [0, 1, 2, 3]], axis=0)
    chosen = rows[best, :, np.arange(len(best))]
    w, x, y, z = chosen.T
    return chosen / np.sqrt(w * w + x * x + y * y + z * z)[:, None]
