"""Cloud and client together: equal tables, complete selections, refusal of what is out of order."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.errors import InputError
from gaussians.scene import FIELDS
from lod_cloud.client import Client
from lod_cloud.cloud import Cloud
from lod_cloud.codec import PaperCodec
from lod_cloud.criterion import SearchRequest
from lod_cloud.cut import is_complete
from lod_cloud.lod_tree import LodTree
from lod_cloud.node_records import NodeRecords
from lod_cloud.protocol import LocalProtocolError, RemoteProtocolError, seal
from lod_cloud.search import SearchTree, flat_search, make_search
from tests.lod_cloud.trees import random_tree, requests, walk
from tests.naive import search as naive


def pair(
    tree: LodTree, *, w: int = 4, window: int = 32, words: int = 32
) -> tuple[Cloud, Client, PaperCodec]:
    """A session that has just started."""
    codec = PaperCodec.train(tree, 1, words=words)
    search = make_search("flat", SearchTree.of(tree))
    cloud = Cloud(tree, codec, search=search, frames_per_search=w, reuse_window_frames=window)
    client = Client()
    client.receive(cloud.session_start())
    return cloud, client, codec


def same_state(cloud: Cloud, client: Client) -> bool:
    assert client.table is not None
    return (
        np.array_equal(cloud.table.ids, client.table.ids)
        and np.array_equal(cloud.table.last, client.table.last)
        and cloud.table.state_hash == client.table.state_hash
    )


def as_decoded(tree: LodTree, client: Client, codec: PaperCodec) -> LodTree:
    """The tree with the numbers the client would decode for every node."""
    cloud = Cloud(tree, codec)
    payload = cloud._encoder.encode(np.arange(len(tree), dtype=np.int32)).payload
    nodes = codec.decode(payload)
    return dataclasses.replace(
        tree, gaussians=nodes.gaussians, radius=nodes.radius, extent=nodes.extent
    )


@pytest.mark.nojit
@given(st.integers(2, 150), st.integers(0, 999), st.sampled_from([(1, 3), (4, 32), (4, 0), (2, 7)]))
@settings(max_examples=20, deadline=None)
def test_tables_stay_equal_and_selections_complete(
    count: int, seed: int, windows: tuple[int, int]
) -> None:
    tree = random_tree(count, seed)
    cloud, client, codec = pair(tree, w=windows[0], window=windows[1])
    decoded = as_decoded(tree, client, codec)
    rng = np.random.default_rng(seed)
    for index, request in enumerate(walk(seed, 25)):
        stats = client.receive(cloud.search(request, windows[0] * index))
        assert same_state(cloud, client)
        assert cloud.found is not None and cloud.stats is not None and client.table is not None
        assert np.array_equal(client.table.cut_ids, cloud.found.cut)
        assert stats.payloads == cloud.stats.payloads
        moved = tuple(np.add(request.position, rng.normal(0, 1.0, 3)))
        own = SearchRequest(moved, request.focal_px, request.tau_px)
        selection = client.select(own)
        assert is_complete(tree, selection.node_ids)
        held = set(client.table.ids.tolist())
        start = set(cloud.found.cut.tolist())
        wanted = naive.finest_complete_set(decoded, start, held, own)
        assert selection.node_ids.tolist() == sorted(wanted)
        selected = decoded.gaussians.take(selection.node_ids)
        for name in FIELDS:
            assert np.array_equal(getattr(selection.scene, name), getattr(selected, name))


def test_payloads_are_sent_once_and_again_only_after_eviction() -> None:
    tree = random_tree(400, 6)
    cloud, client, _ = pair(tree, w=4, window=8)
    near, far = SearchRequest((0, 0, 0), 300, 6), SearchRequest((200, 0, 0), 300, 6)
    client.receive(cloud.search(near, 0))
    assert cloud.stats is not None
    first = cloud.stats.payloads
    assert first == len(cloud.table)
    for frame in (4, 8):
        client.receive(cloud.search(far, frame))
    client.receive(cloud.search(near, 12))
    assert (cloud.stats.payloads, cloud.stats.reactivated) == (0, cloud.stats.added)
    evicted = 0
    for frame in range(16, 40, 4):
        client.receive(cloud.search(far, frame))
        evicted += cloud.stats.evicted
    assert evicted > 0.9 * first
    client.receive(cloud.search(near, 40))
    assert cloud.stats.payloads > 0.9 * first


def borderline(tree: LodTree, codec: PaperCodec, node: int, request: SearchRequest) -> bool:
    """Whether d is so close to T that rounding up R and e, or moving m, can change the decision."""
    offset = tree.gaussians.means[node].astype(float) - request.position
    d = float(np.linalg.norm(offset))
    t = float(tree.radius[node]) + float(request.factor) * float(tree.extent[node])
    grown = max(codec.radius.max_ratio, codec.extent.max_ratio) - 1
    coordinate = float(np.abs(tree.gaussians.means[node]).max())
    moved = np.sqrt(3) * codec.position.max_error(coordinate)
    return abs(d - t) <= grown * t + moved + 1e-6 * (d + t)


@given(st.integers(0, 999))
@settings(max_examples=10, deadline=None)
def test_at_the_pose_of_the_search_only_borderline_nodes_differ(seed: int) -> None:
    tree = random_tree(300, seed)
    cloud, client, codec = pair(tree)
    for index, request in enumerate(walk(seed, 12, teleports=False)):
        client.receive(cloud.search(request, 4 * index))
        assert cloud.found is not None
        selection = client.select(request)
        differing = set(selection.node_ids.tolist()) ^ set(cloud.found.cut.tolist())
        for node in differing:
            above = int(tree.parent[node])
            flipped = [n for n in (node, above) if n >= 0 and tree.child_count[n]]
            assert any(borderline(tree, codec, n, request) for n in flipped)


def test_a_node_on_the_edge_does_differ() -> None:
    """Rounding R and e up makes the client refine where the cloud, exactly on T, does not."""
    tree = random_tree(2, 3)
    cloud, client, _ = pair(tree)
    tree.gaussians.means[0] = (0.0, 0.0, 0.0)
    k = SearchRequest((0, 0, 0), 200, 6).factor
    t = float(np.float32(tree.radius[0] + np.float32(k * tree.extent[0])))
    inside = SearchRequest((0.5 * t, 0, 0), 200, 6)
    edge = SearchRequest((t, 0, 0), 200, 6)
    client.receive(cloud.search(inside, 0))
    client.receive(cloud.search(edge, 4))
    assert cloud.found is not None
    assert cloud.found.cut.tolist() == [0]
    selection = client.select(edge)
    assert selection.node_ids.tolist() == [1, 2]
    assert (selection.refined, selection.coarsened) == (1, 0)


@given(requests(), requests())
@settings(max_examples=20, deadline=None)
def test_selection_from_anywhere_is_complete(there: SearchRequest, here: SearchRequest) -> None:
    tree = TREE
    cloud, client, _ = pair(tree, words=8)
    client.receive(cloud.search(there, 0))
    client.receive(cloud.search(here, 4))
    for request in (there, here):
        assert is_complete(tree, client.select(request).node_ids)


TREE = random_tree(120, 77)


def test_moving_back_restores_the_cut_from_what_is_held() -> None:
    """A small step changes nodes by one level: both ends of every change are held."""
    tree = random_tree(500, 12)
    cloud, client, _ = pair(tree)
    far, near = SearchRequest((40, 0, 0), 300, 6), SearchRequest((39, 0, 0), 300, 6)
    client.receive(cloud.search(far, 0))
    client.receive(cloud.search(near, 4))
    assert cloud.found is not None
    back = client.select(far)
    assert back.coarsened == 2
    assert not np.array_equal(cloud.found.cut, back.node_ids)
    assert np.array_equal(back.node_ids, flat_search(tree, far).node_ids)


def test_an_unchanged_selection_is_not_copied_again() -> None:
    cloud, client, _ = pair(random_tree(100, 1))
    request = SearchRequest((3, 3, 3), 300, 6)
    client.receive(cloud.search(request, 0))
    first = client.select(request)
    again = client.select(SearchRequest((3, 3, 3.000001), 300, 6))
    assert again.scene is first.scene


def test_damage_changes_nothing_and_order_is_restored() -> None:
    tree = random_tree(200, 2)
    cloud, client, _ = pair(tree)
    path = walk(3, 5, teleports=True)
    messages = [cloud.search(request, 4 * i) for i, request in enumerate(path)]
    early = Client()
    with pytest.raises(RemoteProtocolError, match="session start must come before"):
        early.receive(messages[0])
    with pytest.raises(LocalProtocolError, match="session start must arrive before"):
        early.report()
    with pytest.raises(LocalProtocolError, match="first search result must arrive"):
        client.select(path[0])
    assert client.receive(messages[1]).applied == 0
    assert client.receive(messages[0]).applied == 2
    assert client.receive(messages[0]).applied == 0
    assert client.table is not None
    before, state = client.table.search_index, client.table.state_hash
    damaged = bytearray(messages[2])
    damaged[-1] ^= 1
    for bad in (bytes(damaged), messages[2][:-3], b"", seal(9, b"")):
        with pytest.raises(RemoteProtocolError):
            client.receive(bad)
    assert (client.table.search_index, client.table.state_hash) == (before, state)
    client.receive(cloud.session_start())  # a second copy of it
    assert client.receive(messages[4]).applied == 0
    assert client.receive(messages[3]).applied == 0
    assert client.receive(messages[2]).applied == 3
    assert same_state(cloud, client)


def test_wrong_codebook_and_wrong_session_are_refused() -> None:
    tree = random_tree(200, 2)
    cloud, client, _ = pair(tree)
    request = SearchRequest((0, 0, 0), 300, 6)
    other = Cloud(tree, PaperCodec.train(tree, 99, words=32))
    with pytest.raises(RemoteProtocolError, match="codebook version must be"):
        client.receive(other.search(request, 0))
    with pytest.raises(RemoteProtocolError, match="session 0 must not start in two ways"):
        client.receive(other.session_start())
    stranger = Cloud(tree, cloud._encoder, session=7)
    with pytest.raises(RemoteProtocolError, match="session must be 0, not 7"):
        client.receive(stranger.search(request, 0))
    client.receive(cloud.search(request, 0))
    with pytest.raises(RemoteProtocolError, match="session must be 7, not 0"):
        stranger.receive(client.report())
    client.receive(stranger.session_start())  # the cloud was started anew
    stranger.receive(client.report())
    client.receive(stranger.search(request, 4))
    stranger.receive(client.report())
    assert stranger.stats is not None and stranger.stats.kind == "step"
    client.receive(stranger.search(request, 8))
    assert same_state(stranger, client)


def test_a_wrong_state_hash_is_refused_and_made_good() -> None:
    tree = random_tree(50, 2)
    cloud, client, _ = pair(tree)
    client.receive(cloud.search(SearchRequest((0, 0, 0), 300, 6), 0))
    cloud.receive(client.report())
    assert client.table is not None
    client.table.state_hash ^= 1  # the client's memory has failed
    for step, text in enumerate(("step", "start")):
        message = cloud.search(SearchRequest((step, 0, 0), 300, 6), 4 + 4 * step)
        assert cloud.stats is not None and cloud.stats.kind == text
        if step == 0:
            with pytest.raises(RemoteProtocolError, match="search 1: state hash must be"):
                client.receive(message)
        else:
            client.receive(message)
        cloud.receive(client.report())
    assert same_state(cloud, client)


def test_frames_must_rise() -> None:
    cloud, _, _ = pair(random_tree(10, 2))
    cloud.search(SearchRequest((0, 0, 0), 300, 6), 4)
    with pytest.raises(InputError, match="frame must rise"):
        cloud.search(SearchRequest((0, 0, 0), 300, 6), 4)


def test_one_splat() -> None:
    tree = random_tree(1, 2)
    cloud, client, _ = pair(tree)
    request = SearchRequest((0, 0, 0), 300, 6)
    client.receive(cloud.search(request, 0))
    assert client.select(request).node_ids.tolist() == [0]


def test_client_memory_follows_what_is_held() -> None:
    """After many teleports the store is bounded by the largest number held at once."""
    tree = random_tree(600, 20)
    cloud, client, _ = pair(tree, w=4, window=4)
    most = 0
    for index, request in enumerate(walk(4, 60)):
        client.receive(cloud.search(request, 4 * index))
        cloud.receive(client.report())
        most = max(most, len(cloud.table) + cloud.stats.payloads)  # type: ignore[union-attr]
    assert len(client._subgraph._store[0]) <= 1.3 * most
    assert len(client._subgraph._free) + len(client._subgraph) == len(client._subgraph._store[0])


def test_records_of_leaves_carry_no_sphere() -> None:
    tree = random_tree(20, 2)
    nodes = NodeRecords.of(tree, tree.leaf_nodes()[:0])
    assert len(nodes) == 0
    nodes = NodeRecords.of(tree, np.sort(tree.leaf_nodes()))
    assert not nodes.radius.any()
