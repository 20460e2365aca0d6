"""From "who is whose parent" to the breadth-first arrays of a tree."""

from __future__ import annotations

import numpy as np

from gaussians.scene import Scene
from lod_cloud.lod_tree import Float32, Int32, LodTree, TreeMetadata


def tree_from_parents(
    parent: Int32,
    gaussians: Scene,
    radius: Float32,
    extent: Float32,
    leaf_id: Int32,
    metadata: TreeMetadata,
) -> LodTree:
    """A tree whose N nodes come in any order; siblings keep theirs. -1 is the root's parent."""
    count = len(parent)
    children = np.bincount(parent[parent >= 0], minlength=count)
    by_parent = np.argsort(parent, kind="stable")  # the root, then all children, parent by parent
    firsts = 1 + np.cumsum(children) - children
    level = by_parent[:1]
    levels = []
    while len(level):
        levels.append(level)
        counts = children[level]
        shifts = firsts[level] - (np.cumsum(counts) - counts)
        level = by_parent[np.repeat(shifts, counts) + np.arange(counts.sum())]
    order = np.concatenate(levels)
    number = np.empty(count, np.int32)
    number[order] = np.arange(count, dtype=np.int32)
    child_count = children[order].astype(np.int32)
    first_child = (1 + np.cumsum(child_count) - child_count).astype(np.int32)
    first_child[child_count == 0] = -1
    ordered = np.full(count, -1, np.int32)
    ordered[1:] = number[parent[order[1:]]]
    return LodTree(
        ordered,
        first_child,
        child_count,
        np.cumsum([0, *(len(nodes) for nodes in levels)]).astype(np.int32),
        gaussians.take(order),
        radius[order],
        extent[order],
        leaf_id[order],
        metadata,
    )
