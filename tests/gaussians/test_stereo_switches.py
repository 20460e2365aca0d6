"""Every switch of a stereo method does what its docstring says: kernels against a naive twin."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any, get_args

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gaussians import reference
from gaussians.footprints import INTERSECTIONS
from gaussians.left_view import widened
from gaussians.projection import project
from gaussians.reference import ReferenceSplats
from gaussians.render import StereoFrame, StereoRenderer
from gaussians.stereo_method import (
    PRESETS,
    Forwarding,
    Insertion,
    OutOfRange,
    StereoMethod,
    parse_method,
)
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


INSERTIONS: tuple[Insertion, ...] = get_args(Insertion)


@st.composite
def methods(draw: st.DrawFn, insertion: Insertion) -> StereoMethod:
    """Any valid combination of the other switches that make the right lists."""
    carried = ["forward_only"] if insertion == "carrier" else []
    values: dict[str, Any] = {
        "forwarding": draw(st.sampled_from(["live_alpha_pass", "alpha_pass", "live_list", "list"])),
        "intersection": draw(st.sampled_from(INTERSECTIONS)),
        "rows": draw(st.sampled_from([4, 1, 2])),
        "out_of_range": draw(st.sampled_from([*carried, "drop", "spill", "independent_tile"])),
        "left_view": draw(st.sampled_from([*carried, "image", "widened"])),
        "independent_edge_tiles": draw(st.sampled_from([0, 0, 1, 3])),
        "tie": draw(st.sampled_from(["id", "depth"])),
    }
    return StereoMethod("drawn", insertion=insertion, **values)


ANY = st.sampled_from(INSERTIONS).flatmap(methods)


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
        self.lefts: dict[tuple[str, bool], naive.LeftTiles] = {}

    def alone(self, method: StereoMethod) -> StereoFrame:
        """Both eyes by their own lists of the method's kind."""
        return self.render(parse_method(f"independent,intersection={method.intersection}"))

    def left(self, method: StereoMethod) -> naive.LeftTiles:
        """The left tiles that forward: those of the image, or of the virtual camera behind."""
        key = method.intersection, method.left_view == "widened"
        if key not in self.lefts:
            first, lists = 0, nested(self.alone(method).left_lists)
            columns = range(self.display.width)
            if method.left_view == "widened":
                first, lists = self.wide_lists(method)
                columns = range(first * self.tile_px, (first + len(lists[0])) * self.tile_px)
            facts = naive.passing_window(self.splats, columns, self.display.height)
            self.lefts[key] = naive.left_tiles(lists, first, *facts, self.tile_px)
        return self.lefts[key]

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


def assert_the_left_eye_agrees(subject: Subject, method: StereoMethod, frame: StereoFrame) -> None:
    """Lists of the view that forwards, and what is read of them for the right eye alone."""
    left, found = subject.left(method), frame.work.stereo.walked_after_termination
    assert nested(frame.left_lists) == left.lists
    unread = Counter[tuple[int, int]]()
    for y, row in enumerate(left.lists):
        for x, entries in enumerate(row):
            unread[y, left.first_column + x] = len(entries) - len(left.walked[y][x])
    assert by_column(found, min(0, subject.shift)) == (
        +unread if method.walks_past_termination else Counter()
    )


def assert_the_twin_agrees(subject: Subject, method: StereoMethod) -> naive.Reprojection:
    """Right lists, every FIFO's entries, forward-only entries, losses, and tiles on their own."""
    frame, wanted = subject.render(method), subject.expected(method)
    work = frame.work.stereo
    assert_the_left_eye_agrees(subject, method, frame)
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
        for rule in INSERTIONS
        for event in ("dropped", "spilled", "independent by disparity", "last row")
    ),
    *(
        f"carrier: {event}"
        for event in ("forward-only", "forward-only by a virtual tile", "unseen")
    ),
    *("right_span: unseen", "two_tiles: duplicates", "two_tiles: in one list twice"),
    *(f"{rule}: out of order" for rule in ("two_tiles", "right_span", "carrier")),
}


@settings(max_examples=200)
@given(CASES, TILES, st.tuples(ANY, ANY))
def test_every_switch_of_forwarding_does_what_it_says(
    case: Case, tile_px: int, drawn: tuple[StereoMethod, ...]
) -> None:
    subject = Subject(case, tile_px)
    for method in drawn:
        assert_the_twin_agrees(subject, method)


def every_combination() -> Iterator[StereoMethod]:
    """Of the switches that act on one another."""
    for insertion in INSERTIONS:
        carried = ("forward_only",) if insertion == "carrier" else ()
        for values in product(
            ("live_alpha_pass", "alpha_pass", "live_list", "list"),
            ("drop", "spill", "independent_tile", *carried),
            ("image", "widened", *carried),
            ("id", "depth"),
        ):
            switches: Any = dict(
                zip(("forwarding", "out_of_range", "left_view", "tie"), values, strict=True)
            )
            yield StereoMethod(
                "combined", insertion=insertion, intersection="square_3sigma", rows=2, **switches
            )


def test_every_combination_of_switches_does_what_they_say() -> None:
    """In scenes where everything happens; squares, so that entries need not pass."""
    kinds = (*["depth_ties"] * 4, "whole_tiles_of_disparity", "wall", "left_of_the_left_image")
    groups = [(kind, seed) for seed, kind in enumerate((*kinds, "ordinary"))]
    reached = set[str]()
    for offset_px in (0, 16, -16):
        rig = small_rig(40, 12, focal=(96.0, 96.0), offset_px=offset_px)
        subject = Subject(build_case(groups, rig), 4)
        for method in every_combination():
            reached |= events(method, assert_the_twin_agrees(subject, method))
    assert reached == EVENTS


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
@given(CASES, TILES, ANY, st.booleans(), st.booleans(), st.booleans())
def test_the_right_image_is_drawn_from_its_lists_and_what_is_reused(
    case: Case, tile_px: int, method: StereoMethod, conic: bool, colour: bool, shifted: bool
) -> None:
    method = replace(
        method,
        out_of_range="spill" if method.out_of_range == "independent_tile" else method.out_of_range,
        independent_edge_tiles=0,
        conic="left" if conic else "per_eye",
        colour="left" if colour else "per_eye",
        centre="shifted" if shifted else "projected",
    )
    subject = Subject(case, tile_px)
    frame = subject.render(method)
    splats, right_lists = right_splats(subject, method), nested(frame.right_lists)
    shape = (subject.display.height, subject.display.width)
    wanted = naive.draw(splats, right_lists, shape, tile_px, case.background)
    np.testing.assert_array_equal(frame.right.view(np.uint32), wanted.view(np.uint32))


def stacked(layers: int, behind: int = 0) -> Subject:
    """Layers that fill a left tile, a faint line that no left list holds, and layers behind it.

    The line lies between left pixel columns and moves by 7.5 px, so its carrier is that tile.
    """
    rig = small_rig(40, 8, focal=(128.0, 128.0))
    dot, far_dot = (
        Splat(at_pixel(rig, 22.0, 2.0, depth), (0.0, 0.0, 0.0), 150.0) for depth in (1.0, 2.0)
    )
    depth = 8 / 7.5
    line = Splat(at_pixel(rig, 21.0, 2.0, depth), (0.0, 1.5 * depth / 128, 0.0), 1.2 / 255)
    splats = [*[dot] * layers, line, *[far_dot] * behind]
    return Subject(Case(build_scene(splats, rig, np.ones((len(splats), 1, 3))), rig), 4)


def test_an_added_entry_behind_the_last_live_pixel_comes_too_late() -> None:
    live, exact = parse_method("exact,forwarding=live_list"), PRESETS["exact"]
    enough = len(stacked(150).left(live).walked[0][5])  # layers end the tile
    assert 20 < enough < 150
    for layers, behind, arrives in (
        (enough - 1, 0, True),
        (enough - 1, 1, True),
        (enough, 0, False),
        (enough, 1, False),
    ):
        subject, line = stacked(layers, behind), layers  # its rank
        left = subject.left(live)
        assert left.terminated[0][5] == (layers + behind >= enough) and line not in left.lists[0][5]
        for method, wanted in ((live, arrives), (exact, True)):
            made = assert_the_twin_agrees(subject, method)
            assert any(line in tile for tile in made.right_lists[0]) == wanted
            assert (made.forward_only[0, 5] > 0) == wanted


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


def one_row(
    forwarding: Forwarding, insertions: tuple[Insertion, ...] = INSERTIONS
) -> Iterator[StereoMethod]:
    """Methods with a single row, so that a disparity of 16 px finds none."""
    policies: tuple[OutOfRange, ...] = ("drop", "spill", "independent_tile")
    for insertion, out_of_range in product(insertions, policies):
        yield StereoMethod(
            f"{insertion}, {out_of_range}",
            forwarding,
            insertion=insertion,
            rows=1,
            out_of_range=out_of_range,
            left_view="widened",
        )


def test_a_left_tile_outside_the_left_image_forwards_nothing() -> None:
    """The right window begins 16 px left of the left one; its first four tiles have no source."""
    subject = alone(2.0, 4.0, offset_px=-16)
    made = assert_the_twin_agrees(subject, parse_method("exact,left_view=image,rows=1"))
    assert made.unseen > 0 and not made.forward_only.any()


def test_right_tiles_on_their_own_lose_nothing_and_take_nothing() -> None:
    for subject in (alone(20.0, 0.5), alone(44.0, 0.5)):
        for method in one_row("list"):
            work = subject.render(replace(method, independent_edge_tiles=1024)).work
            assert work.independent_right_tiles == 20
            stereo = work.stereo
            assert stereo.dropped == stereo.spilled == stereo.unseen == 0, method.name
            assert not stereo.fifo_entries.any() and not stereo.forward_only.any(), method.name


def test_what_is_not_forwarded_needs_no_row() -> None:
    """A dot on a pixel corner, too faint for the centres around: its left entries never pass."""
    subject = alone(20.0, 0.5, 1.001 / 255)
    for method in one_row("alpha_pass"):
        method = replace(method, intersection="square_3sigma")
        assert subject.alone(method).left_lists.splats.size > 0
        work = subject.render(method).work
        assert work.stereo.dropped == work.stereo.spilled == 0, method.name
        assert work.independent_right_tiles == 0, method.name


def test_what_no_left_list_holds_is_unseen_and_needs_no_row() -> None:
    """A faint upright line between left pixel columns, 16.5 px away on a right one."""
    subject = alone(20.0, 8 / 16.5, 1.2 / 255, height_px=2.0)
    for method in one_row("list", ("right_span",)):
        lists = subject.alone(method)
        assert lists.left_lists.splats.size == 0 < lists.right_lists.splats.size
        work = subject.render(method).work
        assert work.stereo.unseen == lists.right_lists.splats.size, method.name
        assert work.stereo.dropped == work.stereo.spilled == 0, method.name
        assert work.independent_right_tiles == 0, method.name
