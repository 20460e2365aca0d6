"""All searches against the naive one and against each other: cuts and events, bit for bit."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from gaussians import parallel
from gaussians.errors import InputError
from lod_cloud.criterion import SearchRequest
from lod_cloud.cut import without
from lod_cloud.search import SEARCHES, Search, SearchTree, ValiditySearch, auto, make_search
from tests.lod_cloud.search_trees import PATHS, TREES, requests_along, shaped_tree
from tests.naive import search as naive

METHODS = tuple(SEARCHES)


@pytest.fixture(scope="module")
def trees() -> dict[str, SearchTree]:
    return {name: make() for name, make in TREES.items()}


def ids_of(search: Search) -> list[int]:
    """Refined nodes."""
    bits = np.unpackbits(search.refined, bitorder="little")
    return np.flatnonzero(bits).tolist()


def compare(searches: list[Search], requests: Iterable[SearchRequest]) -> int:
    """Let all searches answer every request like the first; returns how many answers there were.

    There must be something to compare: a request, and a second search.
    """
    assert len(searches) > 1
    count = 0
    for request in requests:
        results = [search.search(request) for search in searches]
        for search, result in zip(searches, results, strict=True):
            where = f"{search.name}, search {search.searches}"
            assert np.array_equal(result.expanded, results[0].expanded), where
            assert np.array_equal(result.collapsed, results[0].collapsed), where
            assert np.array_equal(search.refined, searches[0].refined), where
            assert result.cut_size == results[0].cut_size, where
            count += 1
    assert count > 0
    return count


@pytest.mark.nojit
@pytest.mark.parametrize("hysteresis", [0.0, 0.02])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ["binary", "irregular", "comb", "chain", "one leaf", "two leaves"])
def test_method_equals_naive(
    trees: dict[str, SearchTree], name: str, method: str, hysteresis: float
) -> None:
    tree = trees[name]
    search = make_search(method, tree, hysteresis=hysteresis)
    refined: set[int] = set()
    cut: set[int] = set()
    rng = np.random.default_rng(1)
    for path in PATHS:
        for request in requests_along(path, tree, 2 if len(tree) > 300 else 4, rng):
            before, refined = refined, naive.refined_nodes(tree, request, refined, hysteresis)
            was, now = cut, naive.cut_of(tree, refined)
            cut = set(now)
            result = search.search(request)
            assert result.expanded.tolist() == sorted(refined - before)
            assert result.collapsed.tolist() == sorted(before - refined)
            assert result.cut.tolist() == now and result.cut_size == len(now)
            assert result.added.tolist() == sorted(cut - was)
            assert result.removed.tolist() == sorted(was - cut)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("name", TREES)
def test_all_methods_agree(trees: dict[str, SearchTree], name: str, path: str) -> None:
    tree = trees[name]
    for hysteresis in (0.0, 0.05):
        searches = [make_search(method, tree, hysteresis=hysteresis) for method in METHODS]
        rng = np.random.default_rng(len(name))
        compare(searches, requests_along(path, tree, 25, rng))


@pytest.mark.slow
def test_ten_thousand_searches_agree(trees: dict[str, SearchTree]) -> None:
    count = 0
    for seed, (name, tree) in enumerate(trees.items()):
        for hysteresis in (0.0, 0.02):
            searches = [make_search(method, tree, hysteresis=hysteresis) for method in METHODS]
            rng = np.random.default_rng(seed)
            for path in PATHS:
                steps = 150 if name.startswith("large") else 300
                count += compare(searches, requests_along(path, tree, steps, rng))
    assert count >= 10_000


@pytest.mark.parametrize("seed", range(12))
def test_irregular_trees_of_many_shapes(seed: int) -> None:
    tree = shaped_tree("irregular", 50 + 200 * seed, seed)
    rng = np.random.default_rng(seed)
    searches = [make_search(method, tree, hysteresis=0.01 * (seed % 3)) for method in METHODS]
    for path in PATHS:
        compare(searches, requests_along(path, tree, 8, rng))


@pytest.mark.parametrize("size", [1, 2, 7, 100, 10**6])
def test_treelets_of_any_size(trees: dict[str, SearchTree], size: int) -> None:
    tree = trees["irregular"]
    searches = [make_search("flat", tree), ValiditySearch(tree, treelet_nodes=size)]
    rng = np.random.default_rng(0)
    for path in PATHS:
        compare(searches, requests_along(path, tree, 20, rng))


def test_cameras_that_tremble_on_spheres(trees: dict[str, SearchTree]) -> None:
    """A few float32 steps to and fro: the distance grows and the test says it fell. Where rounding
    decides, no decision may be taken to hold.
    """
    tree = trees["binary"]
    k = SearchRequest((0, 0, 0), 200.0, 6.0).factor
    searches = [make_search(m, tree) for m in ("flat", "validity", "wheel", "auto")]
    rng = np.random.default_rng(3)
    flips = 0
    for node in np.flatnonzero(tree.child_count)[::3]:
        direction = rng.normal(size=3)
        t = tree.radius[node] + k * tree.extent[node]
        sphere = tree.means[node] + t * direction / np.linalg.norm(direction)
        for _ in range(40):
            steps = rng.integers(-3, 4, 3) * np.spacing(sphere.astype(np.float32))
            request = SearchRequest(tuple(float(v) for v in sphere + steps), 200.0, 6.0)
            before = searches[0].refined.copy()
            compare(searches, [request])
            flips += bool((before != searches[0].refined).any())
    assert flips > 1000


def test_standing_still_changes_and_tests_nothing(trees: dict[str, SearchTree]) -> None:
    request = SearchRequest((1.0, 2.0, 0.5), 200.0, 6.0)
    for method in METHODS:
        search = make_search(method, trees["binary"])
        first, again = search.search(request), search.search(request)
        assert not len(again.expanded) and not len(again.collapsed)
        assert not len(again.added) and again.cut_size == first.cut_size
        if method in ("wheel",):
            assert again.nodes_tested == 0


def test_few_tests_for_small_steps(trees: dict[str, SearchTree]) -> None:
    """What the wheel is for: on a walk it tests a small share of what a full search tests."""
    tree = trees["large binary"]
    searches = {m: make_search(m, tree) for m in ("streaming", "temporal", "validity", "wheel")}
    tested = dict.fromkeys(searches, 0)
    changes = 0
    for step in range(120):
        request = SearchRequest((-6.0 + 0.06 * step, 1.0, 0.2), 200.0, 6.0)
        for method, search in searches.items():
            result = search.search(request)
            if step:
                tested[method] += result.nodes_tested
                changes += len(result.added) if method == "wheel" else 0
    assert changes > 200
    assert tested["wheel"] < 0.05 * tested["streaming"]
    assert tested["wheel"] < tested["validity"] < 0.7 * tested["temporal"]


def test_hysteresis_keeps_a_swaying_head_quiet(trees: dict[str, SearchTree]) -> None:
    tree = trees["large binary"]
    changes = {}
    for hysteresis in (0.0, 0.05):
        search = make_search("auto", tree, hysteresis=hysteresis)
        sways = (SearchRequest((4 + 0.1 * np.sin(i), 3.0, 0.0), 200.0, 6.0) for i in range(60))
        results = [search.search(request) for request in sways]
        changes[hysteresis] = sum(len(r.expanded) + len(r.collapsed) for r in results[10:])
    assert changes[0.0] > 30 and changes[0.05] < 0.1 * changes[0.0]


def test_auto_searches_in_full_after_a_jump_and_then_less_and_less(
    trees: dict[str, SearchTree],
) -> None:
    tree = trees["large binary"]
    auto, streaming = make_search("auto", tree), make_search("streaming", tree)
    tested = []
    for step in range(80):
        position = (0.02 * step + (15.0 if step >= 40 else 0.0), 1.0, 0.0)
        request = SearchRequest(position, 200.0, 6.0)
        full = streaming.search(request)
        tested.append(auto.search(request).nodes_tested / full.nodes_tested)
    assert max(tested) <= 1.3
    assert tested[0] >= 1 and tested[40] >= 1 and tested[39] < 0.2 and tested[79] < 0.2


@pytest.mark.parametrize("budget", [2, 5, 12])
def test_auto_takes_back_what_it_gave_up(
    trees: dict[str, SearchTree], monkeypatch: pytest.MonkeyPatch, budget: int
) -> None:
    """A search given up half-way leaves no trace: the events are those of the full search."""
    monkeypatch.setattr(auto, "_LEAST", budget)
    monkeypatch.setattr(auto, "_TESTS_SHARE", 0.0)
    monkeypatch.setattr(auto, "_FILL_SHARE", 1.0)
    monkeypatch.setattr(auto, "_PARTS", 1)
    tree = trees["large binary"]
    searches = [make_search(method, tree) for method in ("flat", "auto")]
    given_up = 0
    for step in range(400):  # there and back, in steps of growing size: most collapse something
        x = 0.5 * np.sin(step) * step / 400
        request = SearchRequest((1.0 + x, 1.0, 0.0), 200.0, 6.0)
        results = [search.search(request) for search in searches]
        assert np.array_equal(results[0].expanded, results[1].expanded)
        assert np.array_equal(results[0].collapsed, results[1].collapsed)
        given_up += results[1].nodes_tested > 16 and results[1].nodes_tested % 16 != 0
    assert given_up > 1


def test_threads_change_nothing(trees: dict[str, SearchTree]) -> None:
    tree = trees["large irregular"]
    before = parallel.threads()
    outcomes = []
    try:
        for threads in (1, 2, 3):
            parallel.set_threads(threads)
            outcome = []
            for method in METHODS:
                search = make_search(method, tree, hysteresis=0.01)
                for request in requests_along("walk", tree, 5, np.random.default_rng(2)):
                    result = search.search(request)
                    outcome.append((result.cut.tolist(), result.nodes_tested, result.bytes_touched))
            outcomes.append(outcome)
    finally:
        parallel.set_threads(before)
    assert outcomes[0] == outcomes[1] == outcomes[2]


def test_clients_of_one_tree_do_not_disturb_each_other(trees: dict[str, SearchTree]) -> None:
    tree = trees["binary"]
    for method in METHODS:
        alone, one, other = (make_search(method, tree) for _ in range(3))
        for step in range(10):
            other.search(SearchRequest((-3.0, 0.1 * step, 0.0), 200.0, 6.0))
            request = SearchRequest((0.1 * step, 1.0, 0.0), 200.0, 6.0)
            assert np.array_equal(one.search(request).cut, alone.search(request).cut)


def test_positions_as_far_out_as_they_may_be(trees: dict[str, SearchTree]) -> None:
    tree = trees["binary"]
    far = [1e12, -1e12, 1e6, 0.0, 1e-30, 1e12, 1.0]
    requests = [SearchRequest((x, 0.0, -x), 929.2, tau) for x in far for tau in (0.0, 6.0)]
    compare([make_search(m, tree) for m in METHODS], requests * 3)


def test_the_cut_is_gone_after_the_next_search(trees: dict[str, SearchTree]) -> None:
    search = make_search("wheel", trees["binary"])
    first = search.search(SearchRequest((0, 0, 0), 200.0, 6.0))
    search.search(SearchRequest((1, 0, 0), 200.0, 6.0))
    with pytest.raises(RuntimeError, match="before the next search"):
        _ = first.cut


def test_state_is_bits_per_node_and_entries(trees: dict[str, SearchTree]) -> None:
    """At 5 M leaves: 3 bits per node are 3.75 MB, and 1.3 M entries and the wheel 15 MB."""
    tree = trees["large binary"]
    for method in METHODS:
        search = make_search(method, tree)
        search.search(SearchRequest((0, 0, 0), 200.0, 6.0))
        fixed = 10e6 if method in ("wheel", "auto") else 100
        assert search.state_bytes < fixed + 8 * len(tree)


@pytest.mark.parametrize("hysteresis", [-0.01, 0.06, float("nan")])
def test_hysteresis_out_of_range_is_refused(
    trees: dict[str, SearchTree], hysteresis: float
) -> None:
    with pytest.raises(InputError, match=r"hysteresis must lie in 0\.\.0\.05"):
        make_search("wheel", trees["binary"], hysteresis=hysteresis)


def test_unknown_method_is_refused(trees: dict[str, SearchTree]) -> None:
    with pytest.raises(InputError, match=r"search method must be one of flat, .*, not 'wheels'"):
        make_search("wheels", trees["binary"])


def test_events_are_the_difference_of_cuts(trees: dict[str, SearchTree]) -> None:
    tree = trees["large irregular"]
    search = make_search("wheel", tree)
    before = np.empty(0, np.int32)
    for request in requests_along("flight", tree, 30, np.random.default_rng(5)):
        result = search.search(request)
        assert np.array_equal(result.added, without(result.cut, before))
        assert np.array_equal(result.removed, without(before, result.cut))
        before = result.cut
