"""Scenes drawn splat by splat on the thresholds where stereo methods decide.

Depths at the near plane and its neighbours, at disparities of whole tiles and of half pixels, and
equal; centres on pixel centres, pixel edges and tile edges, inside and outside either window;
opacities at 1/255 and its neighbours; shapes that are thin, long, tilted or enormous. Every splat
is a drawing of its own, so that a failing example shrinks to the splats that matter.
"""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from gaussians.cameras import StereoRig
from tests.strategies import (
    OPACITY_EDGE,
    ORIGIN,
    Case,
    Splat,
    at_pixel,
    build_scene,
    small_rig,
    turned_pose,
)

_ZERO, _BIG = np.float32(0), np.float32(1e9)
OPACITIES = (
    *(float(o) for o in (OPACITY_EDGE, np.nextafter(OPACITY_EDGE, _ZERO))),
    *(float(OPACITY_EDGE) * more for more in (1 + 2**-23, 1.01, 1.3, 1.6)),
    *(0.0, 0.5, 0.99, 1.0, 44.0),
)
ANGLES = (0.0, np.pi / 4, np.pi / 2, 1e-3, np.pi / 2 - 1e-4, 1.0, 2.5)


def rigs() -> st.SearchStrategy[StereoRig]:
    """Windows of 1 to 61 px, on axis and off it to both sides, with and without a baseline."""
    return st.builds(
        small_rig,
        st.sampled_from([37, 61, 40, 16, 5, 4, 3, 1]),
        st.sampled_from([13, 16, 29, 5, 4, 1]),
        focal=st.sampled_from([(32.0, 32.0), (128.0, 128.0), (37.3, 41.9)]),
        offset_px=st.sampled_from([0, 16, -16, 48, -48]),
        baseline_m=st.sampled_from([0.0625, 0.06, 0.6, 0.0]),
        pose=st.one_of(st.just(ORIGIN), st.integers(0, 999).map(turned_pose)),
    )


def depths(rig: StereoRig) -> st.SearchStrategy[float]:
    """Metres, never nearer than one float behind the near plane."""
    near = np.float32(rig.near_m)
    edges = [float(z) for z in (near, np.nextafter(near, _ZERO), np.nextafter(near, _BIG))]
    ties = st.sampled_from([1.0, 2.0, *edges, 2e4])
    product = rig.baseline_m * rig.display.fx
    if product == 0:
        return ties
    tiles = st.integers(1, 40).map(lambda count: max(product / (4 * count), rig.near_m))
    halves = st.integers(0, 60).map(lambda count: max(product / (count + 0.5), rig.near_m))
    return st.one_of(tiles, halves, ties)


def coordinates(low: int, high: int) -> st.SearchStrategy[float]:
    """Tile edges, pixel edges, pixel centres and what lies just beside them, in pixels."""
    tiles = st.integers(low // 4, high // 4).map(lambda tile: 4.0 * tile)
    pixels = st.integers(low, high).map(float)
    return st.one_of(
        tiles, st.builds(lambda p, part: p + part, pixels, st.sampled_from([0.5, 0.0, 0.499, 0.25]))
    )


@st.composite
def splats_at(draw: st.DrawFn, position: tuple[float, float, float], rig: StereoRig) -> Splat:
    """One splat of any shape at or, if a needle, through this position."""
    x, y, z = position
    pixel, opacity = z / rig.display.fx, draw(st.sampled_from(OPACITIES))
    kind = draw(st.sampled_from(["dot", "ball", "upright line", "needle", "edge-on", "huge"]))
    if kind == "dot":
        return Splat(position, (0.0, 0.0, 0.0), opacity)
    if kind == "ball":
        size = draw(st.sampled_from([0.3, 1.0, 5.0])) * pixel
        return Splat(position, (size, size, size), opacity)
    if kind == "upright line":
        length = draw(st.sampled_from([1.0, 10.0, 1000.0])) * pixel
        return Splat(position, (0.0, length, 0.0), opacity)
    if kind == "needle":
        length, angle = 10.0 ** draw(st.integers(1, 5)) * pixel, draw(st.sampled_from(ANGLES))
        away = draw(st.sampled_from([0.0, -1.5, 0.5, 2.0])) * length  # still through the position
        centre = x + away * np.cos(angle), y + away * np.sin(angle), z
        turn = (np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2))
        return Splat(centre, (length, 0.0, 0.0), opacity, turn)
    if kind == "edge-on":  # a disc that holds the left eye's ray to its centre
        half = np.arctan2(-z, x + 0.5 * rig.baseline_m) / 2
        size = 10.0 ** draw(st.integers(-2, 1))
        turn = (np.cos(half), 0.0, np.sin(half), 0.0)
        return Splat(position, (size, 0.1 * size, 0.0), opacity, turn)
    anyhow = np.random.default_rng(draw(st.integers(0, 99))).normal(size=4)
    a, b, c = (10.0 ** draw(st.integers(-3, 6)) for _ in range(3))
    return Splat(position, (a, b, c), opacity, tuple(anyhow / np.linalg.norm(anyhow)))


@st.composite
def splats(draw: st.DrawFn, rig: StereoRig) -> Splat:
    """One splat in the left window, in the right one, beside both, or between."""
    display, depth = rig.display, draw(depths(rig))
    shift = display.window_offset_px + rig.baseline_m * display.fx / depth
    column = draw(coordinates(-8, display.width + 8))
    if draw(st.booleans()):  # meant for the right window
        column += shift
    row = draw(coordinates(-4, display.height + 4))
    return draw(splats_at(at_pixel(rig, column, row, depth), rig))


@st.composite
def walls(draw: st.DrawFn, rig: StereoRig) -> list[Splat]:
    """Nothing, or three opaque balls in one place: pixels and tiles behind them stop."""
    if not draw(st.booleans()):
        return []
    depth = draw(depths(rig))
    column, row = draw(coordinates(0, rig.display.width)), draw(coordinates(0, rig.display.height))
    size = draw(st.sampled_from([1.0, 4.0, 20.0])) * depth / rig.display.fx
    return 3 * [Splat(at_pixel(rig, column, row, depth), (size, size, size), 44.0)]


@st.composite
def threshold_cases(draw: st.DrawFn) -> Case:
    """One to twelve splats of random colours, with or without a wall."""
    rig = draw(rigs())
    chosen = draw(walls(rig)) + draw(st.lists(splats(rig), min_size=1, max_size=12))
    degree = draw(st.sampled_from([0, 1, 3]))
    rng = np.random.default_rng(len(chosen))
    sh = rng.normal(0.0, 0.5, (len(chosen), (degree + 1) ** 2, 3))
    return Case(build_scene(chosen, rig, sh), rig, (1.0, 0.5, 0.25))
