"""The flat search against the recursive one; what a cut is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings

from gaussians import parallel
from lod_cloud.criterion import SearchRequest
from lod_cloud.cut import Cut, crossings, is_complete, overlap, without
from lod_cloud.lod_tree import LodTree
from lod_cloud.search import flat_search
from tests.lod_cloud.trees import random_tree, requests, trees
from tests.naive import search as naive

pytestmark = pytest.mark.nojit


@given(trees(), requests())
@settings(max_examples=60, deadline=None)
def test_flat_equals_naive(tree: LodTree, request: SearchRequest) -> None:
    cut = flat_search(tree, request)
    assert cut.node_ids.dtype == np.int32
    assert cut.node_ids.tolist() == sorted(naive.cut(tree, request))
    assert is_complete(tree, cut.node_ids)


@given(trees(20), requests())
@settings(max_examples=20, deadline=None)
def test_crossings_counts_paths(tree: LodTree, request: SearchRequest) -> None:
    nodes = set(flat_search(tree, request).node_ids[1:].tolist()) | {0}
    counts = crossings(tree, np.array(sorted(nodes), np.int32))
    for leaf, node in enumerate(tree.leaf_nodes()):
        assert counts[leaf] == naive.times_met(tree, nodes, int(node))


def test_a_camera_on_the_threshold_draws_the_parent() -> None:
    """d2 = T2 exactly does not refine: the comparison is strict."""
    tree = random_tree(2, 4)
    root = tree.gaussians.means[0]
    k = np.float32(200.0 / 13)
    t = np.float32(tree.radius[0] + np.float32(k * tree.extent[0]))
    tree.gaussians.means[0] = (0.0, 0.0, 0.0)
    assert len(root) == 3
    at = flat_search(tree, SearchRequest((float(t), 0, 0), 200.0, 6.0))
    inside = flat_search(
        tree, SearchRequest((float(np.nextafter(t, np.float32(0))), 0, 0), 200.0, 6.0)
    )
    assert at.node_ids.tolist() == [0]
    assert inside.node_ids.tolist() == [1, 2]


def test_extremes_of_tau() -> None:
    tree = random_tree(500, 8)
    inside = (0.0, 0.0, 0.0)
    assert len(flat_search(tree, SearchRequest(inside, 1e5, 0.0))) == tree.leaves
    assert flat_search(tree, SearchRequest((1e9, 0, 0), 929.2, 1e12)).node_ids.tolist() == [0]


@pytest.mark.parametrize("leaves", [200, 333])
def test_threads_change_neither_cut_nor_counters(leaves: int) -> None:
    tree = random_tree(leaves, 1)
    request = SearchRequest((1.0, 0.0, 0.0), 900.0, 6.0)
    before = parallel.threads()
    try:
        cuts = []
        for threads in (1, 2, 3, 5):
            parallel.set_threads(threads)
            cuts.append(flat_search(tree, request))
    finally:
        parallel.set_threads(before)
    for cut in cuts:
        assert np.array_equal(cut.node_ids, cuts[0].node_ids)
        assert cut.nodes_tested == len(tree)
        assert cut.bytes_touched == cuts[0].bytes_touched >= 20 * len(tree)


def cut_of(*ids: int) -> Cut:
    return Cut(np.array(ids, np.int32), 0, 0)


def test_overlap_and_difference() -> None:
    assert overlap(cut_of(1, 2, 3), cut_of(2, 3, 4, 5)) == pytest.approx(0.5)
    assert overlap(cut_of(1, 2), cut_of(1, 2)) == 1.0
    assert without(np.array([9, 2, 5]), np.array([5, 7])).tolist() == [9, 2]


def test_incomplete_sets_are_recognised() -> None:
    tree = random_tree(8, 1)
    assert is_complete(tree, np.array([0], np.int32))
    assert not is_complete(tree, np.array([1], np.int32))
    assert not is_complete(tree, np.array([0, 1], np.int32))
    assert not is_complete(tree, np.array([0, 0], np.int32))
