"""Which events come first, and messages within a byte budget."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.errors import InputError
from lod_cloud.byte_budget import RAISED_TAU_PX, ByteBudget
from lod_cloud.client import Client
from lod_cloud.cloud import Cloud
from lod_cloud.codec import Codec, CompactCodec, PaperCodec
from lod_cloud.criterion import SearchRequest
from lod_cloud.cut import is_complete
from lod_cloud.lod_tree import Int32
from lod_cloud.pacing import FIRST_STAGE_PX, ClientCut, Limit, Portion
from lod_cloud.search import SearchTree, make_search
from lod_cloud.search.events import cut_nodes, nodes_that_entered
from tests.lod_cloud.hostile_link import HostilePair, world
from tests.lod_cloud.trees import random_tree, walk

TREE = random_tree(1500, 8)
HOT = SearchTree.of(TREE)
NEAR = SearchRequest((4.0, 0.0, 0.0), 929.2, 6.0)
FAR = SearchRequest((-40.0, 30.0, 0.0), 929.2, 6.0)


def limit(nodes: float) -> Limit:
    """So many nodes, ids costing an eighth of one."""
    return Limit(nodes, 1.0, 0.125)


def errors_px(nodes: Int32, request: SearchRequest) -> np.ndarray:
    """The tau at which each node is just refined."""
    away = HOT.means[nodes].astype(float) - np.array(request.position)
    beyond = np.sqrt((away**2).sum(axis=1)) - HOT.radius[nodes]
    with np.errstate(divide="ignore"):
        ratio = np.where(beyond > 0, HOT.extent[nodes] / np.maximum(beyond, 0), np.inf)
    return 0.5 * request.focal_px * ratio - 0.5


def stage_below(error_px: float) -> float:
    """The stage to which something with such an error is expanded."""
    stage = FIRST_STAGE_PX
    while stage >= error_px:
        stage /= 2
    return stage


def pending(client: ClientCut, wanted: np.ndarray) -> Int32:
    return client.all_to(wanted).expanded


def test_coarse_to_fine_near_first_and_no_finer_than_the_stage() -> None:
    search = make_search("flat", HOT)
    search.search(NEAR)
    client = ClientCut(HOT)
    last_error, steps = np.inf, 0
    while len(before := pending(client, search.refined)):
        portion = client.first_to(search.refined, NEAR, limit(40), least=1)
        client.commit(portion)
        left = pending(client, search.refined)
        largest = errors_px(left, NEAR).max(initial=0.0)
        assert portion.pending_error_px == pytest.approx(largest, rel=1e-5)
        assert portion.pending_error_px <= last_error
        stage = stage_below(errors_px(before, NEAR).max())
        finest = errors_px(portion.expanded, NEAR).min()
        assert finest > stage or largest <= stage  # the stage is complete before the next begins
        ready = before[np.isin(HOT.parent[before], before, invert=True)]
        first = errors_px(np.intersect1d(ready, portion.expanded), NEAR)
        waiting = errors_px(np.intersect1d(ready, left), NEAR)
        if len(waiting) and len(first):
            assert first.min() >= waiting.max() / 1.02  # in steps of 1.1 %
        last_error, steps = portion.pending_error_px, steps + 1
    assert steps > 5
    assert portion.last and portion.pending_error_px == 0.0


def test_a_message_that_holds_all_sends_no_node_in_vain() -> None:
    search = make_search("flat", HOT)
    found = search.search(NEAR)
    client = ClientCut(HOT)
    portion = client.first_to(search.refined, NEAR, limit(found.cut_size), least=0)
    assert portion.last
    assert np.array_equal(portion.expanded, client.all_to(search.refined).expanded)


def test_after_a_jump_nothing_is_sent_for_the_old_place() -> None:
    """What was pending is forgotten, what is no longer wanted goes by whole subtrees, and the cut
    does not grow beyond the larger of the one held and the one wanted (and one event).
    """
    search = make_search("flat", HOT)
    client = ClientCut(HOT)
    search.search(NEAR)
    for _ in range(6):
        client.commit(client.first_to(search.refined, NEAR, limit(60), least=1))
    wanted = search.search(FAR)
    steps = 0
    while True:
        size = client.size
        portion = client.first_to(search.refined, FAR, limit(60), least=1)
        wanted_nodes = set(np.flatnonzero(np.unpackbits(search.refined, bitorder="little")))
        assert set(portion.expanded.tolist()) <= wanted_nodes
        client.commit(portion)
        assert client.size <= max(size, wanted.cut_size) + HOT.child_count.max()
        steps += 1
        if portion.last:
            break
        assert len(portion.expanded) or len(portion.collapsed)
    assert steps < 40
    assert client.size == wanted.cut_size


@given(
    st.integers(1, 120), st.integers(0, 99), st.sampled_from([0.5, 3.0, 20.0]), st.integers(0, 1)
)
@settings(max_examples=40)
def test_every_choice_leaves_a_cut_and_comes_nearer(
    leaves: int, seed: int, nodes: float, least: int
) -> None:
    tree = random_tree(leaves, seed)
    hot = SearchTree.of(tree)
    search, client = make_search("flat", hot, hysteresis=0.05), ClientCut(hot)
    for request in walk(seed, 8):
        search.search(request)
        before = client.all_to(search.refined)
        portion = client.first_to(search.refined, request, limit(nodes), least=least)
        assert np.isin(portion.expanded, before.expanded).all()
        assert np.isin(portion.collapsed, before.collapsed).all()
        events = len(portion.expanded) + len(portion.collapsed)
        assert events >= min(least, len(before.expanded) + len(before.collapsed))
        client.commit(portion)
        cut = cut_nodes(hot, client._refined, client.size)
        assert is_complete(tree, cut)
        wanted = cut_nodes(hot, search.refined, search.cut_size)
        assert portion.pending == len(np.setdiff1d(wanted, cut))
        assert portion.last == (client.all_to(search.refined).expanded.size == 0) or portion.pending


def test_no_message_is_larger_than_the_budget_and_most_are_full() -> None:
    codec = PaperCodec.train(TREE, 1, words=16)
    cloud, client = Cloud(TREE, codec, search=make_search("flat", HOT), budget_bytes=4000), Client()
    client.receive(cloud.session_start())
    sizes, short, taus, frame = [], [], [], 0
    for request in (NEAR, FAR):
        while True:
            message = cloud.search(request, frame)
            client.receive(message)
            cloud.receive(client.report())
            assert cloud.stats is not None and client.table is not None
            assert client.table.state_hash == cloud.table.state_hash
            frame += 4
            sizes.append(len(message))
            taus.append(cloud.stats.tau_px)
            if cloud.stats.pending and len(message) < 0.8 * 4000:
                short.append(len(message))
            if cloud.stats.pending == 0 and cloud.stats.tau_px == request.tau_px:
                break
            assert (cloud.stats.deferred_bytes > 0) == (cloud.stats.pending > 0)
        assert cloud.found is not None
        assert np.array_equal(client.table.cut_ids, cloud.found.cut)
    assert max(sizes) <= 4000
    assert len(sizes) > 10 and len(short) <= 1
    assert taus[0] == RAISED_TAU_PX and taus[-1] == 6.0


@pytest.mark.parametrize("train", [PaperCodec.train, CompactCodec.train])
def test_the_very_first_message_is_full(train: Callable[..., Codec]) -> None:
    """What it shows of the bytes of a node is not taken into account twice."""
    codec = train(TREE, 1, words=16)
    for size in (3000, 8000, 20_000):
        cloud = Cloud(TREE, codec, search=make_search("flat", HOT), budget_bytes=size)
        message = cloud.search(NEAR, 0)
        assert cloud.stats is not None and cloud.stats.pending
        assert 0.9 * size <= len(message) <= size


def test_harmonics_fill_what_nothing_else_needs() -> None:
    """From nothing: plain while tau is raised, then complete, and those that stayed are completed
    in the order of their ids, in messages as full as any.
    """
    codec = CompactCodec.train(TREE, 1, words=16)
    cloud, client = Cloud(TREE, codec, search=make_search("flat", HOT), budget_bytes=1500), Client()
    client.receive(cloud.session_start())
    rows, frame = [], 0
    while not rows or rows[-1].pending or rows[-1].tau_px > 6.0 or rows[-1].pending_harmonics:
        received = client.receive(cloud.search(NEAR, frame))
        cloud.receive(client.report())
        assert cloud.stats is not None and received.completed == cloud.stats.completed
        frame += 4
        rows.append(cloud.stats)
        assert len(rows) < 200
    assert all(row.plain == (row.payloads if row.tau_px == RAISED_TAU_PX else 0) for row in rows)
    assert all(row.completed == 0 for row in rows if row.pending or row.tau_px > 6.0)
    completing = [row for row in rows if row.completed]
    assert len(completing) > 1
    assert max(row.message_bytes for row in rows) <= 1500
    assert all(row.message_bytes >= 0.8 * 1500 for row in completing[:-1])
    whole = Cloud(TREE, codec, search=make_search("flat", HOT), budget_bytes=10**7)
    assert len(whole.search(NEAR, 0)) and whole.stats and whole.stats.plain == whole.stats.payloads
    for frame in (4, 8):
        whole.search(NEAR, frame)
    assert whole.stats.pending_harmonics == 0


@pytest.mark.parametrize(
    ("sh_degree", "train", "budget"),
    [(0, CompactCodec.train, 1500), (1, PaperCodec.train, 1500), (1, CompactCodec.train, None)],
)
def test_nothing_is_plain_without_layers_or_a_budget(
    sh_degree: int, train: Callable[..., Codec], budget: int | None
) -> None:
    tree = random_tree(400, 8, sh_degree=sh_degree)
    search = make_search("flat", SearchTree.of(tree))
    cloud = Cloud(tree, train(tree, 1, words=16), search=search, budget_bytes=budget)
    for frame in range(4):
        cloud.search(FAR if frame % 2 else NEAR, frame)
        assert cloud.stats is not None and cloud.stats.added
        assert cloud.stats.plain == cloud.stats.pending_harmonics == 0


def test_tau_is_raised_at_the_start_and_when_far_behind() -> None:
    pair = HostilePair(world(60, 2), budget=250)
    pair.act(("walk", 1))
    last = pair.cloud.stats
    assert last is not None
    budget, request = ByteBudget(1000), SearchRequest((0, 0, 0), 200.0, 6.0)
    behind = [(6.0, 0.0, 6.0), (6.0, 60.0, 6.0), (6.0, 61.0, 30.0), (30.0, 1.0, 30.0)]
    behind += [(30.0, 0.0, 6.0), (6.0, np.inf, 30.0)]
    for tau, error, expected in behind:
        stats = dataclasses.replace(last, tau_px=tau, pending_error_px=error)
        assert budget.request(request, stats).tau_px == expected, (tau, error)
        assert budget.raised == (expected == 30.0)
    assert budget.request(request, None).tau_px == 30.0
    coarse = dataclasses.replace(request, tau_px=45.0)
    assert budget.request(coarse, None) is coarse and not budget.raised


@pytest.mark.parametrize("compact", [False, True])
def test_a_still_camera_is_served_to_the_end_one_event_at_a_time(compact: bool) -> None:
    pair = HostilePair(world(60, 2, compact=compact), budget=1)
    pair.act(("walk", 1))
    pair._deliver_all()
    left = pair.settle()
    assert len(left) > 10 and left[-1] == 0
    assert (pair.plain > 0, pair.completed > 0) == (compact, compact)
    assert pair.cloud.found is not None
    assert np.array_equal(pair.cloud.table.cut_ids, pair.cloud.found.cut)


def test_a_search_of_another_tree_and_no_bytes_are_refused() -> None:
    codec = PaperCodec.train(TREE, 1, words=16)
    with pytest.raises(InputError, match="byte budget must be at least 1 B, not 0"):
        Cloud(TREE, codec, budget_bytes=0)
    other = make_search("flat", SearchTree.of(random_tree(7, 1)))
    with pytest.raises(InputError, match="the search must be one in this tree of 2999 nodes"):
        Cloud(TREE, codec, search=other)


def test_nothing_pending_is_last() -> None:
    nothing = np.empty(0, np.int32)
    assert Portion(nothing, nothing).last
    assert not Portion(nothing, nothing, pending=1).last


def test_where_a_cut_may_not_grow_collapses_make_room_for_expansions() -> None:
    """From one place to another with as large a cut: every portion but the last is full."""
    search, client = make_search("flat", HOT), ClientCut(HOT)
    search.search(SearchRequest((4.0, 0.0, 0.0), 100.0, 6.0))
    client.commit(client.all_to(search.refined))
    there = SearchRequest((-6.0, 2.0, 1.0), 100.0, 6.0)
    assert search.search(there).cut_size <= client.size
    steps = 0
    while True:
        waiting = client.all_to(search.refined).expanded.size
        portion = client.first_to(search.refined, there, limit(30), least=1)
        client.commit(portion)
        steps += 1
        if portion.last:
            break
        entered = nodes_that_entered(HOT, portion.expanded, portion.collapsed)
        ids = len(portion.expanded) + len(portion.collapsed)
        assert len(entered) + ids / 8 > 20
        assert len(portion.expanded) or not waiting
    assert steps > 5
