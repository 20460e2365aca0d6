"""`exact` is `independent`, images and lists, on scenes drawn on the thresholds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gaussians import reference
from gaussians.projection import project
from gaussians.render import render_stereo
from gaussians.stereo_method import PRESETS
from gaussians.tiling import TileGrid, TileLists, row_spans, tile_lists
from tests.gaussians.hostile_frames import pairs
from tests.gaussians.test_stereo import assert_the_carrier_rule_explains
from tests.strategies import Case
from tests.threshold_cases import threshold_cases

TILES = st.sampled_from([4, 8, 16])


def assert_same_bits(image: NDArray[np.float32], wanted: NDArray[np.float32] | None) -> None:
    assert wanted is not None and image.dtype == wanted.dtype == np.float32
    np.testing.assert_array_equal(image.view(np.uint32), wanted.view(np.uint32))


def assert_same_lists(lists: TileLists, wanted: TileLists) -> None:
    np.testing.assert_array_equal(lists.offsets, wanted.offsets)
    np.testing.assert_array_equal(lists.splats, wanted.splats)


def right_eye_alone(case: Case, tile_px: int) -> TileLists:
    """The right eye's lists, binned without any knowledge of the left eye."""
    splats, display = project(case.scene, case.rig), case.rig.display
    alone = replace(
        splats, features=splats.features[1:].copy(), covariances=splats.covariances[1:].copy()
    )
    return tile_lists(row_spans(alone, TileGrid(display.width, display.height, tile_px)), 0)


def assert_exact_is_exact(case: Case, tile_px: int) -> None:
    """Against the preset `independent`, the right eye on its own, and the slow renderer.

    Both presets bin a splat in the rows that it may reach in either eye. On its own, the right eye
    may leave out a row of a splat whose height float32 has lost in the left eye.
    """
    scene, rig, background = case.scene, case.rig, case.background
    exact = render_stereo(scene, rig, PRESETS["exact"], background, tile_px, compare=True)
    independent = render_stereo(scene, rig, PRESETS["independent"], background, tile_px)
    assert_same_bits(exact.left, independent.left)
    assert_same_bits(exact.right, independent.right)
    assert_same_bits(exact.right, exact.independent_right)
    assert_same_bits(exact.right, reference.render_eye(scene, rig, "right", background).image)
    assert_same_lists(exact.left_lists, independent.left_lists)
    assert_same_lists(exact.right_lists, independent.right_lists)
    assert pairs(right_eye_alone(case, tile_px)) <= pairs(exact.right_lists)
    assert exact.work.stereo.duplicates == exact.work.stereo.dropped == 0
    assert_the_carrier_rule_explains(case, tile_px)


@settings(max_examples=200)
@given(threshold_cases(), TILES)
def test_exact_is_exact_on_the_thresholds(case: Case, tile_px: int) -> None:
    assert_exact_is_exact(case, tile_px)


@pytest.mark.slow
@settings(max_examples=2000)
@given(threshold_cases(), TILES)
def test_exact_is_exact_on_the_thresholds_many_times(case: Case, tile_px: int) -> None:
    assert_exact_is_exact(case, tile_px)


EVERYTHING = {
    "only the right eye sees it",
    "only the left eye sees it",
    "row without a left span but with a right one",
    "equal depths in one tile",
    "on the near plane",
    "behind the near plane",
    "transparent",
    "unbounded by rounding",
    "degenerate",
    "forward-only",
    "left tile ended early",
    "beyond four tiles",
    "window offset below zero",
}


def reached(case: Case) -> set[str]:
    """What of EVERYTHING the case holds."""
    splats, display = project(case.scene, case.rig), case.rig.display
    rows = row_spans(splats, TileGrid(display.width, display.height, 4))
    in_left, in_right = (spans[:, 0] <= spans[:, 1] for spans in rows.spans)
    left, right = set(rows.ranks[in_left].tolist()), set(rows.ranks[in_right].tolist())
    frame = render_stereo(case.scene, case.rig, PRESETS["exact"])
    work = frame.work
    lists = np.split(frame.right_lists.splats, frame.right_lists.offsets[1:-1])
    ties = any(len(np.unique(splats.depths[ranks])) < len(ranks) for ranks in lists)
    disparities = case.rig.baseline_m * display.fx / splats.depths
    facts = {
        "only the right eye sees it": bool(right - left),
        "only the left eye sees it": bool(left - right),
        "row without a left span but with a right one": bool((in_right & ~in_left).any()),
        "equal depths in one tile": ties,
        "on the near plane": bool((splats.depths == np.float32(case.rig.near_m)).any()),
        "behind the near plane": splats.behind_near > 0,
        "transparent": splats.transparent > 0,
        "unbounded by rounding": rows.ill_conditioned > 0,
        "degenerate": splats.degenerate > 0,
        "forward-only": bool(work.stereo.forward_only.any()),
        "left tile ended early": bool((work.left.processed < work.left.entries).any()),
        "beyond four tiles": bool((disparities[sorted(right)] > 16).any()),
        "window offset below zero": display.window_offset_px < 0,
    }
    return {fact for fact, holds in facts.items() if holds}


def test_the_drawings_reach_what_they_are_meant_to() -> None:
    found: set[str] = set()

    @settings(max_examples=150)
    @given(threshold_cases())
    def look(case: Case) -> None:
        found.update(reached(case))

    look()
    assert found == EVERYTHING
