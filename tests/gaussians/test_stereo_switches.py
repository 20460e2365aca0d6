"""Every switch of a stereo method does what its docstring says: kernels against a naive twin."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gaussians import reference
from gaussians.left_view import widened
from gaussians.projection import project
from gaussians.reference import ReferenceSplats
from gaussians.render import StereoFrame, StereoRenderer
from gaussians.stereo_method import Insertion, StereoMethod, parse_method
from gaussians.tiling import TileGrid, row_spans, tile_lists
from tests.naive import stereo as naive
from tests.naive.tiling import Lists, nested
from tests.strategies import Case, Splat, at_pixel, build_case, build_scene, cases, small_rig
from tests.threshold_cases import threshold_cases

TILES = st.sampled_from([4, 8])
TIES = st.builds(
    lambda seed, rig: build_case([("depth_ties", seed), ("depth_ties", seed + 1)], rig),
    st.integers(0, 999),
    st.builds(
        small_rig,
        st.just(37),
        st.just(13),
        focal=st.sampled_from([(64.0, 64.0), (128.0, 128.0)]),
        offset_px=st.sampled_from([0, 16, -16]),
    ),
)
CASES = st.one_of(threshold_cases(), cases(), TIES)


@st.composite
def methods(draw: st.DrawFn) -> StereoMethod:
    """Any valid combination of the switches that make the right lists."""
    insertion = draw(st.sampled_from(get_args(Insertion)))
    carried = ["forward_only"] if insertion == "carrier" else []
    return StereoMethod(
        "drawn",
        draw(st.sampled_from(["live_alpha_pass", "alpha_pass", "live_list", "list"])),
        insertion=insertion,
        intersection=draw(st.sampled_from(["ellipse", "square_3sigma", "obb"])),
        rows=draw(st.sampled_from([4, 1, 2])),
        out_of_range=draw(st.sampled_from([*carried, "drop", "spill", "independent_tile"])),
        left_view=draw(st.sampled_from([*carried, "image", "widened"])),
        independent_edge_tiles=draw(st.sampled_from([0, 0, 1, 3])),
        tie=draw(st.sampled_from(["id", "depth"])),
    )


class Subject:
    """One case rendered by any method, and what the naive twin needs to know of it."""

    def __init__(self, case: Case, tile_px: int) -> None:
        self.case, self.tile_px, self.display = case, tile_px, case.rig.display
        self.grid = TileGrid(self.display.width, self.display.height, tile_px)
        self.shift = int(self.display.window_offset_px) // tile_px
        self.render = StereoRenderer(case.scene, case.rig, case.background, tile_px).render
        self.splats, _ = reference.project(case.scene, case.rig, "left")
        product = np.float32(case.rig.baseline_m * self.display.fx)
        self.disparity = product / self.splats.depths / np.float32(tile_px)  # in tiles

    def alone(self, method: StereoMethod) -> StereoFrame:
        """Both eyes by their own lists of the method's kind."""
        return self.render(parse_method(f"independent,intersection={method.intersection}"))

    def left(self, method: StereoMethod) -> naive.LeftTiles:
        """The left tiles that forward: those of the image, or of the virtual camera behind."""
        first, lists = 0, nested(self.alone(method).left_lists)
        columns = range(self.display.width)
        if method.left_view == "widened":
            first, lists = self.wide_lists(method)
            columns = range(first * self.tile_px, (first + len(lists[0])) * self.tile_px)
        facts = naive.passing_window(self.splats, columns, self.display.height)
        return naive.left_tiles(lists, first, *facts, self.tile_px)

    def wide_lists(self, method: StereoMethod) -> tuple[int, Lists]:
        """Lists of the image plane, cut where a splat's depth leaves the virtual camera's view."""
        grid = widened(self.case.rig, self.grid)
        rows = row_spans(project(self.case.scene, self.case.rig), grid, method.intersection)
        beyond = np.maximum(np.ceil(self.disparity) + self.shift, 0)
        ends = self.grid.tiles_x + beyond - grid.first_column
        lists = [
            [[splat for splat in tile if x < ends[splat]] for x, tile in enumerate(row)]
            for row in nested(tile_lists(rows, 0))
        ]
        return grid.first_column, lists

    def expected(self, method: StereoMethod) -> naive.Reprojection:
        return naive.reproject(
            method,
            self.left(method),
            nested(self.alone(method).right_lists),
            self.disparity,
            self.splats.depths,
            self.shift,
        )


def by_column(counts: NDArray[np.int32], first_column: int) -> Counter[tuple[int, int]]:
    """What stands in (tile row, column of the plane)."""
    return Counter({(y, x + first_column): int(n) for (y, x), n in np.ndenumerate(counts) if n})


def kernel_contradicts(method: StereoMethod, shift: int) -> bool:
    """Where the kernels do not do what the docstrings say: the expected failures below."""
    return (
        (method.left_view == "image" and method.out_of_range == "forward_only" and shift != 0)
        or method.independent_edge_tiles > 0
        or (not method.by_disparity and method.out_of_range in ("drop", "independent_tile"))
    )


def assert_the_lists_agree(subject: Subject, method: StereoMethod) -> naive.Reprojection:
    """Lists and FIFOs alone, for what the kernels miscount."""
    frame, wanted = subject.render(method), subject.expected(method)
    assert nested(frame.right_lists) == wanted.right_lists
    np.testing.assert_array_equal(frame.work.stereo.fifo_entries, wanted.fifo_entries)
    return wanted


def assert_the_twin_agrees(subject: Subject, method: StereoMethod) -> naive.Reprojection:
    """Right lists, every FIFO's entries, forward-only entries, losses, and tiles on their own."""
    frame, wanted = subject.render(method), subject.expected(method)
    work = frame.work.stereo
    counts = ("dropped", "spilled", "unseen", "duplicates")
    assert [getattr(work, name) for name in counts] == [getattr(wanted, name) for name in counts]
    assert frame.work.independent_right_tiles == len(wanted.independent)
    assert nested(frame.right_lists) == wanted.right_lists
    np.testing.assert_array_equal(work.fifo_entries, wanted.fifo_entries)
    found = by_column(work.forward_only, min(0, subject.shift))
    assert found == by_column(wanted.forward_only, wanted.first_column)
    own, edge = subject.alone(method).right, subject.tile_px
    for y, t in wanted.independent:
        tile = np.s_[y * edge : (y + 1) * edge, t * edge : (t + 1) * edge]
        np.testing.assert_array_equal(frame.right[tile], own[tile])
    return wanted


def events(method: StereoMethod, made: naive.Reprojection) -> set[str]:
    """What the method did in this frame."""
    tiles = [tile for row in made.right_lists for tile in row]
    edge = method.independent_edge_tiles * len(made.right_lists)
    happened = {
        "dropped": made.dropped,
        "spilled": made.spilled,
        "unseen": made.unseen,
        "duplicates": made.duplicates,
        "forward-only": made.forward_only.any(),
        "forward-only by a virtual tile": made.forward_only[:, : -made.first_column].any(),
        "independent by disparity": len(made.independent) > edge,
        "out of order": any(tile != sorted(tile) for tile in tiles),
        "in one list twice": any(len(tile) != len(set(tile)) for tile in tiles),
        "last row": made.fifo_entries[method.rows - 1].any(),
    }
    return {f"{method.insertion}: {event}" for event, did in happened.items() if did}


EVENTS = {
    *(
        f"{rule}: {event}"
        for rule in ("floor", "round", "two_tiles", "right_span", "carrier")
        for event in ("dropped", "spilled", "independent by disparity", "last row")
    ),
    *(
        f"carrier: {event}"
        for event in ("forward-only", "forward-only by a virtual tile", "unseen")
    ),
    *("right_span: unseen", "two_tiles: duplicates"),
    *(f"{rule}: out of order" for rule in ("two_tiles", "right_span", "carrier")),
}


def test_every_switch_of_forwarding_does_what_it_says() -> None:
    reached: set[str] = set()

    @settings(max_examples=250)
    @given(CASES, TILES, st.lists(methods(), min_size=4, max_size=4))
    def compare(case: Case, tile_px: int, drawn: list[StereoMethod]) -> None:
        subject = Subject(case, tile_px)
        for method in drawn:
            check = assert_the_twin_agrees
            if kernel_contradicts(method, subject.shift):
                # an independent tile too many has no list, a tile outside the arrays no memory
                if method.out_of_range in ("independent_tile", "forward_only"):
                    continue
                check = assert_the_lists_agree
            reached.update(events(method, check(subject, method)))

    compare()
    undecided = {f"{rule}: independent by disparity" for rule in ("right_span", "carrier")}
    assert EVENTS - reached == undecided


def right_splats(subject: Subject, method: StereoMethod) -> ReferenceSplats:
    """The right eye's splats, with what the method takes from the left eye."""
    left, rig = subject.splats, subject.case.rig
    right, _ = reference.project(subject.case.scene, rig, "right")
    if method.conic == "left":
        right = replace(right, a=left.a, b=left.b, c=left.c)
    if method.colour == "left":
        right = replace(right, rgb=left.rgb)
    if method.centre == "shifted":
        moved = left.u - np.float32(rig.baseline_m * rig.display.fx) / left.depths
        right = replace(right, u=moved - np.float32(rig.display.window_offset_px))
    return right


@settings(max_examples=60)
@given(
    CASES,
    TILES,
    methods(),
    st.sampled_from(["left", "per_eye"]),
    st.sampled_from(["left", "per_eye"]),
    st.sampled_from(["shifted", "projected"]),
)
def test_the_right_image_is_drawn_from_its_lists_and_what_is_reused(
    case: Case, tile_px: int, lists: StereoMethod, conic: str, colour: str, centre: str
) -> None:
    out_of_range = "spill" if lists.out_of_range == "independent_tile" else lists.out_of_range
    method = replace(
        lists,
        out_of_range=out_of_range,
        independent_edge_tiles=0,
        conic=conic,
        colour=colour,
        centre=centre,
    )
    subject = Subject(case, tile_px)
    assume(not (method.left_view == "image" and method.out_of_range == "forward_only"))
    frame = subject.render(method)
    splats, right_lists = right_splats(subject, method), nested(frame.right_lists)
    shape = (subject.display.height, subject.display.width)
    wanted = naive.draw(splats, right_lists, shape, tile_px, case.background)
    np.testing.assert_array_equal(frame.right.view(np.uint32), wanted.view(np.uint32))


def alone(
    column: float,
    depth: float,
    opacity: float = 0.9,
    *,
    height_px: float = 0.0,
    offset_px: int = 0,
) -> Subject:
    """One dot or upright line, 40 x 8 px, tiles of 4 px, disparity 8 / depth px."""
    rig = small_rig(40, 8, focal=(128.0, 128.0), offset_px=offset_px)
    scales = (0.0, height_px * depth / 128.0, 0.0)
    splat = Splat(at_pixel(rig, column, 4.0, depth), scales, opacity)
    return Subject(Case(build_scene([splat], rig, np.ones((1, 1, 3))), rig), 4)


def one_row(forwarding: str, view: str = "widened", *insertions: str) -> Iterator[StereoMethod]:
    """Methods with a single row, so that a disparity of 16 px finds none."""
    for insertion in insertions or get_args(Insertion):
        for out_of_range in ("drop", "spill", "independent_tile"):
            yield StereoMethod(
                f"{insertion}, {out_of_range}",
                forwarding,
                insertion=insertion,
                rows=1,
                out_of_range=out_of_range,
                left_view=view,
            )


@pytest.mark.xfail(
    strict=True, reason="_by_footprint moves a carrier out of the left view, even out of its arrays"
)
def test_a_left_tile_outside_the_left_image_forwards_nothing() -> None:
    """The right window begins 16 px left of the left one; its first four tiles have no source."""
    subject = alone(2.0, 4.0, offset_px=-16)
    made = assert_the_twin_agrees(subject, parse_method("exact,left_view=image,rows=1"))
    assert made.unseen > 0 and not made.forward_only.any()


@pytest.mark.xfail(strict=True, reason="forwards to independent tiles are counted")
def test_right_tiles_on_their_own_lose_nothing_and_take_nothing() -> None:
    for subject in (alone(20.0, 0.5), alone(44.0, 0.5)):
        for method in one_row("list"):
            work = subject.render(replace(method, independent_edge_tiles=1024)).work
            assert work.independent_right_tiles == 20
            stereo = work.stereo
            assert stereo.dropped == stereo.spilled == stereo.unseen == 0, method.name
            assert not stereo.fifo_entries.any() and not stereo.forward_only.any(), method.name


@pytest.mark.xfail(strict=True, reason="_by_footprint looks for a row before it looks at the mark")
def test_what_is_not_forwarded_needs_no_row() -> None:
    """A dot on a pixel corner, too faint for the centres around: its left entries never pass."""
    subject = alone(20.0, 0.5, 1.001 / 255)
    for method in one_row("alpha_pass"):
        method = replace(method, intersection="square_3sigma")
        assert subject.alone(method).left_lists.splats.size > 0
        work = subject.render(method).work
        assert work.stereo.dropped == work.stereo.spilled == 0, method.name
        assert work.independent_right_tiles == 0, method.name


@pytest.mark.xfail(strict=True, reason="_by_footprint looks for a row before it looks for a list")
def test_what_no_left_list_holds_is_unseen_and_needs_no_row() -> None:
    """A faint upright line between left pixel columns, 16.5 px away on a right one."""
    subject = alone(20.0, 8 / 16.5, 1.2 / 255, height_px=2.0)
    for method in one_row("list", "widened", "right_span"):
        lists = subject.alone(method)
        assert lists.left_lists.splats.size == 0 < lists.right_lists.splats.size
        work = subject.render(method).work
        assert work.stereo.unseen == lists.right_lists.splats.size, method.name
        assert work.stereo.dropped == work.stereo.spilled == 0, method.name
        assert work.independent_right_tiles == 0, method.name
