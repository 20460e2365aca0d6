"""The axis-aligned box: tile by tile what it says, and never less than the ellipse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings

from gaussians import reference
from gaussians.footprints import Intersection
from gaussians.projection import ProjectedSplats, project
from gaussians.tiling import TileGrid, row_spans, tile_lists
from tests import strategies
from tests.naive.tiling import Lists, box_lists, nested
from tests.strategies import KINDS, Case, build_case, build_scene, small_rig

EYES: tuple[reference.Eye, ...] = ("left", "right")
SLACK_PX = 2e-3  # the row test's slack, and what widening by the rounding bound adds


def lists_of(
    splats: ProjectedSplats, case: Case, rule: Intersection, eye: int, tile_px: int
) -> Lists:
    grid = TileGrid(case.rig.display.width, case.rig.display.height, tile_px)
    return nested(tile_lists(row_spans(splats, grid, rule), eye))


def assert_within(fewer: Lists, more: Lists) -> None:
    for y, row in enumerate(fewer):
        for x, ranks in enumerate(row):
            assert set(ranks) <= set(more[y][x]), f"tile ({x}, {y})"


@pytest.mark.nojit
@pytest.mark.parametrize("tile_px", [4, 8])
def test_the_box_is_the_bounding_box_of_the_contour(tile_px: int) -> None:
    rig = small_rig(53, 37)
    splats = [s for seed in range(12) for s in KINDS["ordinary"](np.random.default_rng(seed), rig)]
    case = Case(build_scene(splats, rig, np.zeros((len(splats), 1, 3))), rig)
    projected = project(case.scene, case.rig)
    for number, eye in enumerate(EYES):
        drawn, _ = reference.project(case.scene, case.rig, eye)
        found = lists_of(projected, case, "box", number, tile_px)
        assert_within(box_lists(drawn, (37, 53), tile_px, grow=-SLACK_PX), found)
        assert_within(found, box_lists(drawn, (37, 53), tile_px, grow=SLACK_PX))
        assert sum(len(ranks) for row in found for ranks in row) > 150


@settings(max_examples=100, deadline=None, derandomize=True, database=None)
@given(strategies.cases())
def test_the_box_holds_every_tile_of_the_ellipse(case: Case) -> None:
    splats = project(case.scene, case.rig)
    for eye in range(2):
        ellipse, box = (lists_of(splats, case, rule, eye, 4) for rule in ("ellipse", "box"))
        assert_within(ellipse, box)


@pytest.mark.parametrize("kind", list(KINDS))
def test_the_box_holds_the_ellipse_of_each_kind_of_trouble(kind: str) -> None:
    for seed in range(6):
        case = build_case([(kind, seed)], small_rig(45, 31))
        splats = project(case.scene, case.rig)
        for eye in range(2):
            ellipse, box = (lists_of(splats, case, rule, eye, 4) for rule in ("ellipse", "box"))
            assert_within(ellipse, box)
