"""The fast renderer against the slow one: the same bits, whatever the tiles, lists and threads."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from numpy.typing import NDArray

from gaussians import parallel, reference
from gaussians.render import StereoFrame, render_mono, render_stereo
from gaussians.stereo_method import PRESETS
from gaussians.work import EyeWork
from tests import strategies
from tests.naive.tiling import necessary_lists, nested, passing_pixels, recount
from tests.strategies import KINDS, Case, Splat, at_pixel, build_case, build_scene, small_rig

EYES: tuple[reference.Eye, ...] = ("left", "right")


def assert_same_bits(fast: NDArray[np.float32], slow: NDArray[np.float32]) -> None:
    """Every float32 has the bit pattern of the reference."""
    assert fast.dtype == slow.dtype == np.float32 and fast.shape == slow.shape
    differing = fast.view(np.uint32) != slow.view(np.uint32)
    assert not differing.any(), f"{int(differing.sum())} values, first {np.argwhere(differing)[0]}"


def assert_frame_is_the_reference(frame: StereoFrame, case: Case) -> None:
    """Both images, both transmittances, the drawing order and the culls."""
    for eye in EYES:
        wanted = reference.render_eye(case.scene, case.rig, eye, case.background)
        assert_same_bits(getattr(frame, eye), wanted.image)
        assert_same_bits(getattr(frame, f"{eye}_transmittance"), wanted.transmittance)
        assert frame.ids.tolist() == wanted.ids.tolist()
        for reason, count in vars(wanted.culls).items():
            assert getattr(frame.work.front_end, reason) == count, reason
    assert frame.work.front_end.submitted == len(case.scene)
    assert frame.work.front_end.projected == len(frame.ids)


def render(case: Case, method: str, tile_px: int = 4) -> StereoFrame:
    """One frame by a preset."""
    return render_stereo(
        case.scene, case.rig, method=PRESETS[method], background=case.background, tile_px=tile_px
    )


@settings(max_examples=160, deadline=None, derandomize=True, database=None)
@given(strategies.cases())
def test_both_eyes_have_the_bits_of_the_reference(case: Case) -> None:
    assert_frame_is_the_reference(render(case, "independent"), case)
    assert_frame_is_the_reference(render(case, "exact"), case)


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(strategies.cases())
def test_the_image_does_not_depend_on_the_tile_size(case: Case) -> None:
    for tile_px in (8, 16):
        assert_frame_is_the_reference(render(case, "independent", tile_px), case)
        assert_frame_is_the_reference(render(case, "exact", tile_px), case)


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(strategies.cases())
def test_one_eye_alone_is_the_left_eye_of_the_pair(case: Case) -> None:
    wanted = reference.render_eye(case.scene, case.rig, "left", case.background)
    image, transmittance = render_mono(case.scene, case.rig, case.background)
    assert_same_bits(image, wanted.image)
    assert_same_bits(transmittance, wanted.transmittance)


def test_one_eye_alone_culls_what_the_pair_culls() -> None:
    """Needles whose determinant float32 loses in the right eye alone are not drawn on the left."""
    for seed in range(12):
        case = build_case([("needles", seed)], small_rig(baseline_m=0.5))
        wanted = reference.render_eye(case.scene, case.rig, "left")
        assert_same_bits(render_mono(case.scene, case.rig)[0], wanted.image)


@pytest.mark.parametrize("kind", list(KINDS))
def test_each_kind_of_trouble_many_times(kind: str) -> None:
    for seed in range(20):
        case = build_case([(kind, 100 + seed)], small_rig())
        assert_frame_is_the_reference(render(case, "exact"), case)


@pytest.mark.nojit
@pytest.mark.parametrize("kind", list(KINDS))
def test_each_kind_of_trouble_on_its_own(kind: str) -> None:
    for seed in range(3):
        rig = small_rig(21, 13, offset_px=16 * (seed % 2))
        case = build_case([(kind, seed)], rig, degree=seed + 1, background=(1.0, 0.5, 0.25))
        assert_frame_is_the_reference(render(case, "exact", tile_px=(4, 8, 16)[seed]), case)


@pytest.mark.nojit
def test_an_empty_scene_is_background() -> None:
    rig = small_rig(9, 5)
    case = Case(build_scene([], rig, np.zeros((0, 1, 3))), rig, (0.25, 0.5, 0.75))
    for method in ("independent", "exact"):
        assert_frame_is_the_reference(render(case, method), case)


@pytest.mark.parametrize("method", ["independent", "exact", "paper"])
def test_the_frame_does_not_depend_on_the_number_of_threads(method: str) -> None:
    groups = [(kind, seed) for kind in ("wall", "ordinary", "needles") for seed in range(3)]
    case = build_case(groups, small_rig(40, 40), degree=3)
    before = parallel.threads()
    frames = []
    try:
        for count in (1, 2, 5):
            parallel.set_threads(count)
            frames.append(render(case, method))
    finally:
        parallel.set_threads(before)
    for other in frames[1:]:
        assert_equal_frames(frames[0], other)


def assert_equal_frames(one: StereoFrame, two: StereoFrame) -> None:
    """Images, lists and per-tile work, to the bit."""
    for name in ("left", "right", "left_transmittance", "right_transmittance"):
        assert_same_bits(getattr(one, name), getattr(two, name))
    for lists in ("left_lists", "right_lists"):
        np.testing.assert_array_equal(getattr(one, lists).offsets, getattr(two, lists).offsets)
        np.testing.assert_array_equal(getattr(one, lists).splats, getattr(two, lists).splats)
    for part in ("left", "right", "stereo"):
        for name, value in vars(getattr(one.work, part)).items():
            np.testing.assert_array_equal(value, getattr(getattr(two.work, part), name), name)


@settings(max_examples=80, deadline=None, derandomize=True, database=None)
@given(strategies.cases())
def test_lists_are_conservative_and_work_is_what_a_walk_counts(case: Case) -> None:
    shape = (case.rig.display.height, case.rig.display.width)
    for tile_px, method in ((4, "exact"), (8, "independent")):
        frame = render(case, method, tile_px)
        for eye in EYES:
            splats, _ = reference.project(case.scene, case.rig, eye)
            passing, alphas = passing_pixels(splats, shape)
            lists = nested(getattr(frame, f"{eye}_lists"))
            assert_contains(lists, necessary_lists(passing, tile_px))
            assert_same_work(getattr(frame.work, eye), recount(lists, passing, alphas, tile_px))


def assert_contains(lists: list[list[list[int]]], necessary: list[list[list[int]]]) -> None:
    """Every list ascends strictly (depth order, no duplicates) and misses nothing."""
    assert (len(lists), len(lists[0])) == (len(necessary), len(necessary[0]))
    for y, row in enumerate(necessary):
        for x, wanted in enumerate(row):
            assert lists[y][x] == sorted(set(lists[y][x]))
            assert not set(wanted) - set(lists[y][x]), f"tile ({x}, {y})"


def assert_same_work(work: EyeWork, counted: EyeWork) -> None:
    """All six counters of every tile."""
    for name, value in vars(counted).items():
        assert getattr(work, name).dtype == np.int32
        np.testing.assert_array_equal(getattr(work, name), value, name)


def test_lists_are_tight() -> None:
    """Of the entries of well-conditioned splats, hardly any passes nowhere, and none is far off."""
    rig = small_rig(160, 120, focal=(128.0, 128.0))
    splats = [s for seed in range(240) for s in KINDS["ordinary"](np.random.default_rng(seed), rig)]
    scene = build_scene(splats, rig, np.zeros((len(splats), 1, 3)))
    frame = render(Case(scene, rig), "independent")
    entries = useful = 0
    for eye in EYES:
        drawn, _ = reference.project(scene, rig, eye)
        assert (condition_numbers(drawn) < 1e4).all()
        passing, _ = passing_pixels(drawn, (120, 160))
        lists, necessary = nested(getattr(frame, f"{eye}_lists")), necessary_lists(passing, 4)
        for y, row in enumerate(lists):
            for x, ranks in enumerate(row):
                entries += len(ranks)
                useful += len(necessary[y][x])
                for rank in set(ranks) - set(necessary[y][x]):
                    assert touches(drawn, rank, 4 * x, 4 * y, margin_px=0.02)
    assert entries > 10_000
    assert useful >= 0.97 * entries


def condition_numbers(splats: reference.ReferenceSplats) -> NDArray[np.float64]:
    """[M] ratio of the eigenvalues of the image covariance."""
    a, b, c = (value.astype(np.float64) for value in (splats.a, splats.b, splats.c))
    root = np.sqrt((a - c) ** 2 + 4 * b * b)
    return (a + c + root) / (a + c - root)


def touches(
    splats: reference.ReferenceSplats, rank: int, x0: int, y0: int, margin_px: float
) -> bool:
    """Whether the pass ellipse comes within the margin of the tile's pixel centres' rectangle."""
    steps = np.linspace(0.5 - margin_px, 3.5 + margin_px, 400)
    dx = (x0 + steps)[None, :] - float(splats.u[rank])
    dy = (y0 + steps)[:, None] - float(splats.v[rank])
    a, b, c = (float(value[rank]) for value in (splats.a, splats.b, splats.c))
    form = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    return bool((form <= -float(splats.thresholds[rank])).any())


@pytest.mark.parametrize("tiles", [1, 4, 5, 12])
def test_disparity_of_whole_tiles_moves_the_dot_by_whole_tiles(tiles: int) -> None:
    """Up to the whole image and beyond: 12 tiles are 48 px of 37."""
    rig = small_rig(37, 9, focal=(256.0, 256.0))  # B f = 16 px m, exact
    scene_splats = [
        Splat(at_pixel(rig, column, 4.5, 16.0 / (4 * tiles)), (0.0, 0.0, 0.0), 0.5)
        for column in (30.5, 36.5, 36.5 + 4 * tiles)
    ]
    case = Case(build_scene(scene_splats, rig, np.ones((3, 1, 3))), rig)
    frame = render(case, "exact")
    assert_frame_is_the_reference(frame, case)
    seen = np.flatnonzero(frame.right_transmittance[4] == np.float32(0.5)).tolist()
    wanted = [c - 4 * tiles for c in (30, 36, 36 + 4 * tiles) if c >= 4 * tiles]
    assert seen == wanted
