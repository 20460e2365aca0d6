"""Management table and Δcut messages."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.errors import InputError
from lod_cloud.cut import difference
from lod_cloud.delta_cut import IN_CUT, DeltaCut, ManagementTable
from lod_cloud.lod_tree import Int32
from lod_cloud.protocol import RemoteProtocolError, seal, unseal


def ids(*values: int) -> Int32:
    return np.array(values, np.int32)


def apply(table: ManagementTable, cut: set[int]):  # type: ignore[no-untyped-def]
    """The table after a search that found ``cut``, and the change."""
    before, after = table.cut_ids, ids(*sorted(cut))
    index = table.search_index + 1
    return table.updated(index, difference(after, before), difference(before, after))


cuts = st.lists(st.sets(st.integers(0, 12), max_size=8), min_size=1, max_size=40)


@given(cuts, st.integers(1, 5), st.integers(0, 12))
@settings(max_examples=60, deadline=None)
def test_table_equals_a_dictionary(found: list[set[int]], w: int, window: int) -> None:
    table = ManagementTable.empty(w, window)
    last: dict[int, int] = {}
    for index, cut in enumerate(found):
        held = set(last)
        last |= dict.fromkeys(cut, index)
        last = {n: i for n, i in last.items() if not w * (index - i) > window}
        table, change = apply(table, cut)
        assert set(change.needed.tolist()) == cut - held
        assert set(change.evicted.tolist()) == held - set(last)
        assert table.ids.tolist() == sorted(last)
        assert table.cut_ids.tolist() == sorted(cut)
        gone = ~table.in_cut
        assert table.last[gone].tolist() == [last[n] for n in table.ids[gone]]


def test_reuse_window_edge() -> None:
    """w = 4, window 32: a node that left at search 1 is still held at 8, gone at 9 (Sec. 4.3)."""
    table, _ = apply(ManagementTable.empty(4, 32), {0, 1})
    for index in range(1, 9):
        table, change = apply(table, {0})
        assert (1 in table.ids) == (index <= 8)
        assert len(change.evicted) == 0
    table, change = apply(table, {0})
    assert change.evicted.tolist() == [1]
    table, change = apply(table, {0, 1})
    assert change.needed.tolist() == [1]


def test_reactivation_needs_no_payload() -> None:
    table, _ = apply(ManagementTable.empty(1, 5), {3, 7})
    table, _ = apply(table, {3})
    table, change = apply(table, {3, 7, 9})
    assert change.reactivated.tolist() == [7]
    assert change.needed.tolist() == [9]
    assert table.last.tolist() == [IN_CUT] * 3


@given(cuts)
@settings(max_examples=30, deadline=None)
def test_state_hash_is_that_of_the_state(found: list[set[int]]) -> None:
    """Incremental = from scratch: what happened before does not matter, only what is held."""
    table = ManagementTable.empty(2, 6)
    for cut in found:
        table, _ = apply(table, cut)
    fresh = ManagementTable.empty(2, 6)
    for index in range(table.search_index + 1):
        now = table.ids[(table.last == index) | table.in_cut & (index == table.search_index)]
        fresh, _ = apply(fresh, set(now.tolist()))
    assert fresh.ids.tolist() == table.ids.tolist()
    assert fresh.state_hash == table.state_hash


def test_different_states_have_different_hashes() -> None:
    base, _ = apply(ManagementTable.empty(4, 32), {1, 2})
    states = [base, apply(base, {1})[0], apply(base, {2})[0], apply(base, {1, 2, 3})[0]]
    assert len({table.state_hash for table in states}) == 4


def test_impossible_updates_are_refused_and_change_nothing() -> None:
    table, _ = apply(ManagementTable.empty(4, 32), {1, 2})
    none = ids()
    with pytest.raises(InputError, match="search index must be 1"):
        table.updated(2, none, none)
    with pytest.raises(InputError, match="every removed node must be in the cut"):
        table.updated(1, none, ids(5))
    with pytest.raises(InputError, match="no added node may be in the cut"):
        table.updated(1, ids(2), none)
    left, _ = apply(table, {1})
    with pytest.raises(InputError, match="every removed node must be in the cut"):
        left.updated(2, none, ids(2))
    assert table.ids.tolist() == [1, 2]
    with pytest.raises(InputError, match="frames per search must be >= 1"):
        ManagementTable.empty(0, 32)


def test_messages_round_trip() -> None:
    delta = DeltaCut(7, 28, ids(4, 900, 2**31 - 2), ids(), b"payload", 2**64 - 1, 12345)
    back = DeltaCut.from_bytes(delta.to_bytes())
    assert back.reactivated.tolist() == delta.reactivated.tolist()
    assert (back.search_index, back.frame, back.payload) == (7, 28, b"payload")
    assert (back.state_hash, back.codec_hash) == (2**64 - 1, 12345)
    with pytest.raises(RemoteProtocolError, match="message must end here"):
        DeltaCut.from_bytes(delta.to_bytes() + b"x")
    with pytest.raises(RemoteProtocolError, match="more bytes"):
        DeltaCut.from_bytes(delta.to_bytes()[:-1])
    with pytest.raises(RemoteProtocolError, match="must be ascending"):
        DeltaCut.from_bytes(DeltaCut(0, 0, ids(5, 4), ids(), b"", 0, 0).to_bytes())


def test_envelope_refuses_every_damage() -> None:
    message = seal(2, b"some body" * 20)
    assert unseal(message) == (2, b"some body" * 20)
    for cut in range(len(message)):
        with pytest.raises(RemoteProtocolError):
            unseal(message[:cut])
    padding = (6, 7)  # the two spare bytes of the header mean nothing
    for position in range(len(message)):
        if position not in padding:
            damaged = bytearray(message)
            damaged[position] ^= 0x10
            with pytest.raises(RemoteProtocolError):
                unseal(bytes(damaged))
    with pytest.raises(RemoteProtocolError):
        unseal(message + b"x")
