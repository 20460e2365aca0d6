"""The cut: the set of nodes a LoD search selects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lod_cloud.lod_tree import Int32, LodTree


@dataclass(frozen=True)
class Cut:
    """Nodes that are not refined and whose parent is (or the root), and what finding them took.

    Every path from the root to a leaf meets the cut exactly once.
    """

    node_ids: Int32  # [M] ascending
    nodes_tested: int  # evaluations of the node test
    bytes_touched: int  # bytes of the tree's arrays that were read

    def __len__(self) -> int:
        return len(self.node_ids)


def crossings(tree: LodTree, node_ids: Int32) -> Int32:
    """[leaves] how many of the nodes lie on the path from the root to each leaf, in order of
    leaf_id.
    """
    on_path = np.zeros(len(tree), np.int32)
    on_path[node_ids] = 1
    for begin, end in zip(tree.level_offsets[1:-1], tree.level_offsets[2:], strict=True):
        on_path[begin:end] += on_path[tree.parent[begin:end]]
    return on_path[tree.leaf_nodes()]


def is_complete(tree: LodTree, node_ids: Int32) -> bool:
    """Whether every path from the root to a leaf meets the nodes exactly once."""
    return len(np.unique(node_ids)) == len(node_ids) and bool(
        (crossings(tree, node_ids) == 1).all()
    )


def without(ids: Int32, others: Int32) -> Int32:
    """Members of ``ids`` that are not in ``others``, in the order of ``ids``; both without
    duplicates.
    """
    return ids[~np.isin(ids, others, assume_unique=True)]


def overlap(before: Cut, after: Cut) -> float:
    """Share of ``after`` that was already in ``before`` (Fig. 7); 1 for equal cuts."""
    return 1.0 - len(without(after.node_ids, before.node_ids)) / len(after)
