"""The order in which the nodes of a step travel."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from lod_cloud.build import BuildOptions, build_tree
from lod_cloud.depth_first import depth_first
from lod_cloud.lod_tree import LodTree
from tests.lod_cloud.trees import random_scene


def walked(tree: LodTree, node: int, expanded: set[int], sent: set[int]) -> list[int]:
    """Nodes sent below one, the slow and obvious way."""
    found = [node] if node in sent else []
    if node in expanded:
        first = int(tree.first_child[node])
        for child in range(first, first + int(tree.child_count[node])):
            found += walked(tree, child, expanded, sent)
    return found


@given(st.integers(2, 120), st.integers(0, 999), st.sampled_from([1.0, 0.5]), st.floats(0, 1))
@settings(max_examples=60)
def test_one_subtree_after_the_other(count: int, seed: int, ratio: float, share: float) -> None:
    """Roots in the order of their ids; a node sent whose parent is not expanded is one."""
    tree = build_tree(random_scene(count, seed), options=BuildOptions(fan_out_ratio=ratio))
    rng = np.random.default_rng(seed)
    expanded = np.flatnonzero((rng.random(len(tree)) < share) & (tree.child_count > 0))
    others = np.setdiff1d(np.arange(len(tree)), expanded)
    sent = others[rng.random(len(others)) < 0.8].astype(np.int32)
    sent = sent[~np.isin(tree.parent[sent], sent)]  # a cut has no node and its parent
    sent = sent[~np.isin(sent, tree.parent[expanded])]
    expanded = expanded.astype(np.int32)
    above = tree.parent[expanded]
    order = depth_first(sent, tree.parent[sent], expanded, above)
    inside = set(expanded.tolist())
    roots = [n for n in range(len(tree)) if int(tree.parent[n]) not in inside]
    expected = [m for n in roots for m in walked(tree, n, inside, set(sent.tolist()))]
    assert sent[order].tolist() == expected
    unknown = np.where(np.isin(above, expanded), above, -1).astype(np.int32)  # as a client knows
    assert np.array_equal(depth_first(sent, tree.parent[sent], expanded, unknown), order)
