"""The rasteriser's blocks, pairs of entries and counts, for every tile size and odd list."""

from __future__ import annotations

import numpy as np
import pytest

from gaussians import reference
from gaussians.projection import project
from gaussians.rasterization import EyeImage, rasterise
from gaussians.spherical_harmonics import fill_colours
from gaussians.tiling import TileGrid, TileLists, offsets_of, row_spans, tile_lists
from tests.naive.tiling import Lists, live_passes, nested, passing_pixels, recount
from tests.strategies import Case, build_case, small_rig

pytestmark = pytest.mark.nojit

GROUPS = [("wall", 3), ("ordinary", 1), ("ordinary", 2), ("opacity_above_one", 0)]


def left_eye(case: Case, tile_px: int, drop: int) -> tuple[EyeImage, TileLists]:
    """The left eye of a case, the last ``drop`` entries of every list left out."""
    display = case.rig.display
    grid = TileGrid(display.width, display.height, tile_px)
    splats = project(case.scene, case.rig, eyes=1)
    rows = row_spans(splats, grid)
    positions = case.rig.left_position[None]
    arguments = (splats.ids, rows.visible[0], case.scene.means, case.scene.sh, positions)
    fill_colours(splats.features, *arguments)
    lists = shortened(tile_lists(rows, 0), drop)
    eye = rasterise(splats.features[0], lists, grid, case.background, record_passes=True)
    return eye, lists


def shortened(lists: TileLists, drop: int) -> TileLists:
    lengths = np.maximum(np.diff(lists.offsets) - drop, 0)
    starts = lists.offsets[:-1]
    kept = [lists.splats[s : s + n] for s, n in zip(starts, lengths, strict=True)]
    return TileLists(lists.tiles_x, lists.tiles_y, offsets_of(lengths), np.concatenate(kept))


@pytest.mark.parametrize("drop", [0, 1, 2])
@pytest.mark.parametrize("tile_px", [4, 8, 16])
def test_counts_and_passes_are_those_of_a_walk(tile_px: int, drop: int) -> None:
    case = build_case(GROUPS, small_rig(21, 13), background=(0.5, 0.25, 1.0))
    eye, lists = left_eye(case, tile_px, drop)
    splats, _ = reference.project(case.scene, case.rig, "left")
    passing, alphas = passing_pixels(splats, (13, 21))
    counted = recount(nested(lists), passing, alphas, tile_px)
    for name, value in vars(counted).items():
        np.testing.assert_array_equal(getattr(eye.work, name), value, name)
    assert eye.work.terminated.any() or tile_px == 16
    assert eye.live_passes.tolist() == live_passes(nested(lists), passing, alphas, tile_px)


def test_odd_and_even_lists_are_there() -> None:
    case = build_case(GROUPS, small_rig(21, 13))
    _, lists = left_eye(case, 4, 0)
    assert {int(n) % 2 for n in np.diff(lists.offsets)} == {0, 1}


def test_empty_lists_leave_the_background() -> None:
    """The last tile of the grid reaches beyond the image on both sides."""
    lists: Lists = [[[]] * 3] * 2
    grid = TileGrid(10, 7, 4)
    flat = TileLists(3, 2, np.zeros(7, np.int64), np.zeros(0, np.int32))
    assert nested(flat) == lists
    eye = rasterise(np.zeros((0, 10), np.float32), flat, grid, (0.5, 0.25, 1.0))
    assert (eye.image == np.float32([0.5, 0.25, 1.0])).all() and (eye.transmittance == 1).all()
    assert not any(value.any() for value in vars(eye.work).values())


def test_records_may_be_wider_than_their_ten_features() -> None:
    case = build_case(GROUPS, small_rig(21, 13))
    display = case.rig.display
    grid = TileGrid(display.width, display.height, 8)
    splats = project(case.scene, case.rig, eyes=1)
    lists = tile_lists(row_spans(splats, grid), 0)
    wide, narrow = splats.features[0], np.ascontiguousarray(splats.features[0, :, :10])
    images = [rasterise(f, lists, grid, (1.0, 1.0, 1.0)).image for f in (wide, narrow)]
    np.testing.assert_array_equal(*images)


def test_a_window_that_begins_outside_the_image_holds_the_image() -> None:
    case = build_case(GROUPS, small_rig(20, 13))
    splats = project(case.scene, case.rig, eyes=1)
    images = []
    for grid in (TileGrid(20, 13, 4), TileGrid(32, 13, 4, first_column=-2)):
        lists = tile_lists(row_spans(splats, grid), 0)
        images.append(rasterise(splats.features[0], lists, grid, (1.0, 0.0, 0.5)))
    plain, wide = images
    np.testing.assert_array_equal(plain.image, wide.image[:, 8:28])
    np.testing.assert_array_equal(plain.transmittance, wide.transmittance[:, 8:28])
    assert (wide.transmittance[:, :8] < 1).any()
