"""Every hostile case is as hostile as it says: each check would fail on a harmless scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from gaussians import reference
from gaussians.constants import OPACITY_MIN
from gaussians.render import render_stereo
from gaussians.stereo_method import PRESETS
from gaussians.synthetic import HOSTILE, HostileCase
from gaussians.tiling import RowSpans
from tests.gaussians.hostile_frames import (
    NAMES,
    TILES,
    Look,
    alone,
    looked_at,
    rendered,
    same_bits,
)

EYES: tuple[reference.Eye, ...] = ("left", "right")


def near_objects(look: Look) -> None:
    assert ((look.splats.depths >= 0.2) & (look.splats.depths <= 1)).all()
    assert (look.disparity[look.seen[1]] > 16).sum() > 50


def disparity_of(pixels: int) -> Callable[[Look], None]:
    def check(look: Look) -> None:
        left, right = look.centres
        np.testing.assert_array_equal(left - right, np.float32(pixels))
        np.testing.assert_array_equal(look.disparity, pixels)
        assert ((left % 4 == 0) & look.seen[1]).sum() >= 5
        assert ((left % 1 == 0.5) & look.seen[1]).sum() >= 10
        if pixels == look.case.rig.display.width:
            assert look.only_right.sum() > 50 and look.seen.all(axis=0).sum() <= 10

    return check


def thin_between_columns(look: Look) -> None:
    """In the very row of tiles; and inside the left window, not beside it."""
    left, right = look.rows.spans
    entries = (left[:, 0] > left[:, 1]) & (right[:, 0] <= right[:, 1])
    ranks = np.unique(look.rows.ranks[entries])
    inside = (look.centres[0, ranks] > 0) & (look.centres[0, ranks] < 96)
    assert inside.sum() >= 50
    work = rendered("thin_between_columns", "exact", 4).work
    assert work.stereo.forward_only.sum() >= 100


def condition(covariances: NDArray[np.float32]) -> NDArray[np.float64]:
    """[M] ratio of the eigenvalues."""
    xx, xy, yy = covariances.astype(np.float64).T
    large = 0.5 * (xx + yy) + np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    return large * large / (xx * yy - xy * xy)


def needles(look: Look) -> None:
    numbers = condition(look.splats.covariances[1])[look.seen[1]]
    turned = look.splats.covariances[1, look.seen[1], 1] != 0
    assert numbers.max() >= 1e8
    assert (numbers[turned] > 1e6).sum() >= 10
    assert look.rows.ill_conditioned >= 10


def right_of_the_left_image(look: Look) -> None:
    assert (look.only_right & (look.centres[0] > 96)).sum() >= 50


def left_of_the_left_image(look: Look) -> None:
    assert (look.only_right & (look.centres[0] < 0)).sum() >= 10


def left_of_the_right_image(look: Look) -> None:
    assert (look.seen[0] & ~look.seen[1] & (look.centres[1] < 0)).sum() >= 50


def huge_at_the_near_plane(look: Look) -> None:
    assert (look.splats.depths == np.float32(look.case.rig.near_m)).sum() == 4
    assert look.splats.behind_near >= 10
    widths = np.sqrt(look.splats.covariances[:, look.seen[1], 0])
    assert (widths[1] > 96).sum() >= 15
    assert (np.abs(np.log2(widths[1] / widths[0])) > 0.5).any()
    spans = look.rows.spans[1]
    across = (spans[:, 0] == 0) & (spans[:, 1] == look.rows.grid.tiles_x - 1)
    assert len(np.unique(look.rows.ranks[across])) >= 15


def faint_giants(look: Look) -> None:
    """Each eye binned alone has rows that the other has not."""
    left, right = (row_entries(alone(look, eye)) for eye in (0, 1))
    assert len(left - right) >= 3 and len(right - left) >= 3
    assert look.case.scene.opacities.max() < 1.001 / 255 and look.seen[1].sum() >= 100


def row_entries(rows: RowSpans) -> set[tuple[int, int]]:
    """All (tile row, splat)."""
    numbers = np.repeat(np.arange(len(rows.offsets) - 1), np.diff(rows.offsets))
    return set(zip(numbers.tolist(), rows.ranks.tolist(), strict=True))


def depth_ties(look: Look) -> None:
    """Several FIFO rows of one tile hold equal depths, and their order decides the image."""
    assert len(np.unique(look.splats.depths.view(np.uint32))) == 1
    for tile_px in TILES:
        frame = rendered("depth_ties", "exact", tile_px)
        rows_used = (frame.work.stereo.fifo_entries > 0).sum(axis=0)
        assert (rows_used >= 2).sum() >= 20
    case = look.case
    back_to_front = case.scene.take(np.arange(len(case.scene))[::-1])
    other = render_stereo(back_to_front, case.rig, PRESETS["exact"], case.background)
    assert (other.right != rendered("depth_ties", "exact", 4).right).any(axis=2).mean() > 0.2


def opacity_at_1_255(look: Look) -> None:
    """Exactly at 1/255 a dot passes only at its very centre; one float below, never."""
    scene = look.case.scene
    levels, counts = np.unique(scene.opacities, return_counts=True)
    assert levels[1] == OPACITY_MIN and (counts == 60).all()
    assert (levels[:3].view(np.uint32) == OPACITY_MIN.view(np.uint32) + np.arange(-1, 2)).all()
    assert look.splats.transparent == 60
    for level, passes in ((levels[0], False), (levels[1], True)):
        chosen = np.flatnonzero(scene.opacities == level)
        for eye in EYES:  # the second half is off the left pixel centres
            hit = transmittance(look.case, chosen[chosen >= 150], eye) < 1
            assert hit.any() == (passes and eye == "right")
        assert (transmittance(look.case, chosen[chosen < 150], "left") < 1).any() == passes


def transmittance(
    case: HostileCase, ids: NDArray[np.int64], eye: reference.Eye
) -> NDArray[np.float32]:
    """Of one eye, of some Gaussians alone."""
    frame = render_stereo(case.scene.take(ids), case.rig, PRESETS["exact"])
    value: NDArray[np.float32] = getattr(frame, f"{eye}_transmittance")
    return value


def wall_hides_the_right_view(look: Look) -> None:
    """Gaussians that no left tile reads before its last pixel stops change the right image."""
    frame = rendered(look.case.name, "independent", 4)
    processed, lists = frame.work.left.processed.ravel(), frame.left_lists
    assert (frame.work.left.terminated.ravel() & (processed < np.diff(lists.offsets))).sum() >= 50
    read = [lists.splats[o : o + n] for o, n in zip(lists.offsets[:-1], processed, strict=True)]
    hidden = np.setdiff1d(lists.splats, np.concatenate(read))
    assert len(hidden) >= 10
    rest = np.setdiff1d(np.arange(len(look.case.scene)), look.splats.ids[hidden])
    without = render_stereo(
        look.case.scene.take(rest), look.case.rig, PRESETS["independent"], look.case.background
    )
    assert same_bits(without.left, frame.left)
    assert (np.abs(without.right - frame.right).max(axis=2) > 0.1).sum() >= 10


def off_axis(sign: int) -> Callable[[Look], None]:
    def check(look: Look) -> None:
        display = look.case.rig.display
        assert display.window_offset_px == sign * 32
        assert look.only_right.sum() >= 10
        assert (look.seen[0] & ~look.seen[1]).sum() >= 10
        assert look.seen.all(axis=0).sum() >= 100

    return check


def odd_size(look: Look) -> None:
    display = look.case.rig.display
    for tile_px in TILES:
        assert display.width % tile_px and display.height % tile_px
        lengths = rendered("odd_size", "exact", tile_px).right_lists.lengths
        assert lengths[-1].any() and lengths[:, -1].any()


def smaller_than_a_tile(look: Look) -> None:
    assert look.rows.grid.tiles_x == 1 and look.case.rig.display.width == 3
    assert (look.disparity[look.seen[1]] > 3).sum() >= 3
    assert look.only_right.sum() >= 3


def baseline_zero(look: Look) -> None:
    np.testing.assert_array_equal(*look.splats.features.view(np.uint32))
    assert look.seen[1].sum() >= 100


def baseline_tenfold(look: Look) -> None:
    assert (look.disparity[look.seen[1]] > 96).sum() >= 20
    assert (look.disparity[look.seen[1]] < 16).sum() >= 20


def scale_1000(look: Look) -> None:
    """The picture of a scene of metres: the disparities are the usual ones."""
    assert look.splats.depths.min() > 250 and look.case.scene.scales.max() > 10
    assert look.disparity.min() >= 1 and 16 < look.disparity.max() < 32
    assert look.seen[1].sum() >= 100


def scale_1000_world_only(look: Look) -> None:
    assert look.disparity.max() < 0.05
    frame = rendered(look.case.name, "exact", 4)
    assert not same_bits(frame.left, frame.right)


def outliers(look: Look) -> None:
    far = look.splats.depths >= 2e4
    assert (far & look.seen[1]).sum() >= 10
    assert np.abs(look.centres).max() > 1e5
    assert look.splats.covariances[1, look.seen[1], 0].max() > 1e6


def view_dependent_colour(look: Look) -> None:
    frame = rendered(look.case.name, "exact", 4)
    assert look.case.scene.sh_degree == 3 and look.seen.all(axis=0).sum() >= 100
    same_colour = replace(look.case.scene, sh=look.case.scene.sh[:, :1])
    plain = render_stereo(same_colour, look.case.rig, PRESETS["exact"], look.case.background)
    assert np.abs(frame.right - plain.right).max() > 0.2
    left, right = (reference.project(look.case.scene, look.case.rig, e)[0].rgb for e in EYES)
    assert (np.abs(left - right).max(axis=1) > 0.1).sum() >= 50


def one_splat(look: Look) -> None:
    assert len(look.case.scene) == 1 and look.seen.all()


def tile_edges(look: Look) -> None:
    left = np.sort(look.centres[0])
    np.testing.assert_array_equal(left, 4 * np.arange(len(left)))
    assert (look.disparity % 4 == 0).sum() >= 10
    assert look.seen.all(axis=0).sum() >= 15


def tilted_close(look: Look) -> None:
    widths = look.splats.covariances[:, look.seen.all(axis=0), 0]
    assert (np.abs(np.log2(widths[1] / widths[0])) > 2).sum() >= 20


def far_from_the_origin(look: Look) -> None:
    assert np.spacing(look.case.scene.means).max() > 5e-4
    assert look.seen[1].sum() >= 100


IS_WHAT_IT_SAYS: dict[str, Callable[[Look], None]] = {
    **{f"disparity_{pixels}_px": disparity_of(pixels) for pixels in (4, 8, 16, 32, 128)},
    "off_axis": off_axis(1),
    "off_axis_inwards": off_axis(-1),
    **{
        check.__name__: check
        for check in (
            near_objects,
            thin_between_columns,
            needles,
            right_of_the_left_image,
            left_of_the_left_image,
            left_of_the_right_image,
            huge_at_the_near_plane,
            faint_giants,
            depth_ties,
            opacity_at_1_255,
            wall_hides_the_right_view,
            odd_size,
            smaller_than_a_tile,
            baseline_zero,
            baseline_tenfold,
            scale_1000,
            scale_1000_world_only,
            outliers,
            view_dependent_colour,
            one_splat,
            tile_edges,
            tilted_close,
            far_from_the_origin,
        )
    },
}


@pytest.mark.parametrize("name", NAMES)
def test_the_case_is_as_hostile_as_it_says(name: str) -> None:
    IS_WHAT_IT_SAYS[name](looked_at(name))


def test_every_case_has_its_check() -> None:
    assert IS_WHAT_IT_SAYS.keys() == HOSTILE.keys()
