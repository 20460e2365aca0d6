"""The exhaustive LoD search: looks at every node, knows no history."""

from __future__ import annotations

import numpy as np
from numba import njit

from gaussians.parallel import run_chunks
from lod_cloud.criterion import SearchRequest, refines
from lod_cloud.cut import Cut
from lod_cloud.lod_tree import LodTree

# parent and child count; mean, R and e
_BYTES_PER_NODE = 4
_BYTES_PER_TEST = 4 + 12 + 4 + 4


def flat_search(tree: LodTree, request: SearchRequest) -> Cut:
    """The cut of ``tree`` for ``request``, by one scan over all nodes in breadth-first order.

    Every node looks up whether its parent is refined (tested once per group of siblings, which
    stand together) and, if so, is tested itself.
    """
    cx, cy, cz = request.camera
    gaussians = tree.gaussians
    chunks = run_chunks(
        _scan,
        len(tree),
        cx,
        cy,
        cz,
        request.factor,
        tree.parent,
        tree.child_count,
        gaussians.means,
        tree.radius,
        tree.extent,
    )
    tested = sum(tests for _, tests in chunks)
    return Cut(
        np.concatenate([ids for ids, _ in chunks]),
        tested,
        _BYTES_PER_NODE * len(tree) + _BYTES_PER_TEST * tested,
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _scan(begin, end, cx, cy, cz, k, parent, child_count, means, radius, extent):  # type: ignore[no-untyped-def]
    ids = np.empty(end - begin, np.int32)
    found = 0
    tests = 0
    last = np.int32(-2)
    parent_refined = False
    for node in range(begin, end):
        above = parent[node]
        if above != last:
            last = above
            parent_refined = above < 0
            if not parent_refined:
                if node == 0 or parent[node - 1] != above:  # counted once, by the first sibling
                    tests += 1
                parent_refined = refines(
                    cx, cy, cz, means[above, 0], means[above, 1], means[above, 2],
                    radius[above], extent[above], k,
                )  # fmt: skip
        if parent_refined:
            refined = False
            if child_count[node]:
                tests += 1
                refined = refines(
                    cx, cy, cz, means[node, 0], means[node, 1], means[node, 2],
                    radius[node], extent[node], k,
                )  # fmt: skip
            if not refined:
                ids[found] = node
                found += 1
    return ids[:found].copy(), tests
