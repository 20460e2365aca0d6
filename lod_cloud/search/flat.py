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
from lod_cloud.search.marks import ONE, inside_group, test_group
from lod_cloud.search.search_tree import Marks, SearchTree

BYTES_PER_TEST = 12 + 4 + 4  # mean, R (which says what a leaf is), e


def flat_search(tree: LodTree, request: SearchRequest) -> Cut:
    """The cut of ``tree`` for ``request``, by one scan over all nodes, for a client without
    history.
    """
    result = FlatSearch(SearchTree.of(tree)).search(request)
    return Cut(result.cut, result.nodes_tested, result.bytes_touched)


class FlatSearch(FullSearch):
    """One scan over all nodes in breadth-first order, 16 side by side.

    Every node is tested, whether or not its parent is refined: the test is nested, and reading
    the node costs more than testing it.
    """

    name: ClassVar[str] = "flat"

    def _mark(self, request: SearchRequest, before: Marks, marks: Marks) -> tuple[int, int]:
        groups = self.tree.groups
        cx, cy, cz = request.camera
        run_chunks(
            _scan,
            len(groups),
            cx,
            cy,
            cz,
            request.factor,
            self.grow,
            groups,
            before.view(np.uint16),
            marks.view(np.uint16),
        )
        return len(self.tree), BYTES_PER_TEST * len(self.tree)


@njit(cache=True, error_model="numpy", nogil=True)
def _scan(begin, end, cx, cy, cz, k, grow, groups, before, marks):  # type: ignore[no-untyped-def]
    if grow > ONE:
        for group in range(begin, end):
            marks[group] = test_group(group, cx, cy, cz, k, grow, groups, before)
    else:  # the same with half the work
        for group in range(begin, end):
            marks[group] = inside_group(group, cx, cy, cz, k, ONE, groups)
