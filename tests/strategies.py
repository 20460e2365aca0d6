"""Small nasty scenes: values on the thresholds of the splatting mathematics, and rigs to see them.

A scene is a few *groups*, each of one kind and seed, so that a failing example shrinks to the kind
that matters. Positions are given in the head's axes (x right, y down, z forward); poses at the
origin with no rotation keep them exact to the bit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st
from numpy.random import Generator
from numpy.typing import NDArray

from gaussians.cameras import Display, Pose, StereoRig
from gaussians.scene import Scene

OPACITY_EDGE = np.float32(1 / 255)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Splat:
    """One Gaussian before it is put into a scene; position and axes in the head's frame."""

    position: tuple[float, float, float]
    scales: tuple[float, float, float]
    opacity: float
    quaternion: tuple[float, ...] = UPRIGHT


@dataclass(frozen=True)
class Case:
    """A scene, the rig that looks at it, and the background."""

    scene: Scene
    rig: StereoRig
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)


def at_pixel(rig: StereoRig, column: float, row: float, depth: float) -> tuple[float, float, float]:
    """The point whose left projection is (column, row) at this depth."""
    d = rig.display
    x = (column - d.cx_left) / d.fx * depth - 0.5 * rig.baseline_m
    return x, (row - d.cy) / d.fy * depth, depth


def _anywhere(rng: Generator, rig: StereoRig, depth: float) -> tuple[float, float, float]:
    """A point somewhere around the union of both windows."""
    d = rig.display
    offset = d.window_offset_px
    reach = max(offset, 0.0) + rig.baseline_m * d.fx / depth
    column = rng.uniform(min(offset, 0.0) - 0.3 * d.width, 1.3 * d.width + reach)
    return at_pixel(rig, column, rng.uniform(-0.2, 1.2) * d.height, depth)


def _quaternion(rng: Generator) -> tuple[float, ...]:
    q = rng.normal(size=4)
    return tuple(q / np.linalg.norm(q))


def _blob(rng: Generator, rig: StereoRig, depth: float, opacity: float) -> Splat:
    """A random ellipsoid of 0.2 to 6 px."""
    size = np.exp(rng.uniform(np.log(0.2), np.log(6.0), 3)) * depth / rig.display.fx
    return Splat(_anywhere(rng, rig, depth), tuple(size), opacity, _quaternion(rng))


def ordinary(rng: Generator, rig: StereoRig) -> list[Splat]:
    """What a trained scene looks like."""
    depths = rng.uniform(0.4, 8.0, 5)
    return [_blob(rng, rig, z, o) for z, o in zip(depths, rng.beta(0.8, 1.5, 5), strict=True)]


def opacity_at_the_edge(rng: Generator, rig: StereoRig) -> list[Splat]:
    """1/255 exactly, its neighbours, a little more, nothing at all; centred on pixel centres."""
    below = np.nextafter(OPACITY_EDGE, np.float32(0))
    above = np.nextafter(OPACITY_EDGE, np.float32(1))
    return [
        Splat(at_pixel(rig, rng.integers(0, 8) + 0.5, 2.5, 2.0), (0.01, 0.02, 0.01), float(o))
        for o in (OPACITY_EDGE, below, above, 1.001 * OPACITY_EDGE, 0.0)
    ]


def exponent_at_the_threshold(rng: Generator, rig: StereoRig) -> list[Splat]:
    """Dots on pixel centres whose threshold is, to the bit, the exponent at a neighbouring pixel.

    Exactly so for rigs whose numbers are short in binary; beside it, the opacities next to it.
    """
    dilation = np.float32(0.3)
    conic = np.float32(1.0 / np.float64(dilation))
    splats = []
    for distance2 in (1, 2, 4, 5, 8):
        exponent = np.float32(-0.5) * (conic * np.float32(distance2))
        opacity = np.float32(np.exp(-float(exponent)) / 255)
        for _ in range(int(rng.integers(0, 4))):
            opacity = np.nextafter(opacity, np.float32(9) * rng.integers(0, 2))
        column, row = rng.integers(2, 30) + 0.5, rng.integers(2, 20) + 0.5
        splats.append(Splat(at_pixel(rig, column, row, 1.0), (0.0, 0.0, 0.0), float(opacity)))
    return splats


def opacity_above_one(rng: Generator, rig: StereoRig) -> list[Splat]:
    """Merged level-of-detail parents."""
    return [_blob(rng, rig, rng.uniform(0.5, 5), o) for o in (1.0, 1.5, 44.0, 255.0)]


def wall(rng: Generator, rig: StereoRig) -> list[Splat]:
    """Opaque layers that stop pixels early, some of the layers in front only in one eye."""
    d = rig.display
    depths = np.sort(rng.uniform(0.6, 3.0, 5))
    half = 0.5 * d.width
    return [
        Splat(at_pixel(rig, rng.uniform(0, 2 * half), 0.5 * d.height, z), (z, z, 0.01), 1.0)
        for z in depths
    ]


def depth_ties(rng: Generator, rig: StereoRig) -> list[Splat]:
    """Equal depth bits; only the id decides who is in front."""
    return [_blob(rng, rig, 2.0, o) for o in (0.9, 0.8, 0.7, 0.95)]


def near_plane(rng: Generator, rig: StereoRig) -> list[Splat]:
    """On the near plane, one float in front of it, one behind."""
    near = np.float32(rig.near_m)
    depths = (near, np.nextafter(near, np.float32(0)), np.nextafter(near, np.float32(9)))
    return [_blob(rng, rig, float(z), 0.6) for z in depths]


def behind(rng: Generator, rig: StereoRig) -> list[Splat]:
    """Behind the camera, and in its plane."""
    depths = (-2.0, -rig.near_m, 0.0)
    return [Splat((rng.uniform(-1, 1), 0.1, z), (0.1, 0.1, 0.1), 0.9) for z in depths]


def zero_scales(rng: Generator, rig: StereoRig) -> list[Splat]:
    """Points, lines and discs: only the dilation of 0.3 px is left in some direction."""
    shapes = ((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), (0.1, 0.3, 0.0))
    return [Splat(_anywhere(rng, rig, 1.5), shape, 0.8, _quaternion(rng)) for shape in shapes]


def needles(rng: Generator, rig: StereoRig) -> list[Splat]:
    """Image covariance of condition 1e4 to 1e12: 50 px to 500 000 px long, half a pixel wide.

    Where it exceeds about 1e7, float32 may lose the determinant, in either eye or in one alone.
    """
    splats = []
    for i, length_px in enumerate(10.0 ** rng.uniform(1.7, 5.7, 4)):
        angle = rng.choice([0.0, np.pi / 4, rng.uniform(0, np.pi), 1e-3, np.pi / 2 - 1e-4])
        turn = (np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)) if i % 2 else _quaternion(rng)
        length = length_px * 2.0 / rig.display.fx
        splats.append(Splat(_anywhere(rng, rig, 2.0), (length, 0.0, 0.0), 0.9, turn))
    return splats


def far_needles(rng: Generator, rig: StereoRig) -> list[Splat]:
    """Needles centred far outside the image that still cross it."""
    splats = []
    for _ in range(4):
        target = at_pixel(
            rig, rng.uniform(0, rig.display.width), rng.uniform(0, rig.display.height), 3.0
        )
        angle = rng.uniform(0, np.pi)
        way = np.array([np.cos(angle), np.sin(angle), 0.0])
        length = 10.0 ** rng.uniform(0, 4)
        position = np.asarray(target) + way * length * rng.uniform(-3, 3)
        turn = (np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2))
        splats.append(Splat(tuple(position), (length, 1e-4, 1e-4), rng.uniform(0.01, 3), turn))
    return splats


def huge_at_the_near_plane(rng: Generator, rig: StereoRig) -> list[Splat]:
    """Gaussians much larger than their distance, reaching through the near plane."""
    splats = []
    for _ in range(4):
        depth = rig.near_m * rng.uniform(1.0, 1.5)
        scales = tuple(10.0 ** rng.uniform(-2, 2, 3))
        position = (rng.uniform(-3, 3), rng.uniform(-1, 1), depth)
        splats.append(Splat(position, scales, rng.uniform(0.01, 1.2), _quaternion(rng)))
    return splats


def left_of_the_left_image(rng: Generator, rig: StereoRig) -> list[Splat]:
    """Discs beside the window, edge-on to the left eye: in the right one they reach inside."""
    splats = []
    for _ in range(4):
        x, y, depth = at_pixel(
            rig, -rng.uniform(0.05, 0.15) * rig.display.width, 8.0, rig.near_m * rng.uniform(1, 2)
        )
        half_turn = 0.5 * np.arctan2(-depth, x + 0.5 * rig.baseline_m)
        turn = (np.cos(half_turn), 0.0, np.sin(half_turn), 0.0)  # local x axis along the left ray
        size = 10.0 ** rng.uniform(-1, 1)
        splats.append(Splat((x, y, depth), (size, 0.1, 0.0), rng.uniform(0.01, 1.0), turn))
    return splats


def between_centres(rng: Generator, rig: StereoRig) -> list[Splat]:
    """Faint dots on pixel corners, tile edges and pixel centres: hardly any centre is inside."""
    d = rig.display
    splats = []
    for _ in range(5):
        column = rng.integers(0, d.width + 1) + rng.choice([0.0, 0.5, 0.499, 0.25])
        row = rng.integers(0, d.height + 1) + rng.choice([0.0, 0.5, 0.501, 0.75])
        opacity = float(OPACITY_EDGE) * rng.choice([1.0001, 1.01, 1.2, 1.5, 1.52])
        splats.append(Splat(at_pixel(rig, column, row, 4.0), (0.0, 0.0, 0.0), opacity))
    return splats


def whole_tiles_of_disparity(rng: Generator, rig: StereoRig) -> list[Splat]:
    """Disparity a multiple of the tile (exact for power-of-two rigs), up to beyond the image."""
    d = rig.display
    splats = []
    for tiles in (1, 2, 4, rng.integers(5, 9), d.width // 4 + 1):
        wanted = rig.baseline_m * d.fx / (4.0 * float(tiles))
        depth = max(wanted, rig.near_m)
        column = rng.uniform(0, d.width) + d.window_offset_px * rng.integers(0, 2)
        position = at_pixel(rig, column, rng.uniform(0, d.height), depth)
        size = rng.uniform(0.3, 3.0) * depth / d.fx
        splats.append(Splat(position, (size, size, size), rng.uniform(0.1, 1.0)))
    return splats


def thin_lines(rng: Generator, rig: StereoRig) -> list[Splat]:
    """Faint upright lines between left pixel columns; most meet a column in the right eye."""
    splats = []
    for _ in range(4):
        column, disparity = float(rng.integers(0, rig.display.width + 8)), rng.integers(1, 20) + 0.5
        depth = max(rig.baseline_m * rig.display.fx / disparity, rig.near_m)
        position = at_pixel(rig, column, rng.uniform(0, rig.display.height), depth)
        length = rng.uniform(1.0, 10.0) * depth / rig.display.fx
        splats.append(Splat(position, (0.0, length, 0.0), float(OPACITY_EDGE) * 1.2))
    return splats


def outliers(rng: Generator, rig: StereoRig) -> list[Splat]:
    """Far away, far aside, and enormous."""
    return [
        Splat(_anywhere(rng, rig, 2e4), (500.0, 300.0, 1.0), 0.9, _quaternion(rng)),
        Splat((2e4, -3.0, 1.0), (3.0, 1.0, 1.0), 0.9, _quaternion(rng)),
        Splat((-1e6, 1e5, 2e4), (1e6, 1e2, 1e5), 0.5, _quaternion(rng)),
        Splat((0.1, 0.1, 1e9), (1e9, 1e9, 1e9), 0.3),
    ]


KINDS: dict[str, Callable[[Generator, StereoRig], list[Splat]]] = {
    kind.__name__: kind
    for kind in (
        ordinary,
        opacity_at_the_edge,
        exponent_at_the_threshold,
        opacity_above_one,
        wall,
        depth_ties,
        near_plane,
        behind,
        zero_scales,
        needles,
        far_needles,
        huge_at_the_near_plane,
        left_of_the_left_image,
        between_centres,
        whole_tiles_of_disparity,
        thin_lines,
        outliers,
    )
}


def build_scene(splats: list[Splat], rig: StereoRig, sh: NDArray[np.floating]) -> Scene:
    """The splats in world coordinates; ``sh`` [>= N, K, 3]."""
    count = len(splats)
    positions = np.array([s.position for s in splats], np.float64).reshape(count, 3)
    means = positions @ rig.pose.rotation.T + rig.pose.position
    return Scene(
        means.astype(np.float32),
        np.array([s.quaternion for s in splats], np.float32).reshape(count, 4),
        np.array([s.scales for s in splats], np.float32).reshape(count, 3),
        np.array([s.opacity for s in splats], np.float32),
        sh[:count].astype(np.float32),
    )


def build_case(
    groups: list[tuple[str, int]],
    rig: StereoRig,
    *,
    degree: int = 0,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    shuffle: int = 0,
) -> Case:
    """The groups (kind, seed) in shuffled order, at most 40 splats, with random colours."""
    splats = [s for kind, seed in groups for s in KINDS[kind](np.random.default_rng(seed), rig)]
    rng = np.random.default_rng(shuffle)
    splats = [splats[i] for i in rng.permutation(len(splats))][:40]
    sh = rng.normal(0.0, 0.5, (40, (degree + 1) ** 2, 3)) / (
        1 + np.arange((degree + 1) ** 2)[:, None]
    )
    return Case(build_scene(splats, rig, sh), rig, background)


ORIGIN = Pose(np.zeros(3), np.eye(3))


def turned_pose(seed: int) -> Pose:
    """A head somewhere else, looking somewhere else."""
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    if np.linalg.det(rotation) < 0:
        rotation[:, 0] *= -1
    return Pose(rng.normal(0, 20, 3), rotation)


def small_rig(
    width: int = 37,
    height: int = 29,
    *,
    focal: tuple[float, float] = (32.0, 32.0),
    offset_px: int = 0,
    baseline_m: float = 0.0625,
    pose: Pose = ORIGIN,
) -> StereoRig:
    """A rig of a few hundred pixels; ``offset_px`` is cx_left - cx_right."""
    cx_left = 0.5 * (width + offset_px)
    display = Display(width, height, *focal, cx_left, cx_left - offset_px, 0.5 * height)
    return StereoRig(display, pose, baseline_m=baseline_m, near_m=0.25)


def rigs() -> st.SearchStrategy[StereoRig]:
    """Displays up to 40 x 40, square pixels or not, on axis or not, with or without a baseline."""
    return st.builds(
        small_rig,
        st.sampled_from([37, 40, 16, 4, 1]),
        st.sampled_from([29, 16, 40, 5, 1]),
        focal=st.sampled_from([(32.0, 32.0), (64.0, 64.0), (37.3, 41.9), (16.0, 20.0)]),
        offset_px=st.sampled_from([0, 16, 48, -16, -48]),
        baseline_m=st.sampled_from([0.0625, 0.06, 0.6, 0.0]),
        pose=st.one_of(st.just(ORIGIN), st.integers(0, 999).map(turned_pose)),
    )


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """One to eight groups of any kinds."""
    groups = draw(
        st.lists(
            st.tuples(st.sampled_from(list(KINDS)), st.integers(0, 99_999)), min_size=1, max_size=8
        )
    )
    return build_case(
        groups,
        draw(rigs()),
        degree=draw(st.integers(0, 3)),
        background=draw(st.sampled_from([(0.0, 0.0, 0.0), (1.0, 0.5, 0.25)])),
        shuffle=draw(st.integers(0, 99)),
    )
