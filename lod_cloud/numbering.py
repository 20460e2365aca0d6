"""Breadth-first numbers for the nodes of an unfinished tree, with or without small steps.

*Irregular fan-out*: an interior node whose extent e is more than ``ratio`` times that of its
nearest kept ancestor is left out, and that ancestor takes its children (`lod_cloud.spheres` then
fits R and e to those).

Level by level: the children of every block of nodes are counted first, which says where those of
the next block begin; so blocks do not depend on each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from gaussians.lanes import prefetch
from gaussians.parallel import run_chunks
from lod_cloud.lod_tree import Float32, Int32

BLOCK_NODES = 1 << 14
_AHEAD = 16  # nodes whose children are on their way from memory
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
    """Level by level, from left to right. ``children`` [leaves - 1, 2] and ``extent`` [leaves - 1]
    are those of the interior nodes; ``ratio`` 1 keeps all.
    """
    most = 2 * len(children) + 1
    nodes, parent, first_child, child_count = links = [np.empty(most, np.int32) for _ in range(4)]
    nodes[0], parent[0] = root, -1
    # side by side, and not read where all nodes are kept
    extent = np.ascontiguousarray(extent if ratio < 1 else extent[:0])
    offsets, end = [0], 1
    while offsets[-1] < end:
        begin = offsets[-1]
        offsets.append(end)
        blocks = -(-(end - begin) // BLOCK_NODES)
        counts = np.zeros(blocks + 1, np.int64)  # before the first block: none
        level = begin, end, children, extent, np.float32(ratio), *links
        run_chunks(_expand, blocks, counts, False, *level)
        places = end + np.cumsum(counts)
        run_chunks(_expand, blocks, places, True, *level)
        end = int(places[-1])
    return Numbering(
        parent[:end],
        first_child[:end],
        child_count[:end],
        np.array(offsets, np.int32),
        nodes[:end],
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _expand(  # type: ignore[no-untyped-def]
    first,
    last,
    places,
    number_them,
    begin,
    end,
    children,
    extent,
    ratio,
    nodes,
    parent,
    first_child,
    child_count,
):
    """The children of the nodes in the blocks first..last of the level begin..end.

    They are counted, block by block, to ``places[block + 1]``, or take the numbers from
    ``places[block]`` on.
    """
    leaves = len(children) + 1
    keeps_all = ratio >= np.float32(1.0)
    waiting = np.empty(_MOST_LEVELS, np.int32)
    for block in range(first, last):
        free = places[block] if number_them else 0
        low = begin + block * BLOCK_NODES
        for number in range(low, min(low + BLOCK_NODES, end)):
            prefetch(children, 2 * (np.int64(nodes[min(number + _AHEAD, end - 1)]) - leaves))
            node, before = nodes[number], free
            depth = 0
            if keeps_all and not number_them:
                free += 2 * np.int64(node >= leaves)
            elif node >= leaves:
                waiting[0], waiting[1] = children[node - leaves, 1], children[node - leaves, 0]
                depth = 2
            while depth:
                depth -= 1
                child = waiting[depth]
                if (
                    child < leaves
                    or keeps_all
                    or not extent[child - leaves] > ratio * extent[node - leaves]
                ):
                    if number_them:
                        nodes[free], parent[free] = child, number
                    free += 1
                else:
                    waiting[depth] = children[child - leaves, 1]
                    waiting[depth + 1] = children[child - leaves, 0]
                    depth += 2
            child_count[number] = free - before
            first_child[number] = before if free > before else -1
        if not number_them:
            places[block + 1] = free
