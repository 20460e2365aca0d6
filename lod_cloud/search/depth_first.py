"""The plain top-down search: a stack, no history."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numba import njit

from lod_cloud.criterion import SearchRequest
from lod_cloud.search.interface import FullSearch
from lod_cloud.search.marks import is_set, set_bit, stays_refined
from lod_cloud.search.search_tree import Marks

_BYTES_PER_TEST = 12 + 4 + 4 + 4 + 4  # mean, R, e, child count, first child


class DepthFirstSearch(FullSearch):
    """Walks from the root to the cut, one node after the other, on one thread."""

    name: ClassVar[str] = "depth_first"

    def _mark(self, request: SearchRequest, before: Marks, marks: Marks) -> tuple[int, int]:
        tree = self.tree
        marks[:] = 0
        cx, cy, cz = request.camera
        tested = _descend(
            cx,
            cy,
            cz,
            request.factor,
            self.grow,
            tree.first_child,
            tree.child_count,
            tree.means,
            tree.radius,
            tree.extent,
            before,
            marks,
        )
        return tested, _BYTES_PER_TEST * tested


@njit(cache=True, error_model="numpy", nogil=True)
def _descend(cx, cy, cz, k, grow, first_child, child_count, means, radius, extent, before, marks):  # type: ignore[no-untyped-def]
    stack = np.empty(len(child_count), np.int32)  # memory is taken by what is written
    stack[0] = 0
    depth = 1
    tested = 0
    while depth:
        depth -= 1
        node = stack[depth]
        tested += 1
        if child_count[node] == 0 or not stays_refined(
            cx, cy, cz, means[node, 0], means[node, 1], means[node, 2],
            radius[node], extent[node], k, grow, is_set(before, node),
        ):  # fmt: skip
            continue
        set_bit(marks, node)
        for child in range(first_child[node] + child_count[node] - 1, first_child[node] - 1, -1):
            stack[depth] = child
            depth += 1
    return tested
