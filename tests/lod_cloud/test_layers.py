"""Nodes sent plain, without harmonics above degree 0, and completed later."""

from __future__ import annotations

import contextlib
import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.scene import FIELDS
from lod_cloud.build import build_tree
from lod_cloud.codec import CompactCodec
from lod_cloud.delta_cut import DeltaCut
from lod_cloud.protocol import DELTA_CUT, RemoteProtocolError, seal, unseal
from lod_cloud.tree_encoder import TreeEncoder
from tests.lod_cloud.hostile_link import HostilePair, settled, world, world_of
from tests.lod_cloud.trees import random_scene, random_tree


@given(st.integers(1, 200), st.integers(0, 999), st.booleans())
@settings(max_examples=25)
def test_harmonics_apart_make_plain_nodes_complete(count: int, seed: int, far: bool) -> None:
    """Plain and then completed is what comes complete at once; no byte of harmonics comes twice."""
    tree = random_tree(count, seed, sh_degree=1)
    codec = CompactCodec.train(tree, seed, words=16)
    if far:
        tree.gaussians.sh[::5, 1:] *= 100.0  # no word is near: float32
    assert codec.apart is not None
    encoder, ids = TreeEncoder(tree, codec), np.arange(len(tree), dtype=np.int32)
    whole, bare = encoder.encode(ids), encoder.encode(ids, plain=True)
    right, plain = codec.decode(whole.payload), codec.decode(bare.payload, plain=True)
    for name in FIELDS[:-1]:
        assert np.array_equal(getattr(plain.gaussians, name), getattr(right.gaussians, name))
    assert np.array_equal(plain.gaussians.sh[:, 0], right.gaussians.sh[:, 0])
    assert not plain.gaussians.sh[:, 1:].any() and "harmonics" not in bare.columns
    later = encoder.encode_harmonics(ids)
    assert sum(later.columns.values()) == len(later.payload)
    inner = tree.child_count > 0
    assert np.array_equal(codec.apart.decode(later.payload, inner), right.gaussians.sh[:, 1:])
    assert abs(len(bare.payload) + len(later.payload) - len(whole.payload)) <= 8
    with pytest.raises(RemoteProtocolError):
        codec.apart.decode(later.payload[:-1], inner)
    with pytest.raises(RemoteProtocolError):
        codec.apart.decode(later.payload + b"\0", inner)
    for position in range(0, len(later.payload), 7):
        damaged = bytearray(later.payload)
        damaged[position] ^= 0xFF
        with contextlib.suppress(RemoteProtocolError):
            codec.apart.decode(bytes(damaged), inner)


def test_what_is_plain_is_not_merged() -> None:
    """A node that takes the place of plain ones is sent; a client refuses to merge it, whatever
    else is right.
    """
    scene = random_scene(400, 3)
    scene.scales[:] = np.maximum(scene.scales, 1e-3)
    scene.opacities[:] = np.maximum(scene.opacities, 0.05)
    tree = build_tree(scene)
    codec = CompactCodec.train(tree, 1, words=8)
    pair = HostilePair(world_of(tree, codec, 3), window=0, budget=300)
    numbers, refused = pair.world.encoder.child_numbers, 0
    for step in range(40):
        pair.act(("teleport", 13 * step))
        right = DeltaCut.from_bytes(unseal(pair.down[-1])[1], numbers)
        if right.events is not None and len(right.events.unmerged):
            events = dataclasses.replace(right.events, unmerged=right.events.unmerged[:0])
            wrong = dataclasses.replace(right, events=events).to_bytes(numbers)
            with pytest.raises(RemoteProtocolError) as error:
                pair.client.receive(seal(DELTA_CUT, wrong))
            refused += "must not be merged from others without harmonics" in str(error.value)
        for action in (("down", 0), ("down", 0), ("up", 0)):
            pair.act(action)  # values are compared
    assert refused > 0 and pair.merged > 0
    assert pair.kinds.count("start") == 1


def completing() -> HostilePair:
    """A session whose client has its cut, some of it still plain; all is acknowledged."""
    pair = HostilePair(world(400, 2, compact=True), budget=150)
    pair.act(("walk", 1))
    pair._deliver_all()
    while pair.completed == 0:
        pair._search()
        pair._deliver_all()
    assert pair.cloud.table.plain_in_cut > 50
    return pair


def doubtful(*, arrives: bool) -> tuple[HostilePair, int]:
    """Two messages that complete nodes, and how many; the second comes first, so the client says
    that something is missing. Then the first comes too, which the cloud does not hear of, or it is
    lost.
    """
    pair = completing()
    before = pair.cloud.table.plain_in_cut
    pair._search()
    pair._search()
    for action in [("down", 1), ("up", 0), ("down" if arrives else "lose_down", 0)]:
        pair.act(action)
    pair.up.clear()
    assert pair.client.applied == pair.cloud.sequence - 2 * (not arrives)
    assert before - pair.cloud.table.plain_in_cut > 10
    return pair, before - pair.cloud.table.plain_in_cut


@pytest.mark.parametrize("arrives", [True, False])
def test_what_may_have_been_completed_is_sent_whole(arrives: bool) -> None:
    """The repair is right for a client that holds these nodes plain, and for one that has them
    complete.
    """
    pair, done = doubtful(arrives=arrives)
    plain = pair.cloud.table.plain_in_cut
    pair._search()
    stats = pair.cloud.stats
    assert stats is not None and stats.kind == "repair"
    assert stats.payloads == done and stats.plain == stats.completed == 0
    pair.act(("down", 0))  # where values are compared
    assert pair.client.table is not None and pair.client.applied == pair.cloud.sequence
    assert pair.client.table.plain_in_cut == pair.cloud.table.plain_in_cut == plain
    pair.heal(lose_what_is_underway=False)
    assert pair.kinds.count("start") == 1


@pytest.mark.parametrize("arrives", [True, False])
def test_a_repair_while_tau_is_raised_makes_nodes_plain_again(arrives: bool) -> None:
    """Much is pending all of a sudden: what the repair sends comes without harmonics, also to a
    client that has them.
    """
    pair, _ = doubtful(arrives=arrives)
    plain, stats = pair.cloud.table.plain_in_cut, pair.cloud.stats
    assert stats is not None
    pair.cloud.stats = dataclasses.replace(stats, pending_error_px=np.inf)
    pair._search()
    stats = pair.cloud.stats
    assert stats is not None and stats.kind == "repair" and stats.tau_px == 30.0
    assert stats.plain == stats.payloads > 0
    pair.act(("down", 0))
    assert pair.client.applied == pair.cloud.sequence
    if arrives:
        assert pair.client.table is not None
        assert pair.client.table.plain(pair.client.table.ids).sum() > plain
    pair.heal(lose_what_is_underway=False)


@pytest.mark.parametrize("arrives", [True, False])
def test_a_repair_completes_what_was_sent_plain(arrives: bool) -> None:
    """Tau was raised when two messages were sent, and is not any more when they are made good."""
    pair = HostilePair(world(400, 2, compact=True), budget=400)
    pair.act(("walk", 1))
    pair._deliver_all()
    pair._search()
    pair._search()
    for action in [("down", 1), ("up", 0), ("down" if arrives else "lose_down", 0)]:
        pair.act(action)
    pair.up.clear()
    plain, stats = pair.cloud.table.plain_in_cut, pair.cloud.stats
    assert stats is not None and stats.plain == stats.payloads > 0
    pair.cloud.stats = dataclasses.replace(stats, pending_error_px=0.0)
    pair._search()
    stats = pair.cloud.stats
    assert stats is not None and stats.kind == "repair" and stats.plain == 0 < stats.payloads
    assert 0 < pair.cloud.table.plain_in_cut < plain
    pair.act(("down", 0))
    assert pair.client.applied == pair.cloud.sequence
    pair.heal(lose_what_is_underway=False)


def test_completing_changes_what_is_drawn() -> None:
    """The client does not show the copy it made before."""
    pair = completing()
    here = pair.world.places[pair._place]
    before = pair.client.select(here)
    pair._search()
    pair._deliver_all()
    after = pair.client.select(here)
    assert np.array_equal(before.node_ids, after.node_ids)
    assert not np.array_equal(before.scene.sh, after.scene.sh)
    pair.settle()
    last = pair.client.select(here)
    right = pair.world.decoded.take(last.node_ids)
    assert np.array_equal(last.scene.sh, right.sh)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"completed": 10**6}, "must complete at most the"),
        ({"harmonics": b""}, "more bytes"),
        ({"base": 0}, None),
        ({"completed": 1}, None),
        ({"completed": 0, "harmonics": b""}, "state hash must be"),
    ],
)
def test_wrong_completions_change_nothing(changes: dict[str, Any], text: str | None) -> None:
    pair = completing()
    pair._search()
    numbers = pair.world.encoder.child_numbers
    right = DeltaCut.from_bytes(unseal(pair.down[0])[1], numbers)
    assert right.completed > 1 and pair.client.table is not None
    before = pair.client.table.state_hash
    wrong = dataclasses.replace(right, **changes)
    with pytest.raises(RemoteProtocolError, match=text):
        pair.client.receive(seal(DELTA_CUT, wrong.to_bytes(numbers)))
    assert pair.client.table.state_hash == before
    pair.compare()
    pair.heal(lose_what_is_underway=False)


def test_a_codec_without_layers_refuses_plain_nodes() -> None:
    pair = settled()
    pair.act(("walk", 2))
    numbers = pair.world.encoder.child_numbers
    right = DeltaCut.from_bytes(unseal(pair.down[0])[1], numbers)
    for changes in ({"plain": True}, {"completed": 1, "harmonics": b"x"}):
        wrong = dataclasses.replace(right, **changes)  # type: ignore[arg-type]
        with pytest.raises(RemoteProtocolError, match="must come with their harmonics"):
            pair.client.receive(seal(DELTA_CUT, wrong.to_bytes(numbers)))
    pair.compare()
