"""The compact codec: stated errors, escapes, positions that no history changes, merged nodes."""

from __future__ import annotations

import contextlib
import dataclasses
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians import parallel
from gaussians.codebook import AC_ERROR
from gaussians.compression import ROTATION_ERROR_RAD
from gaussians.errors import InputError
from gaussians.scene import FIELDS
from lod_cloud.build import BuildOptions, build_tree
from lod_cloud.codec import (
    CompactCodec,
    Encoded,
    Neighbours,
    References,
    compact,
    read_codec,
    training,
)
from lod_cloud.codec.axes import sorted_axes
from lod_cloud.codec.rans import Frequencies
from lod_cloud.codec.tolerance import CODED_MASS_ERROR
from lod_cloud.lod_tree import LodTree
from lod_cloud.node_records import NodeRecords
from lod_cloud.protocol import RemoteProtocolError
from lod_cloud.tree_encoder import TreeEncoder
from tests.lod_cloud.hostile_link import HostilePair, world_of
from tests.lod_cloud.trees import random_scene, random_tree

SEEDS = st.integers(0, 999)


def coded(tree: LodTree, codec: CompactCodec, ids: np.ndarray) -> tuple[NodeRecords, Encoded]:
    """What arrives of these nodes when nothing is known."""
    encoded = TreeEncoder(tree, codec).encode(ids.astype(np.int32))
    assert sum(encoded.columns.values()) == len(encoded.payload)
    return codec.decode(encoded.payload), encoded


def masses(nodes: NodeRecords) -> np.ndarray:
    a, b, c = nodes.gaussians.scales.astype(float).T
    return np.asarray(nodes.gaussians.opacities * (a * b + a * c + b * c))


@given(st.integers(1, 200), SEEDS, st.sampled_from([0, 1, 3]))
@settings(max_examples=25)
def test_round_trip(count: int, seed: int, sh_degree: int) -> None:
    tree = random_tree(count, seed, sh_degree=sh_degree)
    codec = CompactCodec.train(tree, seed, words=16)
    ids = np.flatnonzero(np.random.default_rng(seed).random(len(tree)) < 0.6).astype(np.int32)
    decoded, encoded = coded(tree, codec, ids)
    original = NodeRecords.of(tree, ids)
    for name in ("ids", "parents", "child_counts"):
        assert np.array_equal(getattr(decoded, name), getattr(original, name))
    old, new = original.gaussians, decoded.gaussians
    off = np.abs(new.means.astype(float) - old.means)
    assert (
        off <= codec.fields.position.max_error * old.scales.max(axis=1, keepdims=True, initial=0)
    ).all()
    assert np.abs(masses(decoded) - masses(original)).max(initial=0) <= (
        CODED_MASS_ERROR * masses(original).max(initial=0)
    )
    assert (np.abs(masses(decoded) - masses(original)) <= 0.0901 * masses(original)).all()
    assert np.abs(new.sh[:, 1:] - old.sh[:, 1:]).max(initial=0) <= AC_ERROR
    exact = (new.quaternions == old.quaternions).all(axis=1)  # with the axes in their own order
    cosines = np.abs((sorted_axes(old.scales, old.quaternions)[1] * new.quaternions).sum(axis=1))
    turned = 2 * np.arccos(np.minimum(cosines[~exact], 1))
    assert (turned <= ROTATION_ERROR_RAD * 65535 / 63).all()
    off = np.abs(new.sh[:, 0].astype(float) - old.sh[:, 0])
    assert off.max(initial=0) <= codec.fields.dc.max_error
    assert (decoded.radius >= original.radius).all()
    assert (decoded.extent >= original.extent).all()
    assert encoded.sent == len(ids)


def covariances(scales: np.ndarray, quaternions: np.ndarray) -> np.ndarray:
    w, x, y, z = quaternions.astype(float).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    axes = np.moveaxis(np.array(rows), 2, 0) * scales[:, None, :]
    return np.asarray(axes @ np.swapaxes(axes, 1, 2))


def test_axes_in_another_order_are_the_same_gaussian() -> None:
    scene = random_scene(300, 4)
    scales, quaternions = sorted_axes(scene.scales, scene.quaternions)
    assert (np.diff(scales, axis=1) <= 0).all()
    before = covariances(scene.scales.astype(float), scene.quaternions)
    assert np.abs(covariances(scales, quaternions) - before).max() <= 1e-6 * scales.max() ** 2


@given(SEEDS, st.sampled_from([5, 8]))
@settings(max_examples=30)
def test_any_reference_within_the_tolerance_gives_the_same_bits(seed: int, bits: int) -> None:
    tree = random_tree(80, seed)
    codec = CompactCodec.train(tree, 1, words=8, position_bits=bits)
    encoder = TreeEncoder(tree, codec)
    rng = np.random.default_rng(seed)
    ids = np.arange(len(tree), dtype=np.int32)
    right = coded(tree, codec, ids)[0].gaussians
    near = rng.integers(0, len(tree), len(tree))  # any node will do
    scene = tree.gaussians
    references = References(
        near.astype(np.int32), scene.means[near], scene.scales[near].max(axis=1)
    )
    nodes = NodeRecords.of(tree, ids)
    words, good = codec.assign_words(tree, ids)
    sent = codec.encode(nodes, words, good, places=False, references=references)
    share = rng.choice([-1.0, -0.999, 0.0, 0.999, 1.0], (len(tree), 3))
    moved = references.means + share * codec.tolerance * references.sigmas[:, None]
    towards = np.where(share < 0, np.inf, -np.inf)
    clients = np.nextafter(moved.astype(np.float32), towards.astype(np.float32))
    got = codec.decode(
        sent.payload, (ids, tree.parent), Neighbours(references.ids, clients)
    ).gaussians
    for name in FIELDS:
        assert np.array_equal(getattr(got, name), getattr(right, name))
    assert encoder.codec is codec


def test_positions_are_told_from_the_node_before_where_nothing_is_held() -> None:
    """32 bits per axis, and few for a sibling."""
    tree = random_tree(3000, 2)
    codec = CompactCodec.train(tree, 1, words=8)
    leaves = np.sort(tree.leaf_nodes())
    alone = coded(tree, codec, leaves[:1])[1].columns["position"]
    together = coded(tree, codec, leaves)[1].columns["position"]
    assert 12 <= alone <= 16
    assert together < 8 * len(leaves)


@given(
    st.integers(2, 150),
    st.integers(0, 30),
    st.sampled_from([1.0, 0.5]),
    st.sampled_from([0, 4, 32]),
    st.sampled_from([None, 300]),
    st.lists(st.sampled_from(["walk", "walk", "walk", "teleport", "lose", "back"]), max_size=40),
)
@settings(max_examples=40)
def test_no_history_changes_what_is_decoded(
    count: int, seed: int, ratio: float, window: int, budget: int | None, path: list[str]
) -> None:
    """Collapses, expansions, repairs and jumps: what is sent is decoded as if nothing had been held
    (asserted at every message), and what is merged stays within the tolerance.
    """
    scene = random_scene(count, seed)
    scene.scales[:] = np.maximum(scene.scales, 1e-3)
    scene.opacities[:] = np.maximum(scene.opacities, 0.05)
    tree = build_tree(scene, options=BuildOptions(fan_out_ratio=ratio))
    pair = HostilePair(
        world_of(tree, CompactCodec.train(tree, 1, words=8), seed), window=window, budget=budget
    )
    for number, step in enumerate(path):
        place = 7 * number if step == "teleport" else (number if step != "back" else number // 3)
        pair.act(("teleport", place))
        pair.act(("lose_down" if step == "lose" else "down", 0))
        for _ in range(2):
            pair.act(("down", 0))
            pair.act(("up", 0))
    pair.heal(lose_what_is_underway=False)


def test_collapsed_nodes_are_merged_not_sent() -> None:
    scene = random_scene(150, 3)
    scene.scales[:] = np.maximum(scene.scales, 1e-3)
    scene.opacities[:] = np.maximum(scene.opacities, 0.05)
    tree = build_tree(scene)
    pair = HostilePair(world_of(tree, CompactCodec.train(tree, 1, words=8), 3), window=0)
    merged = payloads = 0
    for place in [*range(48), *range(47, -1, -1)]:
        for action in (("teleport", place), ("down", 0), ("down", 0), ("up", 0)):
            pair.act(action)
        stats = pair.cloud.stats
        assert stats is not None
        merged, payloads = merged + stats.merged, payloads + stats.payloads
    assert merged > 0.15 * payloads
    assert pair.merged > 0


def test_interior_nodes_that_are_no_merges_are_sent() -> None:
    """A tree that does not say that it merged, and one that says so but does not."""
    tree = random_tree(60, 2)
    foreign = dataclasses.replace(tree.metadata, build={"merge": "trained"})
    codec = CompactCodec.train(dataclasses.replace(tree, metadata=foreign), 1, words=8)
    assert not codec.merges
    tree.gaussians.means[tree.child_count > 0] += 0.5
    lying = CompactCodec.train(tree, 1, words=8)
    assert lying.merges
    for one in (codec, lying):
        pair = HostilePair(world_of(tree, one, 2), window=0)
        for place in range(48):
            for action in (("teleport", place), ("down", 0), ("down", 0), ("up", 0)):
                pair.act(action)
            assert pair.cloud.stats is not None
            assert pair.cloud.stats.merged == 0
        assert pair.merged == 0


def test_the_tolerance_is_what_the_text_says() -> None:
    codec = CompactCodec.train(random_tree(100, 1), 1, words=8)
    assert codec.fields.position.max_error == 1 / 64
    assert 0.2 < codec.tolerance < 0.33
    assert dataclasses.replace(codec, merge_levels=31).tolerance < 0.33


def test_parameters_round_trip() -> None:
    codec = CompactCodec.train(random_tree(200, 4), 1, words=16, stages=3, colour_bits=10)
    same = read_codec(codec.to_bytes())
    assert isinstance(same, CompactCodec)
    assert same.version == codec.version
    assert same.to_bytes() == codec.to_bytes()
    with pytest.raises(RemoteProtocolError, match="codec must be one of compact, paper"):
        read_codec(codec.to_bytes().replace(b'"compact"', b'"compost"'))
    with pytest.raises(RemoteProtocolError):
        read_codec(codec.to_bytes()[:-1])
    with pytest.raises(RemoteProtocolError, match="must be complete"):
        read_codec(codec.to_bytes().replace(b'"dc"', b'"cd"'))


def equal_frequencies(codec: CompactCodec) -> CompactCodec:
    none = np.empty(0, np.int64)
    shapes = codec.layout.shapes().items()
    tables = {key: Frequencies.counted(none, none, shape) for key, shape in shapes}
    return dataclasses.replace(codec, tables=tables)


@given(st.integers(1, 200), SEEDS, st.sampled_from([0, 1, 3]))
@settings(max_examples=15)
def test_frequencies_change_the_bytes_and_nothing_else(
    count: int, seed: int, sh_degree: int
) -> None:
    tree = random_tree(count, seed, sh_degree=sh_degree)
    codec = CompactCodec.train(tree, seed, words=5)
    ids = np.arange(len(tree))
    right, got = (coded(tree, one, ids)[0] for one in (codec, equal_frequencies(codec)))
    for name in FIELDS:
        assert np.array_equal(getattr(got.gaussians, name), getattr(right.gaussians, name))
    assert np.array_equal(got.radius, right.radius)
    assert np.array_equal(got.extent, right.extent)


def test_frequencies_of_the_tree_save_bytes() -> None:
    tree = random_tree(2000, 7)
    codec = CompactCodec.train(tree, 1, words=64, stages=2)
    ids = np.arange(len(tree))
    learnt, plain = (coded(tree, one, ids)[1].columns for one in (codec, equal_frequencies(codec)))
    for name in ("scale", "rotation", "colour", "spheres"):
        assert learnt[name] < 0.97 * plain[name]
    assert learnt["harmonics"] < plain["harmonics"]


def test_the_coarsest_nodes_are_no_escapes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a tree of which training sees a part."""
    tree = random_tree(4000, 5)
    monkeypatch.setattr(training, "WHOLE_NODES", 1000)
    monkeypatch.setattr(training, "RANGE_NODES", 512)
    ids = np.arange(60)
    codec = CompactCodec.train(tree, 1, words=8)
    assert coded(tree, codec, ids)[1].escapes <= 3
    monkeypatch.setattr(compact, "_COARSEST_NODES", 0)
    assert coded(tree, CompactCodec.train(tree, 1, words=8), ids)[1].escapes >= 20


def test_books_of_more_words_than_symbols() -> None:
    """The lowest bits travel as they are."""
    tree = random_tree(12_000, 3, sh_degree=1)
    codec = CompactCodec.train(tree, 1, words=2500, stages=1)
    assert codec.codebook is not None
    words = len(codec.codebook.stages[0])
    assert words > 2048
    assert codec.layout.words == ((-(-words // 4), 2),)
    ids = np.arange(0, len(tree), 3, dtype=np.int32)
    found, near = codec.assign_words(tree, ids)
    decoded, _ = coded(tree, codec, ids)
    right = codec.codebook.decode(found).reshape(len(ids), 3, 3)
    assert near.any()
    assert np.array_equal(decoded.gaussians.sh[near, 1:], right[near])


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_harmonics_of_leaves_are_good_to_half_a_step(degree: int) -> None:
    """Others are what their words say; what is off by too much is exact, and an escape."""
    tree = random_tree(300, 3, sh_degree=degree)
    codec = CompactCodec.train(tree, 1, words=8)
    assert codec.rests is not None and codec.codebook is not None
    leaf = tree.child_count == 0
    tree.gaussians.sh[np.flatnonzero(leaf)[:3], 1, 0] += 70 * np.float32(codec.rests.step)
    tree.gaussians.sh[np.flatnonzero(~leaf)[:2], 1, 0] = 2.0
    words, near = codec.assign_words(tree, np.arange(len(tree), dtype=np.int32))
    decoded, _ = coded(tree, codec, np.arange(len(tree)))
    off = np.abs(decoded.gaussians.sh[:, 1:] - tree.gaussians.sh[:, 1:]).max(axis=(1, 2))
    assert 0.4 < off[leaf].max() / codec.rests.step < 0.5001
    assert np.count_nonzero(off[leaf]) == np.count_nonzero(leaf) - 3
    assert not near[leaf].any() and np.count_nonzero(~near[~leaf]) >= 2
    assert not off[~near & ~leaf].any()
    right = codec.codebook.decode(words).reshape(len(tree), -1, 3)
    assert np.array_equal(decoded.gaussians.sh[near, 1:], right[near])
    alone = TreeEncoder(tree, codec).encode_harmonics(np.arange(len(tree), dtype=np.int32))
    assert alone.escapes == np.count_nonzero(~near & ~leaf) + 3


def test_frequencies_of_a_session_start_are_checked() -> None:
    codec = CompactCodec.train(random_tree(60, 4), 1, words=8)
    data = codec.to_bytes()
    axis = str(codec.tables["rotation.axis"].table.tolist()).encode()
    for wrong, text in (
        (b"[[4096, 0, 0, 0], [1024, 1024, 1024, 1024]]", "at least 1"),
        (b"[[4093, 1, 1, 1]]", "frequencies of rotation.axis must be 2 x 4"),
        (b"7", "1 to 1024 symbols"),
        (b"[[1, 2], [3]]", "must be complete"),
    ):
        assert data.count(axis) == 1
        with pytest.raises(RemoteProtocolError, match=text):
            read_codec(_replaced(data, axis, wrong))
    with pytest.raises(RemoteProtocolError, match="must be complete"):
        read_codec(data.replace(b'"spheres.extent"', b'"spheres.extant"'))
    with pytest.raises(RemoteProtocolError, match="step of harmonics must lie in"):
        read_codec(_replaced(data, b'"harmonic_step": ', b'"harmonic_step": -'))
    with pytest.raises(InputError, match="colour bits must be 1 to 10"):
        CompactCodec.train(random_tree(60, 4), 1, words=8, colour_bits=11)


def _replaced(data: bytes, text: bytes, other: bytes) -> bytes:
    """Other parameters of a packed codec."""
    size = int.from_bytes(data[:4], "little") + len(other) - len(text)
    return size.to_bytes(4, "little") + data[4:].replace(text, other)


@pytest.mark.parametrize("colour_bits", [8, 10])
def test_damaged_payloads_are_refused(colour_bits: int) -> None:
    tree = random_tree(30, 5)
    codec = CompactCodec.train(tree, 1, words=8, colour_bits=colour_bits)
    payload = coded(tree, codec, np.arange(len(tree)))[1].payload
    with pytest.raises(RemoteProtocolError):
        codec.decode(payload[:-1])
    with pytest.raises(RemoteProtocolError):
        codec.decode(payload + b"\0")
    for position in range(0, len(payload), 3):
        damaged = bytearray(payload)
        damaged[position] ^= 0xFF
        with contextlib.suppress(RemoteProtocolError):
            codec.decode(bytes(damaged))


VERSION_OF_A_TREE = """
from lod_cloud import CompactCodec, PaperCodec
from gaussians import parallel
from tests.lod_cloud.trees import random_tree
parallel.set_threads({threads})
tree = random_tree(600, 6, sh_degree=2)
print(CompactCodec.train(tree, 5).version, PaperCodec.train(tree, 5, words=64).version)
"""


def test_training_gives_the_same_bits_in_every_process_and_on_any_number_of_threads() -> None:
    found = {
        subprocess.run(
            [sys.executable, "-c", VERSION_OF_A_TREE.format(threads=threads)],
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for threads in (1, 2)
    }
    assert len(found) == 1
    before = parallel.threads()
    try:
        parallel.set_threads(3)
        tree = random_tree(600, 6, sh_degree=2)
        own = CompactCodec.train(tree, 5).version
    finally:
        parallel.set_threads(before)
    assert found.pop().split()[0] == str(own)
