"""Numbers of nodes: breadth-first, in blocks that do not depend on each other."""

from __future__ import annotations

import numpy as np
import pytest

from gaussians import parallel
from lod_cloud.merge import merge_leaves
from lod_cloud.numbering import BLOCK_NODES, number_nodes
from lod_cloud.split import split_order
from tests.lod_cloud.trees import random_scene
from tests.naive import lod_merge as naive


@pytest.mark.parametrize("ratio", [1.0, 0.7, 0.5])
@pytest.mark.parametrize("threads", [1, 3])
def test_numbers_are_those_of_a_walk_over_all_levels(ratio: float, threads: int) -> None:
    """Of levels of more nodes than are numbered at a time, on any number of threads."""
    scene = random_scene(120_000, 13, sh_degree=0)
    before = parallel.threads()
    parallel.set_threads(threads)
    try:
        ids = split_order(scene.means, 1)
        nodes, children = merge_leaves(scene, ids, 1)
        # powers of two: many are exactly half of the one above
        extent = np.exp2(np.round(np.log2(nodes.extent + np.float32(1e-6)))).astype(np.float32)
        found = number_nodes(children, 2 * len(scene) - 2, extent, ratio)
    finally:
        parallel.set_threads(before)
    levels, parents = naive.numbering(children, 2 * len(scene) - 2, extent, ratio)
    assert max(map(len, levels)) > 2 * BLOCK_NODES
    assert found.level_offsets.tolist() == np.cumsum([0, *map(len, levels)]).tolist()
    assert found.nodes.tolist() == [node for level in levels for node in level]
    above = [parents[node] for node in found.nodes.tolist()]
    assert found.parent[0] == -1 and found.nodes[found.parent[1:]].tolist() == above[1:]
    counts = np.bincount(found.parent[1:], minlength=len(found))
    assert np.array_equal(found.child_count, counts)
    firsts = np.where(counts > 0, 1 + np.cumsum(counts) - counts, -1)
    assert np.array_equal(found.first_child, firsts)
