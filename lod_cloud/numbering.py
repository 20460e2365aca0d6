"""Breadth-first numbers for the nodes of an unfinished tree, with or without small steps.

*Irregular fan-out*: an interior node whose extent e is more than ``ratio`` times that of its
nearest kept ancestor is left out, and that ancestor takes its children (`lod_cloud.spheres` then
fits R and e to those).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from lod_cloud.lod_tree import Float32, Int32

_HUGE = np.float32(np.inf)
_MOST_LEVELS = 1024  # 31 of median splits, each with at most 32 merges on a path


@dataclass(frozen=True)
class Numbering:
    """Structure of the finished tree."""

    parent: Int32  # [N], -1 for the root
    first_child: Int32  # [N], -1 for leaves
    child_count: Int32  # [N], 0 for leaves
    level_offsets: Int32  # [levels + 1]
    nodes: Int32  # [N] number in the unfinished tree; leaves first there

    def __len__(self) -> int:
        return len(self.nodes)


def number_nodes(children: Int32, root: int, extent: Float32, ratio: float = 1.0) -> Numbering:
    """Level by level, from left to right. ``children`` [leaves - 1, 2]; ``ratio`` 1 keeps all."""
    nothing = np.empty(0, np.int32)
    counts = np.zeros(_MOST_LEVELS, np.int32)
    _walk(children, root, extent, np.float32(ratio), counts, nothing, nothing, nothing, nothing)
    offsets = np.concatenate([[0], np.cumsum(counts[: np.count_nonzero(counts)])]).astype(np.int32)
    total = int(offsets[-1])
    parent, first_child, nodes = (np.full(total, -1, np.int32) for _ in range(3))
    child_count = np.zeros(total, np.int32)
    free = np.zeros(_MOST_LEVELS, np.int32)
    free[: len(offsets)] = offsets
    _walk(children, root, extent, np.float32(ratio), free, nodes, parent, first_child, child_count)
    return Numbering(parent, first_child, child_count, offsets, nodes)


@njit(cache=True, error_model="numpy", nogil=True)
def _walk(children, root, extent, ratio, free, nodes, parent, first_child, child_count):  # type: ignore[no-untyped-def]
    """Depth first from left to right: every kept node takes the next free number of its level.

    With empty arrays ``nodes`` ... nodes are only counted.
    """
    leaves = len(children) + 1
    store = len(nodes) > 0
    waiting = np.empty((len(free), 3), np.int32)  # node, its level, its nearest kept ancestor
    sizes = np.empty(len(free), np.float32)  # extent of that ancestor
    waiting[0, 0], waiting[0, 1], waiting[0, 2] = root, 0, -1
    sizes[0] = _HUGE
    depth = 1
    while depth:
        depth -= 1
        node, level, above = waiting[depth, 0], waiting[depth, 1], waiting[depth, 2]
        size = sizes[depth]
        if node < leaves or level == 0 or not extent[node] > ratio * size:
            number = free[level]
            free[level] += np.int32(1)
            if store:
                nodes[number] = node
                parent[number] = above
                if above >= 0:
                    if child_count[above] == 0:
                        first_child[above] = number
                    child_count[above] += np.int32(1)
            level += np.int32(1)
            above = number
            size = extent[node]
        if node >= leaves:
            for side in range(2):
                waiting[depth, 0] = children[node - leaves, 1 - side]
                waiting[depth, 1], waiting[depth, 2] = level, above
                sizes[depth] = size
                depth += 1
