"""The voxel octree: one node per occupied voxel and level, merged from what lies in it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.errors import InputError
from gaussians.scene import FIELDS
from lod_cloud import LodTree, SearchRequest, prove_nesting
from lod_cloud.imports import build_octree
from lod_cloud.search import SEARCHES, SearchTree, make_search
from tests.lod_cloud.trees import random_scene
from tests.naive import lod_merge as naive


def members(tree: LodTree) -> list[list[int]]:
    """Ids of the leaves below every node."""
    below: list[list[int]] = [[] for _ in range(len(tree))]
    for node in range(len(tree) - 1, -1, -1):
        if tree.leaf_id[node] >= 0:
            below[node].append(int(tree.leaf_id[node]))
        if node:
            below[tree.parent[node]] += below[node]
    return below


def depths(tree: LodTree) -> np.ndarray:
    return np.repeat(np.arange(tree.levels), np.diff(tree.level_offsets))


@given(st.integers(1, 120), st.integers(0, 9999))
@settings(max_examples=25, deadline=None)
def test_a_node_is_a_voxel_with_all_that_is_in_it(count: int, seed: int) -> None:
    scene = random_scene(count, seed)
    tree = build_octree(scene).validate()
    assert prove_nesting(tree) == 0
    leaves = tree.gaussians.take(tree.leaf_nodes())
    for name in FIELDS:
        assert getattr(leaves, name).tobytes() == getattr(scene, name).tobytes()
    means = scene.means.astype(float)
    low, edge = means.min(axis=0), float(tree.metadata.build["edge_m"])
    for node, below in enumerate(members(tree)):
        cells = 2 ** int(min(depths(tree)[node], tree.metadata.build["levels"] - 1))
        scaled = (means - low) * (cells / edge if edge else 0.0)
        voxels = np.minimum(np.floor(scaled), cells - 1)
        inside = (voxels == voxels[below[0]]).all(axis=1)
        if tree.child_count[node]:
            assert sorted(below) == np.flatnonzero(inside).tolist()
        else:
            assert len(below) == 1
    shared = 0  # voxels of several Gaussians, over all levels
    for level in range(int(tree.metadata.build["levels"])):
        scaled = (means - low) * (2**level / edge if edge else 0.0)
        places = np.minimum(np.floor(scaled), 2**level - 1)
        shared += int((np.unique(places, axis=0, return_counts=True)[1] > 1).sum())
    assert np.count_nonzero(tree.child_count) == shared


def test_voxels_are_merges_of_their_gaussians() -> None:
    scene = random_scene(300, 3)
    scene.scales[:] = np.maximum(scene.scales, 1e-3)  # lines have a mass but no surface to keep it
    tree = build_octree(scene)
    g = tree.gaussians
    for node, below in enumerate(members(tree)):
        if not tree.child_count[node]:
            continue
        wanted = naive.merge(scene.take(np.array(below)))
        size = max(float(np.sqrt(np.trace(wanted.covariance))), 1e-6)
        assert np.allclose(g.means[node], wanted.mean, rtol=1e-6, atol=1e-6)
        ours = naive.covariance(g.quaternions[node], g.scales[node])
        assert np.abs(ours - wanted.covariance).max() < 2e-6 * size * size
        assert g.sh[node] == pytest.approx(wanted.sh, rel=1e-5, abs=1e-6)
        if naive.surface(g.scales[node]) > 1e-5 * size * size:
            assert g.opacities[node] == pytest.approx(wanted.opacity, rel=1e-3)


def test_all_searches_agree() -> None:
    tree = SearchTree.of(build_octree(random_scene(900, 4)))
    searches = [make_search(name, tree) for name in SEARCHES]
    sizes = set()
    for step in range(30):
        request = SearchRequest((0.4 * step - 6.0, 1.0, 0.5), 200.0, 15.0)
        cuts = [search.search(request).cut for search in searches]
        assert all(np.array_equal(cut, cuts[0]) for cut in cuts)
        sizes.add(len(cuts[0]))
    assert len(sizes) > 10


def test_points_in_one_place_make_one_voxel() -> None:
    scene = random_scene(20, 5)
    scene.means[:] = 1.0
    tree = build_octree(scene).validate()
    assert (len(tree), tree.levels, prove_nesting(tree)) == (21, 2, 0)
    scene.scales[:] = 0.0
    assert prove_nesting(build_octree(scene).validate()) == 0


def test_nothing_makes_no_octree() -> None:
    with pytest.raises(InputError, match="at least one Gaussian; the scene is empty"):
        build_octree(random_scene(3, 1).take(np.arange(0)))
