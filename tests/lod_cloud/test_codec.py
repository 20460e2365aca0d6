"""The paper's codec on whole nodes: stated errors, escapes, refusals."""

from __future__ import annotations

import contextlib
import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.codebook import AC_ERROR
from gaussians.compression import ROTATION_ERROR_RAD
from gaussians.errors import InputError
from gaussians.scene import FIELDS, Scene
from lod_cloud.build import build_tree
from lod_cloud.codec import Codec, PaperCodec, read_codec
from lod_cloud.lod_tree import LodTree
from lod_cloud.node_records import NodeRecords
from lod_cloud.protocol import RemoteProtocolError
from lod_cloud.tree_encoder import TreeEncoder
from tests.lod_cloud.trees import random_scene, random_tree


def sent(tree: LodTree, codec: Codec, ids: np.ndarray) -> tuple[NodeRecords, int]:
    """What arrives of these nodes, and how many were escapes."""
    coded = TreeEncoder(tree, codec).encode(ids.astype(np.int32))
    assert coded.sent == len(ids)
    assert sum(coded.columns.values()) == len(coded.payload)
    return codec.decode(coded.payload), coded.escapes


def check_errors(codec: PaperCodec, original: NodeRecords, decoded: NodeRecords) -> None:
    """Structure exact, every field within its stated error."""
    for name in ("ids", "parents", "child_counts"):
        assert np.array_equal(getattr(decoded, name), getattr(original, name))
    old, new = original.gaussians, decoded.gaussians
    limit = codec.position.max_error(float(np.abs(old.means).max()))
    assert np.abs(new.means.astype(float) - old.means).max() <= limit
    positive = old.scales > 0
    assert np.array_equal(positive, new.scales > 0)
    ratios = new.scales[positive].astype(float) / old.scales[positive]
    assert np.abs(np.log(ratios)).max(initial=0) <= np.log(codec.scale.max_ratio)
    cosine = np.abs((new.quaternions.astype(float) * old.quaternions).sum(axis=1))
    norms = np.linalg.norm(old.quaternions.astype(float), axis=1)
    norms *= np.linalg.norm(new.quaternions.astype(float), axis=1)
    sine = np.sqrt(np.maximum(1 - (cosine / norms) ** 2, 0))
    assert 2 * np.arcsin(sine).max() <= ROTATION_ERROR_RAD
    limits = [codec.opacity.max_error(float(o)) for o in old.opacities]
    assert (np.abs(new.opacities.astype(float) - old.opacities) <= limits).all()
    assert np.abs(new.sh[:, 0].astype(float) - old.sh[:, 0]).max() <= codec.dc.max_error
    assert np.abs(new.sh[:, 1:] - old.sh[:, 1:]).max(initial=0) <= AC_ERROR
    for name, field in (("radius", codec.radius), ("extent", codec.extent)):
        before, after = getattr(original, name), getattr(decoded, name)
        assert (after >= before).all()
        assert (after <= before * field.max_ratio).all()


@given(st.integers(1, 200), st.integers(0, 999), st.sampled_from([0, 1, 2, 3]))
@settings(max_examples=25, deadline=None)
def test_round_trip(count: int, seed: int, sh_degree: int) -> None:
    tree = random_tree(count, seed, sh_degree=sh_degree)
    codec = PaperCodec.train(tree, seed, words=32)
    rng = np.random.default_rng(seed)
    ids = np.flatnonzero(rng.random(len(tree)) < 0.6)
    decoded, _ = sent(tree, codec, ids)
    if len(ids):
        check_errors(codec, NodeRecords.of(tree, ids.astype(np.int32)), decoded)
    assert len(decoded) == len(ids)


def wild_scene() -> Scene:
    """A few splats outside every range: far away, very opaque, glaring, odd harmonics."""
    scene = random_scene(400, 3)
    scene.means[7] = (2e6, -3.0, 1.0)
    scene.opacities[11] = 5000.0
    scene.sh[13, 0, 1] = 1e5
    scene.sh[17, 2, 2] = 50.0
    return scene


def test_values_outside_the_ranges_arrive_exactly() -> None:
    tree = build_tree(wild_scene())
    codec = PaperCodec.train(tree, 1, words=64)
    ids = tree.leaf_nodes()[[7, 11, 13, 17]]
    ids = np.sort(np.concatenate([ids, tree.leaf_nodes()[100:140]]))
    decoded, escapes = sent(tree, codec, ids)
    original = NodeRecords.of(tree, ids)
    assert 4 <= escapes < 10
    exact = np.isin(ids, tree.leaf_nodes()[[7, 11, 13, 17]])
    for name in FIELDS:
        assert np.array_equal(
            getattr(decoded.gaussians, name)[exact], getattr(original.gaussians, name)[exact]
        )
    # and they cost the others nothing
    others = np.flatnonzero(~exact)
    errors = decoded.gaussians.sh[others, 0] - original.gaussians.sh[others, 0]
    assert np.abs(errors).max() < 1e-3 * 16


def test_interior_escapes_keep_their_node_sphere() -> None:
    tree = build_tree(wild_scene())
    codec = PaperCodec.train(tree, 1, words=64)
    narrow = dataclasses.replace(codec, opacity=type(codec.opacity)(1e-6))
    everything = np.arange(len(tree))
    decoded, escapes = sent(tree, narrow, everything)
    original = NodeRecords.of(tree, everything.astype(np.int32))
    assert escapes > 0.8 * len(tree)
    escaped = original.gaussians.opacities > 1e-6
    assert np.array_equal(decoded.radius[escaped], original.radius[escaped])
    assert np.array_equal(decoded.gaussians.sh[escaped], original.gaussians.sh[escaped])


def test_degree_0_has_no_codebook() -> None:
    codec = PaperCodec.train(random_tree(50, 1, sh_degree=0), 1)
    assert codec.codebook is None
    assert codec.codebook_bytes == 0


def test_flat_fields_and_points() -> None:
    """All colours, sizes and positions equal: every range is empty."""
    scene = random_scene(20, 1, sh_degree=0)
    scene.sh[:] = 0.3
    scene.scales[:] = 0.0
    scene.means[:] = (1.0, 2.0, 3.0)
    scene.opacities[:] = 0.0
    tree = build_tree(scene)
    codec = PaperCodec.train(tree, 1)
    decoded, escapes = sent(tree, codec, np.arange(len(tree)))
    assert escapes == 0
    check_errors(codec, NodeRecords.of(tree, np.arange(len(tree), dtype=np.int32)), decoded)


@pytest.mark.parametrize(("size_m", "sigma", "wanted"), [(10, 0.03, 16.0), (0.1, 3e-4, 0.25)])
def test_tiles_suit_the_scene(size_m: float, sigma: float, wanted: float) -> None:
    scene = random_scene(300, 2, size_m=size_m)
    scene.scales[:] = sigma
    tile = PaperCodec.train(build_tree(scene), 1, words=8).position.tile_m
    assert tile == wanted
    assert tile / 65536 <= sigma / 64


def test_parameters_round_trip_and_versions_differ() -> None:
    tree = random_tree(300, 4)
    codec = PaperCodec.train(tree, 1, words=16, stages=2)
    same = read_codec(codec.to_bytes())
    assert same.version == codec.version == PaperCodec.train(tree, 1, words=16, stages=2).version
    assert PaperCodec.train(tree, 2, words=16, stages=2).version != codec.version
    ids = np.arange(len(tree))
    assert np.array_equal(
        sent(tree, same, ids)[0].gaussians.sh, sent(tree, codec, ids)[0].gaussians.sh
    )
    with pytest.raises(RemoteProtocolError):
        read_codec(codec.to_bytes()[:-1])
    with pytest.raises(RemoteProtocolError):
        read_codec(codec.to_bytes().replace(b'"paper"', b'"piper"'))


def test_damaged_payloads_are_refused() -> None:
    tree = random_tree(60, 5)
    codec = PaperCodec.train(tree, 1, words=8)
    payload = TreeEncoder(tree, codec).encode(np.arange(len(tree), dtype=np.int32)).payload
    with pytest.raises(RemoteProtocolError):
        codec.decode(payload[:-1])
    with pytest.raises(RemoteProtocolError):
        codec.decode(payload + b"\0")
    for position in range(0, len(payload), 7):
        damaged = bytearray(payload)
        damaged[position] ^= 0xFF
        with contextlib.suppress(RemoteProtocolError):
            codec.decode(bytes(damaged))


def test_a_codec_of_another_degree_is_refused() -> None:
    codec = PaperCodec.train(random_tree(9, 1, sh_degree=0), 1)
    with pytest.raises(InputError, match="SH degree 1, not 0"):
        TreeEncoder(random_tree(9, 1), codec)
