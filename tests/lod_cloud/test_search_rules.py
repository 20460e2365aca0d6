"""The baseline rules against their definitions, node by node."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gaussians import parallel
from gaussians.errors import InputError
from lod_cloud.criterion import SearchRequest
from lod_cloud.search import CityGaussianSearch, OctreeGsSearch, SearchTree, make_search
from lod_cloud.search.city_gaussian import BLOCK_M, EXTENTS_M
from tests.lod_cloud.trees import random_tree

CAMERAS = [(0.0, 0.0, 0.0), (300.0, 20.0, 5.0), (-2000.0, 1.0, 0.0)]


@pytest.fixture(scope="module")
def tree() -> SearchTree:
    return SearchTree.of(random_tree(600, 2, size_m=150.0))


@pytest.mark.parametrize("camera", [*CAMERAS, (-1e7, 0.0, 0.0)])
@pytest.mark.parametrize("extra", [0.0, 1.0, -1.0])
@pytest.mark.parametrize("octree", [False, True])
def test_octree_gs_selects_what_its_rule_says(
    tree: SearchTree, camera: tuple[float, float, float], extra: float, octree: bool
) -> None:
    request = SearchRequest(camera, 929.2, 6.0)
    ids = OctreeGsSearch(tree, extra_level=extra, octree=octree).select(request).node_ids
    chosen = set(ids.tolist())
    root = float(tree.extent[0])
    levels = np.full(len(tree), 255)  # what has no size
    for node in range(len(tree)):
        if octree:
            levels[node] = 0 if node == 0 else levels[tree.parent[node]] + 1
        elif tree.extent[node] > 0:
            levels[node] = max(0, math.floor(math.log2(root / float(tree.extent[node]))))
    near = 0
    for node in range(len(tree)):
        distance = float(np.linalg.norm(tree.means[node].astype(float) - camera))
        exact = math.log2(float(request.factor) * root / distance)
        if abs(exact - round(exact)) < 1e-5:
            near += 1  # float32 may round to the other side
            continue
        limit = math.floor(min(max(exact, 0.0), float(levels.max())) + extra)
        assert (node in chosen) == (levels[node] <= limit)
    assert near <= 2 and (len(chosen) > 0 or extra < 0)
    assert ids.tolist() == sorted(chosen)


def test_octree_gs_selects_more_than_the_cut(tree: SearchTree) -> None:
    request = SearchRequest((0.0, 0.0, 0.0), 929.2, 6.0)
    rule = OctreeGsSearch(tree)
    before = parallel.threads()
    try:
        sets = []
        for threads in (1, 3):
            parallel.set_threads(threads)
            sets.append(rule.select(request).node_ids)
    finally:
        parallel.set_threads(before)
    assert np.array_equal(*sets)
    assert len(sets[0]) > make_search("flat", tree).search(request).cut_size


@pytest.mark.parametrize("camera", CAMERAS)
def test_city_gaussian_draws_every_block_at_the_level_of_its_distance(
    tree: SearchTree, camera: tuple[float, float, float]
) -> None:
    request = SearchRequest(camera, 929.2, 6.0)
    rule = CityGaussianSearch(tree, up=(0.0, -1.0, 0.0))
    ids = rule.select(request).node_ids
    assert len(set(ids.tolist())) == len(ids)
    ground = tree.means[:, [0, 2]].astype(float)
    low, high = ground.min(axis=0), ground.max(axis=0)
    counts = np.ceil((high - low) / BLOCK_M)
    edge = (high - low) / counts
    here = np.array([camera[0], camera[2]])
    wanted = set()
    for node in range(len(tree)):
        cell = np.minimum(np.floor((ground[node] - low) / edge), counts - 1)
        corner = low + cell * edge
        outside = np.maximum(np.maximum(corner - here, here - corner - edge), 0.0)
        distance = float(np.hypot(*outside))
        limit = max(e for e in EXTENTS_M if float(request.factor) * e <= distance)
        leaf = tree.child_count[node] == 0
        small = leaf or (limit > 0 and tree.extent[node] <= limit)
        above = node > 0 and limit > 0 and tree.extent[tree.parent[node]] <= limit
        if small and not above:
            wanted.add(node)
    assert set(ids.tolist()) == wanted
    assert len(counts) == 2 and (counts >= 2).all()


def test_city_gaussian_copies_only_when_a_block_changes(tree: SearchTree) -> None:
    rule = CityGaussianSearch(tree)
    first = rule.select(SearchRequest((0.0, 0.0, 0.0), 929.2, 6.0))
    again = rule.select(SearchRequest((0.01, 0.0, 0.0), 929.2, 6.0))
    assert again.node_ids is first.node_ids and again.bytes_touched < first.bytes_touched
    far = rule.select(SearchRequest((5000.0, 0.0, 0.0), 929.2, 6.0))
    assert len(far.node_ids) < len(first.node_ids)


def test_a_city_without_vertical_is_refused(tree: SearchTree) -> None:
    with pytest.raises(InputError, match="up must be a direction"):
        CityGaussianSearch(tree, up=(0.0, 0.0, 0.0))
