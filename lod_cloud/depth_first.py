"""The order in which the nodes of a step travel.

Ids count a tree level by level, so in a first picture, whose cut is spread over all levels, the
node with the id before is somewhere else. What a message expands is a forest that both ends know
from its events; walked depth first, the node before is a sibling, or a near relative.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lod_cloud.lod_tree import Int32


def depth_first(
    sent: Int32, parents: Int32, expanded: Int32, expanded_parents: Int32
) -> NDArray[np.int64]:
    """The order of the nodes ``sent`` (ascending): depth first in the forest of these and the nodes
    ``expanded`` (ascending, none of them sent). Every parent must have a smaller id than its child.
    """
    nodes = np.concatenate([expanded, sent])
    order = np.argsort(nodes, kind="stable")
    nodes, above = nodes[order], np.concatenate([expanded_parents, parents])[order]
    rows = np.searchsorted(nodes, above)  # of a parent: below the child's
    rows[nodes[np.minimum(rows, len(nodes) - 1)] != above] = -1
    places = np.empty(len(nodes), np.int64)
    places[order] = _places(rows)
    return np.argsort(places[len(expanded) :])


@njit(cache=True, error_model="numpy", nogil=True)
def _places(above):  # type: ignore[no-untyped-def]
    """Place of every node of a forest, depth first; ``above`` [N] is the row of the parent, which
    comes before, or -1.
    """
    sizes = np.ones(len(above), np.int64)
    for i in range(len(above) - 1, -1, -1):
        if above[i] >= 0:
            sizes[above[i]] += sizes[i]
    following = np.empty(len(above), np.int64)  # place of the next child
    places = np.empty(len(above), np.int64)
    roots = 0
    for i in range(len(above)):
        if above[i] < 0:
            places[i] = roots
            roots += sizes[i]
        else:
            places[i] = following[above[i]]
            following[above[i]] += sizes[i]
        following[i] = places[i] + 1
    return places
