"""Management table and Δcut messages."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.errors import InputError
from lod_cloud.child_numbers import ChildNumbers
from lod_cloud.cut import without
from lod_cloud.delta_cut import DeltaCut, Probe, Report
from lod_cloud.events import Events
from lod_cloud.lod_tree import Int32
from lod_cloud.management_table import IN_CUT, ManagementTable, TableChange
from lod_cloud.protocol import RemoteProtocolError, seal, unseal


def ids(*values: int) -> Int32:
    return np.array(values, np.int32)


def apply(table: ManagementTable, cut: set[int]) -> TableChange:
    """What a search changes that found ``cut``; the change is made."""
    before, after = table.cut_ids, ids(*sorted(cut))
    index = table.search_index + 1
    change = table.prepare_step(index, without(after, before), without(before, after))
    table.commit(change)
    return change


def table_after(*found: set[int], w: int = 4, window: int = 32, nodes: int = 16) -> ManagementTable:
    table = ManagementTable(nodes, w, window)
    for cut in found:
        apply(table, cut)
    return table


cuts = st.lists(st.sets(st.integers(0, 12), max_size=8), min_size=1, max_size=40)


@given(cuts, st.integers(1, 5), st.integers(0, 12))
@settings(max_examples=60)
def test_table_equals_a_dictionary(found: list[set[int]], w: int, window: int) -> None:
    table = ManagementTable(13, w, window)
    last: dict[int, int] = {}
    for index, cut in enumerate(found):
        held = set(last)
        last |= dict.fromkeys(cut, index)
        last = {n: i for n, i in last.items() if not w * (index - i) > window}
        change = apply(table, cut)
        assert set(change.needed.tolist()) == cut - held
        assert set(change.evicted.tolist()) == held - set(last)
        assert table.ids.tolist() == sorted(last)
        assert table.cut_ids.tolist() == sorted(cut)
        assert len(table) == len(last)
        gone = ~table.in_cut(table.ids)
        assert table.last[gone].tolist() == [last[n] for n in table.ids[gone]]


def test_reuse_window_edge() -> None:
    """w = 4, window 32: a node that left at search 1 is still held at 8, gone at 9 (Sec. 4.3)."""
    table = table_after({0, 1})
    for index in range(1, 9):
        change = apply(table, {0})
        assert (1 in table.ids) == (index <= 8)
        assert len(change.evicted) == 0
    assert apply(table, {0}).evicted.tolist() == [1]
    assert apply(table, {0, 1}).needed.tolist() == [1]


def test_reactivation_needs_no_payload() -> None:
    table = table_after({3, 7}, {3}, w=1, window=5)
    change = apply(table, {3, 7, 9})
    assert change.entered.tolist() == [7, 9]
    assert (change.needed.tolist(), change.reactivated) == ([9], 1)
    assert table.last.tolist() == [IN_CUT] * 3


@given(cuts)
@settings(max_examples=30)
def test_state_hash_is_that_of_the_state(found: list[set[int]]) -> None:
    """Incremental = from scratch: what happened before does not matter, only what is held."""
    table = table_after(*found, w=2, window=6)
    fresh = ManagementTable(16, 2, 6)
    for index in range(table.search_index + 1):
        now = (table.last == index) | (table.last == IN_CUT) & (index == table.search_index)
        apply(fresh, set(table.ids[now].tolist()))
    assert fresh.ids.tolist() == table.ids.tolist()
    assert fresh.state_hash == table.state_hash


def test_different_states_have_different_hashes() -> None:
    states = [table_after({1, 2}, *more) for more in ([], [{1}], [{2}], [{1, 2, 3}])]
    assert len({table.state_hash for table in states}) == 4


def test_impossible_updates_are_refused_and_change_nothing() -> None:
    table, none = table_after({1, 2}), ids()
    with pytest.raises(InputError, match="search index must be above 0, not 0"):
        table.prepare_step(0, none, none)
    with pytest.raises(InputError, match="every removed node must be in the cut"):
        table.prepare_step(1, none, ids(5))
    with pytest.raises(InputError, match="no added node may be in the cut"):
        table.prepare_step(1, ids(2), none)
    with pytest.raises(InputError, match="named only once"):
        table.prepare(1, ids(2), none, ids(2))
    for strange in (ids(16), ids(-1)):
        with pytest.raises(InputError, match="node ids must be 0 to 15"):
            table.prepare(1, strange, none, none)
    left = table_after({1, 2}, {1})
    with pytest.raises(InputError, match="every removed node must be in the cut"):
        left.prepare_step(2, none, ids(2))
    assert table.ids.tolist() == [1, 2]
    for bad, text in (((0, 4, 32), "at least 1 node"), ((9, 0, 32), "frames per search must be")):
        with pytest.raises(InputError, match=text):
            ManagementTable(*bad)
    with pytest.raises(InputError, match="reuse window must be at most 250 searches, not 251"):
        ManagementTable(9, 4, 251 * 4)


@given(
    cuts,
    st.sets(st.integers(0, 12)),
    st.sets(st.integers(0, 12)),
    st.sets(st.integers(0, 12)),
    st.integers(1, 30),
)
@settings(max_examples=60)
def test_a_state_can_be_set_whatever_was_before(
    found: list[set[int]], entered: set[int], left: set[int], dropped: set[int], skipped: int
) -> None:
    """`prepare` names what becomes of nodes; tables that differ only in those become equal."""
    table = table_after(*found, w=2, window=6)
    left = (left & set(table.ids.tolist())) - entered
    dropped = dropped - entered - left
    index = table.search_index + skipped
    named = entered | left | dropped
    expected = {
        node: last
        for node, last in zip(table.ids.tolist(), table.last.tolist(), strict=True)
        if node not in named and index - last <= 3
    }
    expected |= dict.fromkeys(entered, int(IN_CUT)) | dict.fromkeys(left, index - 1)
    change = table.prepare(index, *(ids(*sorted(s)) for s in (entered, left, dropped)))
    table.commit(change)
    assert dict(zip(table.ids.tolist(), table.last.tolist(), strict=True)) == expected
    assert len(table) == len(expected)
    again = table.prepare(index + 1, ids(), ids(), ids())
    assert set(again.evicted.tolist()) == {n for n, last in expected.items() if index - last > 2}


@given(cuts, st.integers(0, 999), st.sampled_from([0, 6]))
@settings(max_examples=60)
def test_plain_and_complete_are_part_of_the_state(
    found: list[set[int]], seed: int, window: int
) -> None:
    """The table equals a dictionary whatever comes plain and is completed; what is not held is not
    plain; and another history of the same state gives the same hash.
    """
    rng = np.random.default_rng(seed)
    table, fresh = ManagementTable(13, 2, window), ManagementTable(13, 2, window)
    plain: set[int] = set()
    for index, cut in enumerate(found):
        before, after = set(table.cut_ids.tolist()), ids(*sorted(cut))
        added, removed = ids(*sorted(cut - before)), ids(*sorted(before - cut))
        fresh_nodes = added[~table.holds(added)]
        sent = fresh_nodes[rng.random(len(fresh_nodes)) < 0.6]
        waiting = table.waiting(removed)
        assert set(waiting.tolist()) == plain & before & cut
        done = waiting[: rng.integers(0, len(waiting) + 1)]
        change = table.prepare_step(index, added, removed, sent, done)
        table.commit(change)
        plain = (plain - set(done.tolist()) | set(sent.tolist())) & set(table.ids.tolist())
        assert set(np.flatnonzero(table.plain(np.arange(13, dtype=np.int32)))) == plain
        assert table.plain_in_cut == len(plain & cut) == change.plain_in_cut
        # the same at once: every node of the cut named, with what it is
        bare = after[table.plain(after)]
        others = without(after, bare)
        again = fresh.prepare(index, after, removed, ids(), bare, others)
        fresh.commit(again)
        assert fresh.state_hash == table.state_hash
        assert fresh.plain_in_cut == table.plain_in_cut


def test_plain_and_complete_nodes_have_different_hashes() -> None:
    tables = [ManagementTable(16, 4, 32) for _ in range(3)]
    for table, plain in zip(tables, (ids(), ids(1), ids(2)), strict=True):
        table.commit(table.prepare_step(0, ids(1, 2), ids(), plain))
    assert len({table.state_hash for table in tables}) == 3
    done = tables[1].prepare_step(1, ids(), ids(), ids(), ids(1))
    assert done.state_hash == tables[0].state_hash
    with pytest.raises(InputError, match="every node to be completed must be held"):
        tables[1].prepare_step(1, ids(), ids(), ids(), ids(5))
    left = tables[1].prepare_step(1, ids(), ids(1))
    tables[1].commit(left)
    assert tables[1].waiting(ids()).tolist() == [] and tables[1].plain_in_cut == 0
    tables[1].commit(tables[1].prepare_step(2, ids(1), ids()))
    assert tables[1].waiting(ids()).tolist() == [1]  # came back as it was held


def test_the_queue_of_those_that_left_stays_in_proportion() -> None:
    """Two cuts in turn: every node leaves again and again within the reuse window."""
    table = ManagementTable(40_000, 1, 250)
    halves = [np.arange(20_000, dtype=np.int32) + 20_000 * i for i in range(2)]
    table.commit(table.prepare_step(0, halves[0], ids()))
    for index in range(1, 60):
        table.commit(table.prepare_step(index, halves[index % 2], halves[1 - index % 2]))
    assert table.state_bytes <= table.nodes + 8 * len(table) + 4 * (4096 + 20_000)


def test_messages_round_trip() -> None:
    delta = DeltaCut(
        session=5,
        sequence=9,
        base=3,
        search_index=7,
        frame=28,
        reactivated=ids(4, 900, 2**31 - 2),
        removed=ids(),
        dropped=ids(6),
        payload=b"payload",
        state_hash=2**64 - 1,
        codec_hash=12345,
    )
    numbers = ChildNumbers(1, np.array([1, 1]))
    back = DeltaCut.from_bytes(delta.to_bytes(numbers), numbers)
    for field in dataclasses.fields(delta):
        assert np.array_equal(getattr(back, field.name), getattr(delta, field.name))
    events = Events(ids(), ids(), ids(), ids(), ids(), ids(), ids(), ids())
    none = {"reactivated": ids(), "dropped": ids(), "events": events}
    completing = dataclasses.replace(delta, **none, completed=300, harmonics=b"some")
    plain = dataclasses.replace(delta, plain=True)
    for other in (plain, completing):
        back = DeltaCut.from_bytes(other.to_bytes(numbers), numbers)
        assert (back.plain, back.completed) == (other.plain, other.completed)
        assert (back.harmonics, back.payload) == (other.harmonics, b"payload")
    for wrong in (
        dataclasses.replace(completing, plain=True),
        dataclasses.replace(delta, completed=2, harmonics=b"x"),
    ):
        with pytest.raises(RemoteProtocolError, match="must carry either events or lists"):
            DeltaCut.from_bytes(wrong.to_bytes(numbers), numbers)
    none_at_all = completing.to_bytes(numbers).replace(b"\xac\x02\x04some", b"\x00\x04some")
    with pytest.raises(RemoteProtocolError, match="must complete at least one node, or none"):
        DeltaCut.from_bytes(none_at_all, numbers)
    with pytest.raises(RemoteProtocolError, match="more bytes"):
        DeltaCut.from_bytes(delta.to_bytes(numbers)[:20], numbers)
    late = dataclasses.replace(delta, search_index=2**31)
    with pytest.raises(RemoteProtocolError, match="must be at most 2147483647"):
        DeltaCut.from_bytes(late.to_bytes(numbers), numbers)
    with pytest.raises(RemoteProtocolError, match="base must be below sequence number 9, not 9"):
        DeltaCut.from_bytes(dataclasses.replace(delta, base=9).to_bytes(numbers), numbers)
    probe, report = Probe(1, 2), Report(1, 2, 3, 4, 5, True, False)
    assert Probe.from_bytes(probe.to_bytes()) == probe
    assert Report.from_bytes(report.to_bytes()) == report
    with pytest.raises(RemoteProtocolError, match="must have 12 bytes, not 13"):
        Probe.from_bytes(probe.to_bytes() + b"x")
    with pytest.raises(RemoteProtocolError, match="flags of a report must be 0 to 3, not 4"):
        Report.from_bytes(report.to_bytes()[:-1] + b"\x04")


def test_envelope_refuses_every_damage() -> None:
    message = seal(2, b"some body" * 20)
    assert unseal(message) == (2, b"some body" * 20)
    for cut in range(len(message)):
        with pytest.raises(RemoteProtocolError):
            unseal(message[:cut])
    for position in range(len(message)):
        damaged = bytearray(message)
        damaged[position] ^= 0x10
        with pytest.raises(RemoteProtocolError):
            unseal(bytes(damaged))
    with pytest.raises(RemoteProtocolError):
        unseal(message + b"x")
