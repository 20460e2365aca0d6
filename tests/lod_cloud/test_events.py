"""Events of cuts, and what a client makes of them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lod_cloud.child_numbers import ChildNumbers
from lod_cloud.client import Client
from lod_cloud.cloud import Cloud
from lod_cloud.columns import ColumnReader
from lod_cloud.delta_cut import DeltaCut
from lod_cloud.events import Events
from lod_cloud.lod_tree import Int32
from lod_cloud.outcome import outcome
from lod_cloud.protocol import DELTA_CUT, RemoteProtocolError, seal, unseal
from lod_cloud.search import SearchTree, flat_search, make_search
from tests.lod_cloud.hostile_link import PLACES, World, world
from tests.lod_cloud.trees import random_tree, walk


@given(st.integers(1, 80), st.integers(0, 999))
@settings(max_examples=30)
def test_tops_are_the_collapsed_nodes_that_are_drawn(leaves: int, seed: int) -> None:
    """And only an expanded node that was not drawn before tells its fan-out."""
    tree = random_tree(leaves, seed)
    search = make_search("flat", SearchTree.of(tree))
    before: set[int] = set()
    for request in walk(seed, 6):
        found = search.search(request)
        cut = set(found.cut.tolist())
        events = Events.of(tree, found.expanded, found.collapsed)
        assert set(events.tops.tolist()) == set(found.collapsed.tolist()) & cut
        assert set(events.inner.tolist()) == set(found.collapsed.tolist()) - cut
        fresh = [n for n in found.expanded.tolist() if n not in (before or {0})]
        assert events.fan_outs.tolist() == tree.child_count[fresh].tolist()
        before = cut


def talking(where: World, budget: int | None = None) -> tuple[Cloud, Client]:
    """A session after a few searches."""
    cloud, client = Cloud(where.tree, where.encoder, budget_bytes=budget), Client()
    client.receive(cloud.session_start())
    for frame, place in enumerate((20, 21, 24, 23)):
        client.receive(cloud.search(where.places[place], frame))
    return cloud, client


def said(message: bytes, where: World) -> DeltaCut:
    return DeltaCut.from_bytes(unseal(message)[1], where.encoder.child_numbers)


def test_a_step_carries_no_lists_and_no_ids() -> None:
    where = world(60, 2)
    cloud, _ = talking(where)
    step = said(cloud.search(where.places[26], 9), where)
    assert step.events is not None and cloud.stats is not None and cloud.stats.payloads
    assert not len(step.reactivated) and not len(step.removed)
    cut = flat_search(where.tree, where.places[26]).node_ids
    assert where.encoder.encode(cut).columns["places"] > len(cut) / 8
    coded = where.encoder.encode_step(step.events, cut[:0], cloud.table)
    assert "places" not in coded.columns
    numbers = where.encoder.child_numbers
    again = Events.read(ColumnReader(step.events.to_bytes(numbers)), numbers)
    for field in dataclasses.fields(Events):
        assert np.array_equal(getattr(again, field.name), getattr(step.events, field.name))


@given(st.integers(0, 9999), st.floats(0.5, 12.0), st.integers(1, 200))
@settings(max_examples=60)
def test_first_children_far_apart_and_close_together(seed: int, spread: float, count: int) -> None:
    """In a tree of 40 M nodes, whose numbering both ends know at some places only."""
    rng = np.random.default_rng(seed)
    nodes = 40_000_000
    knots = np.sort(rng.integers(1, nodes, 4096))
    numbers = ChildNumbers(nodes, np.append(knots, nodes).astype(np.int64))
    gaps = np.ceil(np.exp(rng.uniform(0, spread, count))).astype(np.int64)
    expanded = np.cumsum(gaps).astype(np.int32)
    begins = (expanded + np.cumsum(rng.integers(1, 9, count) * gaps)).astype(np.int32)
    nothing = expanded[:0]
    events = Events(expanded, begins, nothing, nothing, nothing, nothing, nothing, nothing)
    again = Events.read(ColumnReader(events.to_bytes(numbers)), numbers)
    assert np.array_equal(again.expanded, expanded)
    assert np.array_equal(again.first_children, begins)


def test_children_with_smaller_ids_than_their_parents_are_refused() -> None:
    """Before anything is done with them."""
    where = world(60, 2)
    _, client = talking(where)
    assert client.table is not None
    node = client.table.cut_ids[where.tree.child_count[client.table.cut_ids] > 0][-1:]
    nothing = node[:0]
    events = Events(node, node - 2, nothing, nothing, nothing, nothing, nothing, nothing)
    with pytest.raises(RemoteProtocolError, match="a parent must have a smaller id"):
        outcome(events, client.table, client._subgraph, merges=False)


def test_what_was_counted_is_what_the_cloud_counted() -> None:
    where = world(60, 2)
    cloud, client = talking(where)
    for frame, place in enumerate((30, 29, 12, 30), 9):
        got = client.receive(cloud.search(where.places[place], frame))
        sent = cloud.stats
        assert sent is not None
        for name in ("payloads", "reactivated", "removed", "evicted", "held", "message_bytes"):
            assert getattr(got, name) == getattr(sent, name), name


def _writable(column: str, values: Int32, events: Events) -> Int32:
    """The same, as far as a message can say it."""
    values = values[values >= 0]
    if column == "fan_outs":
        return values
    if column == "top_parents":
        return np.resize(values, len(events.tops)) if len(values) else events.top_parents
    if column in ("inner_parents", "unmerged"):
        collapsed = np.union1d(events.tops, events.inner).astype(np.int32)
        values = collapsed[values % len(collapsed)] if len(collapsed) else values[:0]
    return np.unique(values)


@given(
    st.sampled_from([field.name for field in dataclasses.fields(Events)]),
    st.lists(st.integers(-3, 2**31 - 1) | st.integers(0, 130), max_size=8),
    st.integers(0, PLACES - 1),
    st.booleans(),
)
@settings(max_examples=120)
def test_strange_events_never_lead_astray(
    column: str, numbers: list[int], place: int, replace: bool
) -> None:
    """With a right checksum, but written by no cloud of ours: refused without a trace, unless they
    say the same in other words (a collapse of a node that has nothing in the cut, for example).
    """
    where = world(60, 2)
    cloud, client = talking(where)
    right = said(cloud.search(where.places[place], 9), where)
    assert right.events is not None and client.table is not None
    old = getattr(right.events, column)
    values = np.array(numbers if replace else [*old.tolist(), *numbers], np.int32)
    values = _writable(column, values, right.events)
    if np.array_equal(values, old):
        return
    events = dataclasses.replace(right.events, **{column: values})
    known = where.encoder.child_numbers
    before = client.table.state_hash, client.table.ids.tolist()
    try:
        body = dataclasses.replace(right, events=events).to_bytes(known)
    except (ValueError, IndexError):
        return  # no message says that
    try:
        client.receive(seal(DELTA_CUT, body))
    except RemoteProtocolError:
        pass
    else:
        assert client.table.state_hash == cloud.table.state_hash
        assert client._subgraph.ids.tolist() == cloud.table.ids.tolist()
        return
    assert (client.table.state_hash, client.table.ids.tolist()) == before
    client.receive(seal(DELTA_CUT, right.to_bytes(known)))
    assert client.table.state_hash == cloud.table.state_hash


@given(
    st.integers(0, PLACES - 1),
    st.integers(0, 4000),
    st.integers(1, 255),
    st.booleans(),
    st.sampled_from([None, 300, 500, 900]),
)
@settings(max_examples=150)
def test_strange_bytes_never_lead_astray(
    place: int, at: int, flip: int, compact: bool, budget: int | None
) -> None:
    """A message with a right checksum around wrong bytes: refused, or the same nodes. With a budget
    some are held plain, or about to be completed.
    """
    where = world(60, 2, compact=compact)
    cloud, client = talking(where, budget)
    body = bytearray(unseal(cloud.search(where.places[place], 9))[1])
    body[at % len(body)] ^= flip
    assert client.table is not None
    before = client.table.state_hash
    try:
        client.receive(seal(DELTA_CUT, bytes(body)))
    except RemoteProtocolError:
        assert client.table.state_hash == before
    assert client.table.state_hash in (before, cloud.table.state_hash)
    assert np.array_equal(client.table.ids, client._subgraph.ids)
