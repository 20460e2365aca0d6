"""Causes of wrong pixels: scenes in which one cause acts, and the definition pixel by pixel."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from gaussians.attribution import INTERACTION, LABELS, UNKNOWN, Attribution, CauseMap
from gaussians.cameras import StereoRig
from gaussians.quality import differing, error_8bit
from gaussians.render import StereoRenderer
from gaussians.scene import Scene, concatenate
from gaussians.stereo_causes import CAUSE_NAMES, causes_of, keeping
from gaussians.stereo_method import PRESETS, StereoMethod, parse_method
from gaussians.synthetic import HOSTILE
from gaussians.synthetic.hostile_parts import F_PX, dots, gaussians, seen_at, straight_rig

BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Verdict:
    """A method's right eye of one scene, what is wrong there, and why."""

    renderer: StereoRenderer
    method: StereoMethod
    right: NDArray[np.float32]
    causes: CauseMap

    @property
    def wrong(self) -> NDArray[np.bool_]:
        return differing(self.right, self.renderer.independent_right().image)

    def wrong_with(self, causes: tuple[str, ...]) -> NDArray[np.bool_]:
        """Where the method with only these causes is wrong."""
        return self.error_with(causes) >= 0

    def error_with(self, causes: tuple[str, ...]) -> NDArray[np.int16]:
        """8-bit error of the method with only these causes, -1 where it has the right bits."""
        image = self.renderer.render(keeping(self.method, causes, "kept")).right
        reference = self.renderer.independent_right().image
        error = error_8bit(image, reference).astype(np.int16)
        return np.where(differing(image, reference), error, np.int16(-1))


def judged(scene: Scene, rig: StereoRig, text: str, tile_px: int = 4) -> Verdict:
    renderer = StereoRenderer(scene, rig, BLACK, tile_px)
    method = parse_method(text)
    right = renderer.render(method).right
    return Verdict(renderer, method, right, Attribution(renderer).attribute(method, right))


# ---------------------------------------------------------------- one cause acts

# Dots without extent of their own have the same conic in both eyes, and pass at most 1.9 px away:
# one in the middle of a 4 px tile stays inside it. A disparity of whole tiles takes it to the
# middle of another one, exactly, with f = 128 px, B = 1/16 m and depths of powers of two.

RIG = straight_rig()
MIDDLES = np.arange(10.0, 56.0, 8.0)  # rows
LISTS = "paper,conic=per_eye,colour=per_eye,centre=projected"


def points(columns: ArrayLike, rows: ArrayLike, depth: float, opacity: float = 0.9) -> Scene:
    """Dots of dilation alone; columns and rows of the left eye, each with each."""
    u, v = (grid.ravel() for grid in np.meshgrid(columns, rows))
    return dots(np.random.default_rng(7), RIG, seen_at(RIG, u, v, depth), opacity, 0.0)


def hidden_behind(layers: int) -> Scene:
    """Layers of one tile, with two tiles of disparity; behind them a dot that moves by one tile.

    A hundred stop the left pixels that the dot meets, 150 all pixels of the tile.
    """
    stack = points([30.0, 62.0], MIDDLES, 1.0, 150.0)
    return concatenate([*[stack] * layers, points([30.0, 62.0], MIDDLES, 2.0)])


def between_left_pixel_centres() -> Scene:
    """Too faint for a centre half a pixel away, as in the left eye; on a centre in the right."""
    return points(np.arange(21.0, 80.0, 8.0), MIDDLES + 0.5, 8 / 4.5, 1.2 / 255)


def half_a_tile_of_disparity() -> Scene:
    """In the middle of a left tile, across the edge of two right ones."""
    return points(np.arange(22.0, 80.0, 8.0), MIDDLES, 4.0)


def five_tiles_of_disparity() -> Scene:
    return points(np.arange(30.0, 90.0, 8.0), MIDDLES, 8 / 20)


def right_of_the_left_image() -> Scene:
    """Two tiles of disparity."""
    return points([98.0, 102.0], MIDDLES, 1.0)


def tall_beyond_three_sigmas() -> Scene:
    """Upright lines of one tile's width; opacity 10 passes at four standard deviations."""
    columns = np.arange(30.0, 90.0, 8.0)
    positions = seen_at(RIG, columns, 32.0, 1.0)
    return gaussians(np.random.default_rng(7), RIG, positions, (0.0, 5.0 / F_PX, 0.0), 10.0)


def wide_as_a_third_of_a_pixel() -> Scene:
    """Balls: the eyes see them under different angles."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.arange(30.0, 90.0, 8.0), MIDDLES))
    return dots(np.random.default_rng(7), RIG, seen_at(RIG, u, v, 1.0), 0.9, 0.3)


def coloured_by_direction() -> Scene:
    u, v = (grid.ravel() for grid in np.meshgrid(np.arange(30.0, 90.0, 8.0), MIDDLES))
    positions = seen_at(RIG, u, v, 1.0)
    return gaussians(np.random.default_rng(7), RIG, positions, 0.0, 0.9, sh=(1, 1.0))


def a_disparity_that_is_no_short_number() -> Scene:
    return points(np.arange(30.0, 90.0, 8.0) + 0.1, MIDDLES, 8 / 8.3)


def equal_depths_through_two_rows() -> Scene:
    """Half a tile of disparity. A dot on a left tile edge comes through row 1; one half a tile
    before it, clamped to its own tile, through row 0. They overlap, and the first has the
    smaller id."""
    edges = np.arange(24.0, 80.0, 16.0)
    return concatenate([points(edges, MIDDLES, 4.0), points(edges - 2.0, MIDDLES, 4.0)])


ALONE: dict[str, tuple[Callable[[], Scene], str]] = {
    "termination": (partial(hidden_behind, 150), LISTS),
    "alpha_check": (between_left_pixel_centres, LISTS),
    "insertion": (half_a_tile_of_disparity, LISTS),
    "conic": (wide_as_a_third_of_a_pixel, "paper"),
    "colour": (coloured_by_direction, "paper"),
    "rows": (five_tiles_of_disparity, LISTS),
    "left_view": (right_of_the_left_image, f"{LISTS},independent_edge_tiles=0"),
    "ties": (
        equal_depths_through_two_rows,
        "exact,tie=depth,conic=left,colour=left,centre=shifted,out_of_range=drop,"
        "forwarding=live_alpha_pass",
    ),
    "footprint": (tall_beyond_three_sigmas, LISTS),
    "centre": (a_disparity_that_is_no_short_number, "paper"),
}


@pytest.mark.parametrize("cause", CAUSE_NAMES)
def test_where_one_cause_acts_the_pixels_are_its_own(cause: str) -> None:
    build, text = ALONE[cause]
    verdict = judged(build(), RIG, text)
    assert len(causes_of(verdict.method)) >= 6
    wrong, count = int(verdict.wrong.sum()), verdict.causes.counts[cause]
    assert wrong >= 20
    assert count.pixels >= 0.99 * wrong


# ---------------------------------------------------------------- several causes act


def where(verdict: Verdict, label: str) -> NDArray[np.bool_]:
    """[H, W] pixels with this label."""
    value: NDArray[np.bool_] = verdict.causes.labels == LABELS.index(label) + 1
    return value


def test_of_two_sufficient_causes_the_larger_error_is_the_label() -> None:
    """Dots as wide as a third of a pixel, and coloured by direction: both reuses are enough."""
    scene = wide_as_a_third_of_a_pixel()
    harmonics = np.random.default_rng(7).normal(0, 0.06, (len(scene), 4, 3)).astype(np.float32)
    harmonics[:, 0] = scene.sh[:, 0]
    verdict = judged(replace(scene, sh=harmonics), RIG, "paper")
    conic, colour = (verdict.error_with((name,)) for name in ("conic", "colour"))
    both = (conic >= 0) & (colour >= 0)
    assert not (verdict.wrong & ~verdict.wrong_with(CAUSE_NAMES)).any()
    assert (conic > colour)[both].sum() >= 5 and (colour > conic)[both].sum() >= 50
    assert where(verdict, "conic")[both & (conic > colour)].all()
    assert where(verdict, "colour")[both & (colour > conic)].all()
    counts = verdict.causes.counts
    for name, other in (("conic", "colour"), ("colour", "conic")):
        assert counts[name].sufficient >= both.sum()
        assert counts[name].runner_up == (where(verdict, other) & both).sum()
        assert counts[name].necessary == (verdict.wrong & ~verdict.wrong_with((other,))).sum()


@pytest.mark.parametrize(
    ("scene", "text", "together"),
    [
        # square lists hold the dot, so that binning adds no entry for it; its own do not pass
        (between_left_pixel_centres, "exact,forwarding=alpha_pass,intersection=square_3sigma",
         {"alpha_check", "footprint"}),
        # the dot passes in the left tile, but in stopped pixels only; the tile has not stopped
        (partial(hidden_behind, 100), "exact,forwarding=live_alpha_pass",
         {"alpha_check", "termination"}),
    ],
)  # fmt: skip
def test_causes_that_are_enough_only_together_interact(
    scene: Callable[[], Scene], text: str, together: set[str]
) -> None:
    verdict = judged(scene(), RIG, text)
    assert set(causes_of(verdict.method)) == together
    assert verdict.wrong.sum() >= 20
    assert (verdict.causes.labels[verdict.wrong] == INTERACTION).all()
    for name in together:
        count = verdict.causes.counts[name]
        assert (count.necessary, count.sufficient) == (verdict.wrong.sum(), 0)
        assert count.pixels == count.runner_up == 0


def test_what_no_cause_explains_is_unknown() -> None:
    renderer = StereoRenderer(half_a_tile_of_disparity(), RIG, BLACK, 4)
    right = renderer.independent_right().image.copy()
    attribution = Attribution(renderer)
    assert not attribution.attribute(PRESETS["exact"], right).labels.any()
    right[5, 7, 1] += np.float32(0.5)
    causes = attribution.attribute(PRESETS["exact"], right)
    assert causes.labels[5, 7] == UNKNOWN and (causes.labels > 0).sum() == 1
    assert set(causes.counts) == {"unknown"} and causes.counts["unknown"].pixels == 1


def test_a_right_image_without_wrong_pixels_needs_no_counterfactual() -> None:
    renderer = StereoRenderer(points([30.0], [30.0], 1.0), RIG, BLACK, 4)
    right = renderer.independent_right().image
    causes = Attribution(renderer).attribute(PRESETS["paper"], right)
    assert not causes.labels.any() and set(causes.counts) == set(CAUSE_NAMES)
    assert all(set(vars(count).values()) == {0} for count in causes.counts.values())


# ---------------------------------------------------------------- the definition, pixel by pixel


def label_and_runner_up(
    necessary: list[str], errors: dict[str, int], order: tuple[str, ...]
) -> tuple[str, str | None]:
    """Of one wrong pixel; ``errors`` are those of the sufficient causes. Equal ones: the first."""
    ranked = sorted(errors, key=lambda name: (-errors[name], order.index(name)))
    label = ranked[0] if ranked else "interaction"
    if len(necessary) == 1:
        label = necessary[0]
    return label, next((name for name in ranked if name != label), None)


@cache
def hostile(name: str, text: str, tile_px: int) -> Verdict:
    case = HOSTILE[name]()
    return judged(case.scene, case.rig, text, tile_px)


SEVERAL = [
    ("near_objects", "paper", 4),
    ("view_dependent_colour", "paper", 4),
    ("wall_hides_the_right_view", LISTS, 8),
    ("thin_between_columns", "paper,insertion=two_tiles,rows=8", 4),
    ("depth_ties", "paper,insertion=two_tiles,conic=per_eye,out_of_range=spill", 4),
    ("tilted_close", "exact,conic=left,forwarding=live_alpha_pass,tie=depth", 8),
]


@pytest.mark.parametrize(("name", "text", "tile_px"), SEVERAL)
def test_labels_and_counts_are_those_of_the_definition(name: str, text: str, tile_px: int) -> None:
    verdict = hostile(name, text, tile_px)
    causes, wrong = causes_of(verdict.method), verdict.wrong
    right_without = {
        cause: ~verdict.wrong_with(tuple(c for c in causes if c != cause)) for cause in causes
    }
    error_alone = {cause: verdict.error_with((cause,)) for cause in causes}
    visibly = error_8bit(verdict.right, verdict.renderer.independent_right().image) > 0
    counts = {field: Counter[str]() for field in ("pixels", "pixels_8bit", "necessary",
                                                   "sufficient", "runner_up")}  # fmt: skip
    for pixel in map(tuple, np.argwhere(wrong)):
        necessary = [cause for cause in causes if right_without[cause][pixel]]
        errors = {c: int(e[pixel]) for c, e in error_alone.items() if e[pixel] >= 0}
        label, runner_up = label_and_runner_up(necessary, errors, causes)
        assert LABELS[verdict.causes.labels[pixel] - 1] == label
        counts["pixels"][label] += 1
        counts["pixels_8bit"][label] += int(visibly[pixel])
        counts["necessary"].update(necessary)
        counts["sufficient"].update(list(errors))
        if runner_up:
            counts["runner_up"][runner_up] += 1
    assert wrong.any() and not verdict.causes.labels[~wrong].any()
    assert set(verdict.causes.counts) == set(causes) | set(counts["pixels"])
    for cause, count in verdict.causes.counts.items():
        assert vars(count) == {field: tally[cause] for field, tally in counts.items()}


def test_the_hostile_verdicts_reach_every_kind_of_label() -> None:
    counts = [hostile(*case).causes.counts for case in SEVERAL]
    labels = {label for found in counts for label, count in found.items() if count.pixels}
    assert len(labels & set(CAUSE_NAMES)) >= 8 and "interaction" in labels
    assert sum(count.runner_up for found in counts for count in found.values()) > 100
