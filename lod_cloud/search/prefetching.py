"""Nodes in no particular order, gathered in batches.

Searches that visit nodes in no particular order wait for memory at each of them; asking a dozen
nodes in advance (`gaussians.lanes.prefetch`) lets those waits overlap. Listed in
`gaussians.kernel_cache`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gaussians.lanes import prefetch
from lod_cloud.search.marks import is_set
from lod_cloud.search_arrays import RECORD_COLUMNS

BATCH = 256  # nodes gathered together
_AHEAD = 24  # nodes whose record is asked for in advance


@njit(forceinline=True)
def gather(nodes, begin, end, records, refined, rows, was):  # type: ignore[no-untyped-def]
    """Records of up to BATCH of nodes[begin:end], number by number: x, y, z, R, e to
    ``rows`` [5, BATCH], whether refined to ``was`` [BATCH]; how many.

    Side by side they are what a compiler turns into vector instructions.
    """
    held = min(BATCH, end - begin)
    for i in range(held):
        later = np.intp(nodes[min(begin + i + _AHEAD, end - 1)])
        prefetch(records, later * RECORD_COLUMNS)
        prefetch(refined, later >> 3)
        node = np.intp(nodes[begin + i])
        for column in range(5):
            rows[column, i] = records[node, column]
        was[i] = is_set(refined, node)
    return held
