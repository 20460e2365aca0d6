"""The exhaustive LoD search: looks at every node, knows no history."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numba import njit

from gaussians.parallel import run_chunks
from lod_cloud.criterion import SearchRequest
from lod_cloud.cut import Cut
from lod_cloud.lod_tree import LodTree
from lod_cloud.search.interface import FullSearch
from lod_cloud.search.marks import BLOCK, test_block
from lod_cloud.search.search_tree import Marks, SearchTree

BYTES_PER_TEST = 12 + 4 + 4 + 4  # mean, R, e, child count


def flat_search(tree: LodTree, request: SearchRequest) -> Cut:
    """The cut of ``tree`` for ``request``, by one scan over all nodes, for a client without
    history.
    """
    result = FlatSearch(SearchTree.of(tree)).search(request)
    return Cut(result.cut, result.nodes_tested, result.bytes_touched)


class FlatSearch(FullSearch):
    """One scan over all nodes in breadth-first order, 64 side by side.

    Every node is tested, whether or not its parent is refined: the test is nested, and reading
    the node costs more than testing it.
    """

    name: ClassVar[str] = "flat"

    def _mark(self, request: SearchRequest, before: Marks, marks: Marks) -> tuple[int, int]:
        tree = self.tree
        marks[:] = before
        cx, cy, cz = request.camera
        run_chunks(
            _scan,
            len(marks) // (BLOCK // 8),
            cx,
            cy,
            cz,
            request.factor,
            self.grow,
            tree.child_count,
            tree.positions,
            tree.radius,
            tree.extent,
            marks,
        )
        return len(tree), BYTES_PER_TEST * len(tree)


@njit(cache=True, error_model="numpy", nogil=True)
def _scan(begin, end, cx, cy, cz, k, grow, child_count, positions, radius, extent, marks):  # type: ignore[no-untyped-def]
    flags = np.empty(BLOCK, np.uint8)
    for block in range(begin, end):
        test_block(block, cx, cy, cz, k, grow, child_count, positions, radius, extent, marks, flags)
