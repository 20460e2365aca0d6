"""Events of cuts, and what a client makes of them."""

from __future__ import annotations

import dataclasses

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from lod_cloud.client import Client
from lod_cloud.cloud import Cloud
from lod_cloud.columns import ColumnReader
from lod_cloud.cut import compose, difference
from lod_cloud.delta_cut import DeltaCut
from lod_cloud.events import Events
from lod_cloud.lod_tree import Int32
from lod_cloud.protocol import DELTA_CUT, RemoteProtocolError, seal, unseal
from lod_cloud.search import SearchTree, flat_search
from tests.lod_cloud.hostile_link import PLACES, World, world
from tests.lod_cloud.trees import random_tree, walk
from tests.naive import search as naive

NONE = np.empty(0, np.int32)


@given(st.integers(1, 80), st.integers(0, 999))
@settings(max_examples=40)
def test_events_are_the_difference_of_the_refined_sets(leaves: int, seed: int) -> None:
    tree = random_tree(leaves, seed)
    before: Int32 = np.zeros(1, np.int32)
    refined_before: set[int] = set()
    for request in walk(seed, 6):
        cut = flat_search(tree, request).node_ids
        refined = naive.refined_nodes(SearchTree.of(tree), request, set())
        added, removed = difference(cut, before), difference(before, cut)
        events = Events.between(tree, added, removed, NONE)
        assert set(events.expanded.tolist()) == refined - refined_before
        collapsed = refined_before - refined
        assert sorted(collapsed) == np.union1d(events.tops, events.inner).tolist()
        assert set(events.tops.tolist()) == collapsed & set(cut.tolist())
        before, refined_before = cut, refined


@given(st.lists(st.sets(st.integers(0, 9)), min_size=3, max_size=3))
def test_two_changes_are_one(sets: list[set[int]]) -> None:
    first, second, third = (np.array(sorted(s), np.int32) for s in sets)

    def change(one: Int32, other: Int32) -> tuple[Int32, Int32]:
        return difference(other, one), difference(one, other)

    both = compose(change(first, second), change(second, third))
    for found, expected in zip(both, change(first, third), strict=True):
        assert np.array_equal(found, expected)


def talking(where: World) -> tuple[Cloud, Client]:
    """A session after a few searches."""
    cloud, client = Cloud(where.tree, where.encoder), Client()
    client.receive(cloud.session_start())
    for frame, place in enumerate((20, 21, 24, 23)):
        client.receive(cloud.send(where.cuts[place], frame))
    return cloud, client


def test_a_step_carries_no_lists_and_no_ids() -> None:
    where = world(60, 2)
    cloud, _ = talking(where)
    step = DeltaCut.from_bytes(unseal(cloud.send(where.cuts[26], 9))[1])
    assert step.events is not None and cloud.stats is not None and cloud.stats.payloads
    assert not len(step.reactivated) and not len(step.removed)
    with_ids, _ = where.encoder.encode(difference(where.cuts[26].node_ids, NONE))
    without_ids, _ = where.encoder.encode(where.cuts[26].node_ids, places=False)
    assert len(with_ids) - len(without_ids) == 8 * len(where.cuts[26])
    again = Events.read(ColumnReader(step.events.to_bytes()))
    for field in dataclasses.fields(Events):
        assert np.array_equal(getattr(again, field.name), getattr(step.events, field.name))


def test_what_was_counted_is_what_the_cloud_counted() -> None:
    where = world(60, 2)
    cloud, client = talking(where)
    for frame, place in enumerate((30, 29, 12, 30), 9):
        got = client.receive(cloud.send(where.cuts[place], frame))
        sent = cloud.stats
        assert sent is not None
        for name in ("payloads", "reactivated", "removed", "evicted", "held", "message_bytes"):
            assert getattr(got, name) == getattr(sent, name), name


@given(
    st.sampled_from([field.name for field in dataclasses.fields(Events)]),
    st.lists(st.integers(-3, 2**31 - 1) | st.integers(0, 130), max_size=8),
    st.integers(0, PLACES - 1),
    st.booleans(),
)
@settings(max_examples=200)
def test_strange_events_never_lead_astray(
    column: str, numbers: list[int], place: int, replace: bool
) -> None:
    """With a right checksum, but written by no cloud of ours: refused without a trace, unless they
    say the same in other words (a collapse of a node that has nothing in the cut, for example).
    """
    where = world(60, 2)
    cloud, client = talking(where)
    right = DeltaCut.from_bytes(unseal(cloud.send(where.cuts[place], 9))[1])
    assert right.events is not None and client.table is not None
    old = getattr(right.events, column)
    values = np.array(numbers if replace else [*old.tolist(), *numbers], np.int32)
    if np.array_equal(values, old):
        return
    events = dataclasses.replace(right.events, **{column: values})
    before = client.table.state_hash, client.table.ids.tolist()
    message = seal(DELTA_CUT, dataclasses.replace(right, events=events).to_bytes())
    try:
        client.receive(message)
    except RemoteProtocolError:
        pass
    else:
        assert client.table.state_hash == cloud.table.state_hash
        assert client._subgraph.ids.tolist() == cloud.table.ids.tolist()
        return
    assert (client.table.state_hash, client.table.ids.tolist()) == before
    client.receive(seal(DELTA_CUT, right.to_bytes()))
    assert client.table.state_hash == cloud.table.state_hash
