"""Loops of `lod_cloud.pacing`: forests of events, and nodes in the order of their errors."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lod_cloud.search.marks import is_set

_SHIFT = 17  # of a float32's bits: 64 steps of error per factor of two, 1.1 % each
_BINS = (0x7F800000 >> _SHIFT) + 1  # the last one is infinity


@njit(cache=True, error_model="numpy", nogil=True)
def forest(nodes, parent, child_count):  # type: ignore[no-untyped-def]
    """Row of the parent among ``nodes`` or -1; size of the subtree; by how much collapsing it makes
    a cut smaller.
    """
    above = np.full(len(nodes), -1, np.int32)
    row = 0
    for i in range(len(nodes)):  # parents of ascending nodes ascend
        while nodes[row] < parent[nodes[i]]:
            row += 1
        if nodes[row] == parent[nodes[i]]:
            above[i] = row
    sizes = np.ones(len(nodes), np.int32)
    shrink = np.empty(len(nodes), np.int32)
    for i in range(len(nodes)):
        shrink[i] = child_count[nodes[i]] - 1
    for i in range(len(nodes) - 1, -1, -1):
        if above[i] >= 0:
            sizes[above[i]] += sizes[i]
            shrink[above[i]] += shrink[i]
    return above, sizes, shrink


@njit(cache=True, error_model="numpy", nogil=True)
def include_below(chosen, above):  # type: ignore[no-untyped-def]
    """Choose what is below something chosen."""
    for i in range(len(chosen)):
        if above[i] >= 0 and chosen[above[i]]:
            chosen[i] = True


@njit
def _error(node, means, radius, extent, cx, cy, cz):  # type: ignore[no-untyped-def]
    """e / (d - R) in float64; infinite inside the sphere."""
    dx = cx - np.float64(means[node, 0])
    dy = cy - np.float64(means[node, 1])
    dz = cz - np.float64(means[node, 2])
    beyond = math.sqrt(dx * dx + dy * dy + dz * dz) - np.float64(radius[node])
    return np.float64(extent[node]) / beyond if beyond > 0.0 else np.inf


@njit(cache=True, error_model="numpy", nogil=True)
def expand_first(  # type: ignore[no-untyped-def]
    pending, refined, wanted, parent, first_child, child_count, means, radius, extent,
    cx, cy, cz, stages, limit_nodes, limit_growth, least,
):  # fmt: skip
    """Best first, by a queue of one list per step of error: nodes ready to be expanded, because
    their parent is refined already. Expanding one makes its own pending children ready, and those
    with an error above the stage come next. Nodes chosen; nodes they bring and those the others
    would; the largest error of these.
    """
    ready = np.empty(len(pending), np.int32)
    following = np.empty(len(pending), np.int32)
    errors = np.empty(len(pending), np.float32)
    bits = errors.view(np.int32)
    heads = np.full(_BINS, -1, np.int32)
    count = brought = 0
    for node in pending:
        brought += child_count[node]
        if node == 0 or is_set(refined, parent[node]):
            ready[count] = node
            errors[count] = _error(node, means, radius, extent, cx, cy, cz)
            place = bits[count] >> _SHIFT
            following[count] = heads[place]
            heads[place] = count
            count += 1
    at_once = count  # the others are ready because of a node chosen here
    chosen = np.empty(len(pending), np.int32)
    found = added = growth = opened = stage = 0
    place = _BINS - 1
    while True:
        while place >= 0 and heads[place] < 0:
            place -= 1
        if place < 0:
            break
        row = heads[place]
        node = ready[row]
        more = child_count[node] - (row >= at_once)
        if found >= least and (
            added + more > limit_nodes or growth + child_count[node] - 1 > limit_growth
        ):
            break
        heads[place] = following[row]
        while stage < len(stages) - 1 and errors[row] <= stages[stage]:
            stage += 1
        chosen[found] = node
        found += 1
        added += more
        growth += child_count[node] - 1
        opened += child_count[node]
        for child in range(first_child[node], first_child[node] + child_count[node]):
            if is_set(wanted, child):
                ready[count] = child
                errors[count] = _error(child, means, radius, extent, cx, cy, cz)
                own = min(place, bits[count] >> _SHIFT)
                below = place if errors[count] > stages[stage] else own
                following[count] = heads[below]
                heads[below] = count
                count += 1
    lacking = (brought - opened) - (len(pending) - found) + (count - found)
    beyond = np.zeros(1, np.float32)
    while place >= beyond.view(np.int32)[0] >> _SHIFT:
        row = heads[place]
        while row >= 0:
            beyond[0] = max(beyond[0], errors[row])
            row = following[row]
        place -= 1
    return chosen[:found], added, lacking, beyond[0]
