"""Merging children once more gives what the builder gave."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians import parallel
from gaussians.scene import FIELDS
from lod_cloud.build import BuildOptions, build_tree
from lod_cloud.lod_tree import Int32, LodTree
from lod_cloud.node_records import NodeRecords
from lod_cloud.siblings import faithful, merge_siblings
from tests.lod_cloud.test_codec_compact import covariances, masses
from tests.lod_cloud.trees import random_scene, random_tree


def merged_again(tree: LodTree) -> tuple[NodeRecords, NodeRecords]:
    """Every interior node, merged from its children and as the tree has it."""
    inner = np.flatnonzero(tree.child_count).astype(np.int32)
    children = np.arange(1, len(tree), dtype=np.int32)
    bounds: Int32 = np.append(tree.first_child[inner] - 1, len(children)).astype(np.int32)
    merged = merge_siblings(inner, tree.parent[inner], NodeRecords.of(tree, children), bounds)
    return merged, NodeRecords.of(tree, inner)


@given(st.integers(2, 150), st.integers(0, 99), st.sampled_from([1.0, 0.5]))
@settings(max_examples=30)
def test_merging_again_gives_the_tree(count: int, seed: int, ratio: float) -> None:
    scene = random_scene(count, seed)
    scene.scales[:] = np.maximum(scene.scales, 1e-3)
    scene.opacities[:] = np.maximum(scene.opacities, 0.05)
    merged, right = merged_again(build_tree(scene, options=BuildOptions(fan_out_ratio=ratio)))
    sigmas = right.gaussians.scales.max(axis=1).astype(float)
    off = np.abs(merged.gaussians.means.astype(float) - right.gaussians.means).max(axis=1)
    assert (off <= 1e-4 * sigmas).all()
    assert np.abs(masses(merged) / masses(right) - 1).max() < 1e-5
    one, other = (
        covariances(nodes.gaussians.scales.astype(float), nodes.gaussians.quaternions)
        for nodes in (merged, right)
    )
    assert (np.abs(one - other).max(axis=(1, 2)) <= 1e-4 * sigmas**2).all()
    assert np.abs(merged.gaussians.sh - right.gaussians.sh).max() < 1e-4
    for name in ("ids", "parents", "child_counts"):
        assert np.array_equal(getattr(merged, name), getattr(right, name))
    assert (merged.radius <= right.radius * 1.0001).all()
    if ratio == 1:
        assert np.abs(merged.radius / right.radius - 1).max() < 1e-4
        assert np.abs(merged.extent / right.extent - 1).max() < 1e-4


def test_threads_change_nothing() -> None:
    tree = random_tree(500, 3)
    before = parallel.threads()
    try:
        parallel.set_threads(1)
        one = merged_again(tree)[0]
        parallel.set_threads(3)
        three = merged_again(tree)[0]
    finally:
        parallel.set_threads(before)
    for name in FIELDS:
        left, right = getattr(one.gaussians, name), getattr(three.gaussians, name)
        assert np.array_equal(left, right)
    assert np.array_equal(one.radius, three.radius)


def test_children_without_mass_weigh_the_same() -> None:
    tree = random_tree(2, 1)
    children = NodeRecords.of(tree, np.array([1, 2], np.int32))
    clear = dataclasses.replace(children.gaussians, opacities=np.zeros(2, np.float32))
    nothing = dataclasses.replace(children, gaussians=clear)
    ids, bounds = np.zeros(1, np.int32), np.array([0, 2], np.int32)
    merged = merge_siblings(ids, ids - 1, nothing, bounds).gaussians
    assert merged.means[0] == pytest.approx(children.gaussians.means.mean(axis=0), abs=1e-6)
    assert merged.opacities[0] == 0


def test_only_merges_are_faithful() -> None:
    scene = random_scene(200, 5)
    scene.scales[:] = np.maximum(scene.scales, 1e-2)
    scene.opacities[:] = np.maximum(scene.opacities, 0.05)
    tree = build_tree(scene)
    inner = np.flatnonzero(tree.child_count).astype(np.int32)
    assert faithful(tree, inner).all()
    assert faithful(tree, inner[:0]).shape == (0,)
    moved, heavy = inner[[3, 9]]
    tree.gaussians.means[moved] += 0.01
    tree.gaussians.opacities[heavy] *= np.float32(1.01)
    assert np.array_equal(inner[~faithful(tree, inner)], np.unique(_near(tree, [moved, heavy])))
    tree.gaussians.means[:] += 1e6  # float32 is too coarse there
    assert not faithful(tree, inner).any()


def _near(tree: LodTree, nodes: list[int]) -> Int32:
    """The nodes and their parents, which their children no longer add up to."""
    return np.array([*nodes, *(tree.parent[node] for node in nodes)], np.int32)
