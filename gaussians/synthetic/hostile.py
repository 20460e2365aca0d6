"""Hostile scenes: small seeded stereo pairs, each built to break one assumption of stereo methods.

``HOSTILE`` maps a name to a function that builds the case. Positions are given in the head's axes
(x right, y down, z forward). On the usual rig projections of round numbers are exact in float32.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.random import Generator

from gaussians.cameras import Display, Pose, StereoRig
from gaussians.constants import OPACITY_MIN
from gaussians.scene import Scene, concatenate
from gaussians.synthetic.hostile_parts import (
    BF,
    F_PX,
    clutter,
    dots,
    gaussians,
    roll,
    seen_at,
    straight_rig,
    yaw,
)

View = tuple[StereoRig, list[Scene]]

_SEED = 20
_BACKGROUND = (0.1, 0.2, 0.3)
_BELOW, _ABOVE = (np.nextafter(OPACITY_MIN, np.float32(side)) for side in (0, 1))


@dataclass(frozen=True)
class HostileCase:
    """A scene, the rig that looks at it, and what is hard there."""

    name: str
    scene: Scene
    rig: StereoRig
    background: tuple[float, float, float]
    breaks: str  # one sentence


HOSTILE: dict[str, Callable[[], HostileCase]] = {}


def _hostile(
    breaks: str, name: str = ""
) -> Callable[[Callable[[Generator], View]], Callable[[Generator], View]]:
    """Enters a builder into HOSTILE under its own or the given name."""

    def enter(build: Callable[[Generator], View]) -> Callable[[Generator], View]:
        key = name or build.__name__

        def case() -> HostileCase:
            rig, parts = build(np.random.default_rng(_SEED))
            return HostileCase(key, concatenate(parts).validate(key), rig, _BACKGROUND, breaks)

        HOSTILE[key] = case
        return build

    return enter


@_hostile("disparities of 8 to 40 px: beyond four rows of tiles")
def near_objects(rng: Generator) -> View:
    rig = straight_rig()
    return rig, [clutter(rng, rig, 400, (0.2, 1.0))]


def _disparity(pixels: int, rng: Generator) -> View:
    """One depth; centres on pixel centres and column edges of the left window and right of it."""
    rig = straight_rig(128, 32, near_m=0.0625)
    columns = np.arange(0.0, 128.5 + pixels, 1.5)
    rows = rng.integers(0, 64, len(columns)) / 2
    positions = seen_at(rig, columns, rows, BF / pixels)
    sizes = rng.choice([0.0, 0.5, 3.0], len(columns))
    return rig, [dots(rng, rig, positions, rng.uniform(0.2, 1.0, len(columns)), sizes)]


for _pixels, _what in (
    (4, "one 4 px tile: a splat on a tile edge stays on one"),
    (8, "one 8 px tile, two 4 px tiles: floor and ceiling of the tile shift agree"),
    (16, "four 4 px tiles: the first that four rows do not hold"),
    (32, "four 8 px tiles, eight 4 px tiles: beyond the rows"),
    (128, "the whole image: the eyes share no splat except across the border"),
):
    _hostile(f"disparity of exactly {_what}", f"disparity_{_pixels}_px")(
        partial(_disparity, _pixels)
    )


@_hostile("the left alpha check and tile test meet nothing where the right eye meets a column")
def thin_between_columns(rng: Generator) -> View:
    """Upright lines on the edges between left pixel columns, half a pixel off in the right eye."""
    rig = straight_rig()
    columns = np.arange(8.0, 120.0)
    depths = BF / (rng.integers(2, 24, len(columns)) + 0.5)
    scales = np.outer(rng.uniform(1, 8, len(columns)) * depths / F_PX, (0, 1, 0))
    positions = seen_at(rig, columns, rng.uniform(5, 59, len(columns)), depths)
    lines = gaussians(rng, rig, positions, scales, rng.uniform(1.02, 1.3, len(columns)) / 255)
    return rig, [lines, clutter(rng, rig, 60, (2.0, 8.0))]


@_hostile("needles of condition number 1e4 to 1e8: rounding moves their edges, or removes them")
def needles(rng: Generator) -> View:
    """Through the image; every second one is centred far outside it."""
    rig = straight_rig()
    lengths_m = 10 ** np.linspace(1.7, 3.9, 90) * 1.7 / F_PX
    angles = np.tile([0.0, np.pi / 2, np.pi / 4, 1e-3, 1.0, 2.5, 0.3, 1.3, 2.0], 10)
    positions = seen_at(rig, rng.uniform(-20, 120, 90), rng.uniform(0, 64, 90), 1.7)
    along = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    positions[::2] += (along * (lengths_m * rng.uniform(-2, 2, 90))[:, None])[::2]
    scales = np.outer(lengths_m, (1, 0, 0))
    return rig, [gaussians(rng, rig, positions, scales, 0.3, turns=roll(angles))]


def _beside(first: float, last: float, rng: Generator) -> View:
    """Dots that the left eye sees from column ``first`` to ``last`` + disparity."""
    rig = straight_rig()
    depths = rng.uniform(0.22, 0.5, 120)
    columns = rng.uniform(first, last + BF / depths)
    aside = dots(rng, rig, seen_at(rig, columns, rng.uniform(0, 64, 120), depths), 0.7, 0.5)
    return rig, [aside, clutter(rng, rig, 100, (1.0, 8.0))]


_hostile("splats of the right image that lie right of the left image", "right_of_the_left_image")(
    partial(_beside, 101.0, 96.0)
)
_hostile("splats of the left image that lie left of the right image", "left_of_the_right_image")(
    partial(_beside, 0.5, -5.0)
)


@_hostile("splats wholly left of the left image that reach into the right image")
def left_of_the_left_image(rng: Generator) -> View:
    """Discs beside the left window, edge-on to the left eye; the right eye sees their width."""
    rig = straight_rig()
    columns, depths = -rng.uniform(5, 15, 60), rng.uniform(0.2, 0.4, 60)
    positions = seen_at(rig, columns, rng.uniform(5, 59, 60), depths)
    along_ray = np.arctan2(-depths, positions[:, 0] + 0.5 * rig.baseline_m)
    scales = np.stack([10 ** rng.uniform(-1, 1, 60), np.full(60, 0.02), np.zeros(60)], axis=1)
    discs = gaussians(rng, rig, positions, scales, 0.4, turns=yaw(along_ray))
    return rig, [discs, clutter(rng, rig, 100, (1.0, 8.0))]


@_hostile("splats of 1 cm to 100 m across the near plane: one of them fills the image")
def huge_at_the_near_plane(rng: Generator) -> View:
    rig = straight_rig()
    depths = np.concatenate([np.full(4, 0.2), rng.uniform(-0.2, 0.6, 60)])
    positions = np.stack([*rng.uniform(-0.2, 0.2, (2, 64)), depths], axis=1)
    scales, turns = 10 ** rng.uniform(-2, 2, (64, 3)), rng.normal(size=(64, 4))
    return rig, [gaussians(rng, rig, positions, scales, rng.uniform(0.01, 0.5, 64), turns=turns)]


@_hostile("faint giants: float32 loses their height, in each eye to another row")
def faint_giants(rng: Generator) -> View:
    """1000 px long and more, opacities a ten-millionth to a ten-thousandth above 1/255."""
    rig = straight_rig()
    depths, turns = rng.choice([0.5, 2.0, 50.0], 1000), rng.normal(size=(1000, 4))
    positions = seen_at(rig, rng.uniform(-10, 120, 1000), rng.uniform(0, 64, 1000), depths)
    scales_px = 10 ** (rng.uniform(3, 5, (1000, 1)) + rng.uniform(-6, 0, (1000, 3)))
    opacities = (1 + 10 ** rng.uniform(-7, -4, 1000)) / 255
    scales = scales_px * depths[:, None] / F_PX
    return rig, [gaussians(rng, rig, positions, scales, opacities, turns=turns)]


@_hostile("equal depth bits in one list, arriving through different rows: only the id decides")
def depth_ties(rng: Generator) -> View:
    """Disparity 6 px; small splats are clamped to their own left tile, wide ones are not."""
    rig = straight_rig()
    positions = seen_at(rig, rng.uniform(0, 110, 400), rng.uniform(0, 64, 400), BF / 6)
    return rig, [dots(rng, rig, positions, 0.9, rng.choice([0.0, 1.0, 5.0], 400))]


@_hostile("opacity one float below, at and above 1/255: a pass or a cull hangs on the last bit")
def opacity_at_1_255(rng: Generator) -> View:
    """Dots on pixel centres: the left ones, with disparity 4, and the right ones, with 4.5."""
    rig = straight_rig()
    levels = np.array([_BELOW, OPACITY_MIN, _ABOVE, 1.001 * OPACITY_MIN, 1.5 * OPACITY_MIN])
    opacities = np.tile(levels, 60)
    columns = rng.integers(0, 104, 300) + np.repeat([0.5, 0.0], 150)
    depths = BF / np.repeat([4.0, 4.5], 150)
    positions = seen_at(rig, columns, rng.integers(0, 64, 300) + 0.5, depths)
    return rig, [dots(rng, rig, positions, opacities, 0.0)]


@_hostile("an opaque wall ends the left lists before the splats that the right eye sees past it")
def wall_hides_the_right_view(rng: Generator) -> View:
    rig = straight_rig()
    columns, rows, layers = (a.ravel() for a in np.mgrid[-2:54:4, -2:68:4, 0:3])
    wall = seen_at(rig, columns, rows, 1.0 + 0.01 * layers)
    behind = seen_at(rig, rng.uniform(36, 62, 200), rng.uniform(0, 64, 200), rng.uniform(3, 8, 200))
    return rig, [dots(rng, rig, wall, 1.0, 3.0), dots(rng, rig, behind, 0.9, 0.7)]


def _off_axis(outer: float, inner: float, rng: Generator) -> View:
    display, _ = Display.from_half_angles(128, 104, outer, inner, 0.733, 0.942)
    rig = replace(straight_rig(baseline_m=0.06), display=display)
    return rig, [clutter(rng, rig, 300, (0.2, 6.0))]


_hostile("windows of one image plane 32 px apart, half-angles as in EyeNavGS", "off_axis")(
    partial(_off_axis, 0.942, 0.698)
)
_hostile("windows apart the other way: wider towards the nose", "off_axis_inwards")(
    partial(_off_axis, 0.698, 0.942)
)


@_hostile("61 x 47 px: neither side is a multiple of a tile")
def odd_size(rng: Generator) -> View:
    rig = straight_rig(61, 47)
    return rig, [clutter(rng, rig, 300, (0.3, 8.0))]


@_hostile("3 x 5 px: one tile column, and most disparities leave it")
def smaller_than_a_tile(rng: Generator) -> View:
    rig = straight_rig(3, 5)
    return rig, [clutter(rng, rig, 100, (0.3, 8.0))]


@_hostile("baseline 0: the eyes are one, every splat stays in its tile")
def baseline_zero(rng: Generator) -> View:
    rig = straight_rig(baseline_m=0.0)
    return rig, [clutter(rng, rig, 300, (0.3, 8.0))]


@_hostile("baseline 0.6 m, ten times the usual: disparities of 10 to 250 px")
def baseline_tenfold(rng: Generator) -> View:
    rig = straight_rig(baseline_m=0.6)
    return rig, [clutter(rng, rig, 400, (0.3, 8.0))]


@_hostile("scene and rig a thousand times larger: nothing may depend on the unit of length")
def scale_1000(rng: Generator) -> View:
    rig = straight_rig(baseline_m=62.5, near_m=200.0)
    return rig, [clutter(rng, rig, 300, (300.0, 8000.0))]


@_hostile("scene a thousand times larger, the usual rig: disparities far below a pixel")
def scale_1000_world_only(rng: Generator) -> View:
    rig = straight_rig()
    return rig, [clutter(rng, rig, 300, (300.0, 8000.0))]


@_hostile("splats 20 km away, of 500 km, and 10 km aside at 1 m depth")
def outliers(rng: Generator) -> View:
    rig = straight_rig()
    far = seen_at(rig, rng.uniform(0, 96, 20), rng.uniform(0, 64, 20), 2e4)
    aside = np.array([[1e4, -3.0, 1.0], [-1e4, 2.0, 1.0], [-1e6, 1e5, 2e4], [0.1, 0.1, 1e9]])
    positions = np.concatenate([far, aside])
    scales = 10 ** np.concatenate(
        [rng.uniform(0, 5.7, (20, 3)), [[0] * 3, [3] * 3, [6] * 3, [9] * 3]]
    )
    parts = gaussians(rng, rig, positions, scales, 0.3, turns=rng.normal(size=(24, 4)))
    return rig, [parts, clutter(rng, rig, 200, (0.3, 8.0))]


@_hostile("strong harmonics of degree 3 close by: a splat's colour differs between the eyes")
def view_dependent_colour(rng: Generator) -> View:
    rig = straight_rig()
    return rig, [clutter(rng, rig, 300, (0.5, 1.5), sh=(3, 1.0))]


@_hostile("one splat alone")
def one_splat(rng: Generator) -> View:
    rig = straight_rig()
    return rig, [dots(rng, rig, seen_at(rig, 49.3, 30.1, 1.7), 0.9, 3.0)]


@_hostile("one splat per tile column, exactly on the edge or corner of its tile")
def tile_edges(rng: Generator) -> View:
    rig = straight_rig()
    columns = np.arange(0.0, 108.0, 4.0)
    rows = np.tile([4.0, 8.5, 16.0, 31.0], len(columns))[: len(columns)]
    positions = seen_at(rig, columns, rows, np.tile([2.0, 1.0, 0.8], len(columns))[: len(columns)])
    return rig, [dots(rng, rig, positions, 0.8, np.tile([0.0, 0.6, 2.0], 9))]


@_hostile("discs seen nearly edge-on at 0.3 to 0.8 m: narrow in one eye, wide in the other")
def tilted_close(rng: Generator) -> View:
    rig = straight_rig()
    depths, angles = rng.uniform(0.3, 0.8, 120), rng.uniform(1.3, 1.8, 120)
    positions = seen_at(rig, rng.uniform(0, 120, 120), rng.uniform(0, 64, 120), depths)
    discs = gaussians(rng, rig, positions, (0.03, 0.01, 0.0), 0.5, turns=yaw(angles))
    return rig, [discs, clutter(rng, rig, 100, (1.0, 8.0))]


@_hostile("a turned head 10 km from the origin: float32 positions are 1 mm apart")
def far_from_the_origin(rng: Generator) -> View:
    cosine, sine = np.cos(0.5), np.sin(0.5)
    turned = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    rig = straight_rig(pose=Pose(np.array([1e4, -50.0, 3e3]), turned))
    return rig, [clutter(rng, rig, 300, (0.4, 8.0))]
