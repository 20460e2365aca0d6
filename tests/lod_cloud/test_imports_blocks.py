"""Separately trained levels as one tree: which cuts are shipped levels, who hangs below whom."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.errors import InputError
from gaussians.formats import load_lod_set
from gaussians.formats.lod_meta import LodSet
from gaussians.scene import FIELDS, Scene
from lod_cloud import (
    Client,
    Cloud,
    LodTree,
    PaperCodec,
    SearchRequest,
    build_tree,
    flat_search,
    is_complete,
    load_tree,
    prove_nesting,
    save_tree,
)
from lod_cloud.imports import build_block_tree
from lod_cloud.imports.block_tree import nearest_parents
from lod_cloud.search import SEARCHES, SearchTree, make_search
from tests.gaussians.real_data import data_file
from tests.lod_cloud.trees import random_scene


def lod_set(counts: list[list[int]], seed: int = 0) -> LodSet:
    """``counts[level][box]`` Gaussians, boxes of 10 m side by side; coarser ones are larger."""
    rng = np.random.default_rng(seed)
    levels, ranges = {}, {}
    for level, of_boxes in enumerate(counts):
        scene = random_scene(sum(of_boxes), seed + level)
        scene.scales[:] = 0.02 * 2.0**level * np.exp(rng.normal(0, 0.2, scene.scales.shape))
        box = np.repeat(np.arange(len(of_boxes)), of_boxes)
        scene.means[:] = rng.uniform(0, 10, scene.means.shape)
        scene.means[:, 0] += 10 * box
        levels[level] = scene
        ranges[level] = np.stack([np.cumsum(of_boxes) - of_boxes, of_boxes], axis=1)
    boxes = np.array([[[10 * b, 0, 0], [10 * b + 10, 10, 10]] for b in range(len(counts[0]))])
    return LodSet(len(counts), levels, boxes.astype(float), ranges, [])


def levels_of(tree: LodTree, count: int) -> list[np.ndarray]:
    """Nodes of each level, finest first, in a set in which no box lacks a level."""
    nodes = tree.leaf_nodes()
    found = []
    for _ in range(count):
        found.append(np.unique(nodes))
        nodes = tree.parent[found[-1]]
    return found


def rows(scene: Scene) -> list[bytes]:
    """Every Gaussian's bits, sorted."""
    table = np.hstack([getattr(scene, f).reshape(len(scene), -1) for f in FIELDS])
    return sorted(row.tobytes() for row in table)


FULL = [[400, 300], [120, 130], [120, 40], [9, 11]]


def test_every_level_is_in_the_tree_bit_for_bit() -> None:
    given_set = lod_set(FULL)
    tree = build_block_tree(given_set).validate()
    assert prove_nesting(tree) == 0
    assert tree.metadata.build["interior"] == "given" and "merge" not in tree.metadata.build
    assert tree.metadata.build["left_out"] == []
    nodes = levels_of(tree, 4)
    for level, ids in enumerate(nodes):
        assert rows(tree.gaussians.take(ids)) == rows(given_set.levels[level])
    leaves = tree.gaussians.take(tree.leaf_nodes())
    assert leaves.means.tobytes() == given_set.levels[0].means.tobytes()
    assert len(tree) == sum(map(sum, FULL)) + 19  # merged nodes above 9 + 11 coarsest


def test_some_cut_is_exactly_each_level() -> None:
    given_set = lod_set(FULL)
    tree = build_block_tree(given_set)
    # merged nodes above the coarsest level may be as small as that: not all need refine before it
    wanted = {ids.tobytes() for ids in levels_of(tree, 4)[:-1]}
    for factor in np.exp(np.linspace(0, 12, 400)):
        request = SearchRequest((5000.0, 5.0, 5.0), float(factor), 0.0)
        wanted.discard(flat_search(tree, request).node_ids.tobytes())
    assert not wanted


def test_a_group_shares_its_sphere_and_stays_in_its_box() -> None:
    given_set = lod_set(FULL)
    tree = build_block_tree(given_set)
    for ids in levels_of(tree, 4)[1:]:
        right = tree.gaussians.means[ids, 0] >= 10
        for side in (ids[right], ids[~right]):
            assert len(set(tree.radius[side])) == len(set(tree.extent[side])) == 1
    children = np.concatenate(levels_of(tree, 3))
    box = tree.gaussians.means[:, 0] >= 10
    assert (box[children] == box[tree.parent[children]]).all()


@given(st.integers(1, 12), st.integers(0, 30), st.integers(0, 9999))
@settings(max_examples=60, deadline=None)
def test_everybody_gets_a_child_and_most_their_nearest(coarse: int, more: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    below = rng.normal(size=(coarse + more, 3)).astype(np.float32)
    above = rng.normal(size=(coarse, 3)).astype(np.float32)
    above[rng.random(coarse) < 0.3] = above[0]  # equal means
    parents = nearest_parents(below, above)
    assert (np.bincount(parents, minlength=coarse) > 0).all()
    gaps = np.linalg.norm(below[:, None].astype(float) - above[None], axis=2)
    moved = gaps[np.arange(len(below)), parents] > gaps.min(axis=1) + 1e-9
    assert moved.sum() <= coarse - 1
    # whoever was taken from its nearest is an only child
    assert (np.bincount(parents, minlength=coarse)[parents[moved]] == 1).all()


def test_levels_without_use_are_left_out_and_named() -> None:
    counts = [[40, 30, 0, 7], [50, 10, 3, 0], [8, 0, 2, 7]]
    given_set = lod_set(counts)
    tree = build_block_tree(given_set).validate()
    assert prove_nesting(tree) == 0 and tree.leaves == 77
    left_out = {(0, 1), (1, 2), (2, 0), (2, 1), (2, 2), (3, 1)}
    assert {tuple(pair) for pair in tree.metadata.build["left_out"]} == left_out
    assert len(tree) == 77 + 10 + 8 + 7 + (8 + 10 + 7) - 1


def test_more_parents_than_children_are_refused() -> None:
    means = np.zeros((3, 3), np.float32)
    with pytest.raises(InputError, match="3 parents need as many children, not 2"):
        nearest_parents(means[:2], means)


def test_one_level_is_no_pyramid() -> None:
    with pytest.raises(InputError, match="a block tree needs at least two levels, not 1"):
        build_block_tree(lod_set([[5, 5]]))


def test_all_searches_agree_and_it_survives_the_disk(tmp_path: Path) -> None:
    save_tree(build_block_tree(lod_set(FULL), units_per_metre=2.0), tmp_path / "tree")
    stored = load_tree(tmp_path / "tree")
    tree = SearchTree.of(stored)
    searches = [make_search(name, tree) for name in SEARCHES]
    sizes = set()
    for step in range(40):
        request = SearchRequest((20.0 - step, 2.0, 2.5), 200.0, 3.0)
        cuts = [search.search(request).cut for search in searches]
        assert all(np.array_equal(cut, cuts[0]) for cut in cuts)
        sizes.add(len(cuts[0]))
    assert len(sizes) > 10


def test_a_client_follows_the_cloud() -> None:
    tree = build_block_tree(lod_set(FULL))
    cloud, client = Cloud(tree, PaperCodec.train(tree, 0, words=16)), Client()
    client.receive(cloud.session_start())
    for step in range(20):
        request = SearchRequest((40.0 - 3 * min(step, 11), 2.0, 2.5), 200.0, 3.0)
        client.receive(cloud.search(request, 4 * step))
        cloud.receive(client.report())
        assert client.table is not None
        assert client.table.state_hash == cloud.table.state_hash
        assert is_complete(tree, client.table.cut_ids)


@pytest.mark.slow
@pytest.mark.real_data
def test_playbot_has_its_seven_levels() -> None:
    given_set = load_lod_set(data_file("scenes/playbot_lod") / "lod-meta.json")
    tree = build_block_tree(given_set).validate()
    assert prove_nesting(tree) == 0 and tree.metadata.build["left_out"] == []
    for level, ids in enumerate(levels_of(tree, 7)):
        assert rows(tree.gaussians.take(ids)) == rows(given_set.levels[level])
    merged = build_tree(given_set.levels[0])
    assert len(tree) < len(merged)
