"""Stereo methods: what `exact` promises list for list, and what `paper` loses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from numpy.typing import NDArray

from gaussians import reference
from gaussians.cameras import StereoRig
from gaussians.render import StereoFrame, render_stereo
from gaussians.stereo_method import PRESETS
from gaussians.work import StereoWork
from tests import strategies
from tests.naive.stereo import carry
from tests.naive.tiling import nested, passing_pixels
from tests.strategies import Case, Splat, at_pixel, build_case, build_scene, small_rig


def render(case: Case, method: str, tile_px: int = 4) -> StereoFrame:
    """One frame by a preset."""
    return render_stereo(
        case.scene, case.rig, method=PRESETS[method], background=case.background, tile_px=tile_px
    )


def disparity_tiles(case: Case, tile_px: int) -> NDArray[np.int64]:
    """[M] disparity B f / z in tiles, rounded up; float32 quotient of the rounded product B f."""
    splats, _ = reference.project(case.scene, case.rig, "left")
    product = np.float32(case.rig.baseline_m * case.rig.display.fx)
    return np.ceil(product / splats.depths / np.float32(tile_px)).astype(np.int64)


def assert_the_carrier_rule_explains(case: Case, tile_px: int) -> None:
    """Lists equal the independent ones; row writes and forward-only entries as the rule says."""
    exact = render(case, "exact", tile_px)
    independent = render(case, "independent", tile_px)
    np.testing.assert_array_equal(exact.right_lists.offsets, independent.right_lists.offsets)
    np.testing.assert_array_equal(exact.right_lists.splats, independent.right_lists.splats)
    naive = carry(
        nested(independent.left_lists),
        nested(independent.right_lists),
        disparity_tiles(case, tile_px),
        rows=PRESETS["exact"].rows,
        offset_tiles=int(case.rig.display.window_offset_px) // tile_px,
    )
    assert naive.right_lists == nested(exact.right_lists)
    work = exact.work.stereo
    np.testing.assert_array_equal(work.fifo_entries, naive.fifo_entries)
    np.testing.assert_array_equal(work.forward_only, naive.forward_only)
    assert work.fifo_entries.sum() == len(exact.right_lists.splats)
    assert work.dropped == work.duplicates == 0


@pytest.mark.parametrize("tile_px", [4, 8, 16])
@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(case=strategies.cases())
def test_exact_lists_are_the_independent_lists(tile_px: int, case: Case) -> None:
    assert_the_carrier_rule_explains(case, tile_px)


@pytest.mark.nojit
@pytest.mark.parametrize("offset_px", [0, 16, 48])
@pytest.mark.parametrize("baseline_m", [0.0, 0.6])
def test_exact_on_and_off_axis_with_and_without_baseline(offset_px: int, baseline_m: float) -> None:
    rig = small_rig(21, 9, offset_px=offset_px, baseline_m=baseline_m)
    kinds = ("ordinary", "whole_tiles_of_disparity", "left_of_the_left_image")
    assert_the_carrier_rule_explains(build_case([(kind, 1) for kind in kinds], rig), 4)


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@given(strategies.cases())
def test_the_front_end_counts_what_the_lists_hold(case: Case) -> None:
    frame = render(case, "independent")
    front_end = frame.work.front_end
    left, right = nested(frame.left_lists), nested(frame.right_lists)
    assert front_end.left_pairs == len(frame.left_lists.splats)
    assert front_end.right_pairs == len(frame.right_lists.splats)
    seen = set(frame.left_lists.splats.tolist()) | set(frame.right_lists.splats.tolist())
    assert front_end.visible == len(seen)
    # one row list serves both eyes: it holds every splat that either eye lists in that row
    rows = [
        {splat for lists in (left, right) for ranks in lists[y] for splat in ranks}
        for y in range(len(left))
    ]
    assert front_end.row_entries >= sum(len(row) for row in rows)


def test_splats_wholly_left_of_the_left_image_reach_into_the_right_one() -> None:
    """Discs edge-on to the left eye: no left tile holds them, binning has to forward them."""
    rig = small_rig()
    found = 0
    for seed in range(12):
        case = build_case([("left_of_the_left_image", seed)], rig)
        frame = render(case, "exact")
        wanted = reference.render_eye(case.scene, rig, "right")
        np.testing.assert_array_equal(frame.right.view(np.uint32), wanted.image.view(np.uint32))
        left, right = (
            passing_pixels(reference.project(case.scene, rig, eye)[0], (29, 37))[0].any(axis=(1, 2))
            for eye in ("left", "right")
        )
        assert set(np.flatnonzero(right)) <= set(frame.right_lists.splats.tolist())
        hidden = right & ~left
        found += int(hidden.sum())
        if hidden.any():
            assert frame.work.stereo.forward_only.sum() > 0
    assert found >= 5


@pytest.mark.nojit
def test_independent_eyes_use_no_stereo_hardware() -> None:
    case = build_case([("ordinary", 0), ("wall", 0)], small_rig(17, 9))
    work = render(case, "independent").work
    assert not work.shared_front_end
    for name in StereoWork.__dataclass_fields__:
        assert not np.any(getattr(work.stereo, name)), name


@pytest.mark.nojit
@pytest.mark.parametrize("offset_px", [0, 16])
def test_a_left_tile_that_stops_early_still_walks_its_list(offset_px: int) -> None:
    """Opaque layers close every left pixel; what lies behind them is read for the right eye."""
    rig = small_rig(16, 16, offset_px=offset_px)
    layers = [
        Splat(at_pixel(rig, 8.0, 8.0, depth), (depth, depth, 0.0), 1.0)
        for depth in (1.0, 1.1, 1.2, 2.0, 3.0, 4.0)
    ]
    work = render(Case(build_scene(layers, rig, np.ones((6, 1, 3))), rig), "exact").work
    unread = work.left.entries - work.left.processed
    assert work.left.terminated.all() and (unread > 0).all()
    walked = work.stereo.walked_after_termination
    np.testing.assert_array_equal(walked[:, : unread.shape[1]], unread)
    # columns of the plane beyond the left window draw nothing, so nothing terminates there
    assert walked.shape == work.stereo.forward_only.shape
    assert not walked[:, unread.shape[1] :].any()


def dots(rig: StereoRig, depths: list[float]) -> Case:
    """Isolated opaque dots of one tile each, far from one another, one colour from everywhere."""
    splats, sh = [], []
    for i, depth in enumerate(depths):
        size = 0.8 * depth / rig.display.fx
        position = at_pixel(rig, 22.0 + 12 * (i % 6), 6.0 + 12 * (i // 6), depth)
        splats.append(Splat(position, (size, size, size), 0.95))
        sh.append([[0.5, 0.2 * (i % 5), -0.3]])
    return Case(build_scene(splats, rig, np.array(sh)), rig)


def psnr(image: NDArray[np.float32], wanted: NDArray[np.float32]) -> float:
    """In dB, peak 1."""
    error = float(np.mean((image.astype(np.float64) - wanted) ** 2))
    return np.inf if error == 0 else -10 * np.log10(error)


def test_paper_is_close_where_its_assumptions_hold() -> None:
    """Isolated dots, disparity below 16 px, SH 0: 53.5 dB, and still not the same bits."""
    rig = small_rig(96, 40, focal=(96.0, 96.0))  # B f = 6 px m
    case = dots(rig, [6.0 / (0.7 + 0.8 * i) for i in range(18)])
    frame = render(case, "paper")
    wanted = reference.render_eye(case.scene, rig, "right").image
    assert frame.work.stereo.dropped == 0
    assert psnr(frame.right, wanted) > 48 > 30 > psnr(np.zeros_like(wanted), wanted)
    assert (frame.right != wanted).any()
    np.testing.assert_array_equal(frame.left, render(case, "exact").left)


def test_paper_loses_what_moves_by_more_than_its_rows() -> None:
    """Two dots, one moving by 17 px (five tiles), one by 3 px: only the second arrives."""
    rig = small_rig(96, 40, focal=(96.0, 96.0))
    case = dots(rig, [6.0 / 17.0, 6.0 / 3.0])
    frame = render(case, "paper")
    wanted = reference.render_eye(case.scene, rig, "right").transmittance
    lost, kept = (6, 22 - 17), (6, 34 - 3)
    assert frame.work.stereo.dropped > 0
    assert wanted[lost] < 0.3 and frame.right_transmittance[lost] == 1
    assert wanted[kept] < 0.3 and abs(frame.right_transmittance[kept] - wanted[kept]) < 0.01
