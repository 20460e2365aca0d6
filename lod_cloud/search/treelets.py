"""The tree cut into subtrees of nearly equal size, and the search that re-tests them (Sec. 4.2).

A *treelet* is named by its root r and consists of the nodes below r down to the roots of other
treelets, those included: they are the ends, tested here as nodes and again, as roots, by their
own treelet, which so notices by itself that nothing in it is needed any more. A treelet *bears*
cut nodes when a node of it is in the cut; only such treelets need to be looked at, by nesting:
where nothing bears, nothing below is refined or everything is.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lod_cloud.search.marks import clear_bit, is_set, set_bit, stays_refined
from lod_cloud.search_arrays import CHILD_COUNT, FIRST_CHILD, PARENT

_SLACK = 2.0**-21  # of T; the float32 test agrees with real numbers beyond half of that
_TINY = 1e-15  # metres


@njit(forceinline=True)
def _margin(node, cx, cy, cz, floats, k, grow, now):  # type: ignore[no-untyped-def]
    """How far the camera may come before the decision on a node can change."""
    t = floats[node, 3] + k * floats[node, 4]
    if now:
        t = grow * floats[node, 3] + (grow * k) * floats[node, 4]
    dx = np.float64(cx) - np.float64(floats[node, 0])
    dy = np.float64(cy) - np.float64(floats[node, 1])
    dz = np.float64(cz) - np.float64(floats[node, 2])
    away = np.sqrt(dx * dx + dy * dy + dz * dz) - np.float64(t)
    return (-away if now else away) - (np.float64(t) * _SLACK + _TINY)


@njit(forceinline=True)
def _decide(node, cx, cy, cz, floats, k, grow, was):  # type: ignore[no-untyped-def]
    return stays_refined(
        cx, cy, cz, floats[node, 0], floats[node, 1], floats[node, 2],
        floats[node, 3], floats[node, 4], k, grow, was,
    )  # fmt: skip


@njit(forceinline=True)
def _treelet_of(node, ints, roots):  # type: ignore[no-untyped-def]
    """Root of the treelet a node is a node of."""
    node = ints[node, PARENT]
    while not is_set(roots, node):
        node = ints[node, PARENT]
    return node


@njit(forceinline=True)
def _is_valid(ball, cx, cy, cz):  # type: ignore[no-untyped-def]
    """Whether the camera is where no decision of a treelet can have changed."""
    dx, dy, dz = cx - ball[0], cy - ball[1], cz - ball[2]
    return dx * dx + dy * dy + dz * dz < ball[3] * ball[3] * (1.0 - 1e-9)


@njit(forceinline=True)
def _ask_for(root, bearing, queue, queued):  # type: ignore[no-untyped-def]
    """Have a treelet tested that bore nothing; returns the new length of the queue."""
    if is_set(bearing, root):
        return queued
    set_bit(bearing, root)
    queue[queued] = root
    return queued + 1


@njit(forceinline=True)
def _test_below(  # type: ignore[no-untyped-def]
    root, cx, cy, cz, k, grow, floats, ints, roots, refined, bearing, keep,
    least, stack, opened, n_opened, queue, queued, shut,
):  # fmt: skip
    """Test the nodes of a treelet below its refined root, down to where they are not refined.

    Marks those that are refined and asks for the treelets at the ends. Returns whether the treelet
    bears cut nodes, ``least`` with the margins of those tested, how many were, and the lengths of
    the lists: opened, queue, and ``shut``, nodes that were refined before.
    """
    bears = False
    stack[0] = root
    depth, tested, shutting = 1, 0, 0
    while depth:
        depth -= 1
        node = stack[depth]
        first, count = ints[node, FIRST_CHILD], ints[node, CHILD_COUNT]
        for child in range(first, first + count):
            if ints[child, CHILD_COUNT] == 0:
                bears = True
                continue
            tested += 1
            was = is_set(refined, child)
            now = _decide(child, cx, cy, cz, floats, k, grow, was)
            if keep:
                least = min(least, _margin(child, cx, cy, cz, floats, k, grow, now))
            if now:
                if not was:
                    set_bit(refined, child)
                    opened[n_opened] = child
                    n_opened += 1
                if not is_set(roots, child):
                    stack[depth] = child
                    depth += 1
                elif not was:
                    queued = _ask_for(child, bearing, queue, queued)
            else:
                bears = True
                if was:
                    shut[shutting] = child
                    shutting += 1
    return bears, least, tested, n_opened, queued, shutting


@njit(forceinline=True)
def _close(root, ints, roots, refined, shut, shutting, closed, n_closed):  # type: ignore[no-untyped-def]
    """Nodes in ``shut`` are not refined: nothing below them is, as far as this treelet goes.

    Returns the new length of ``closed``.
    """
    while shutting:
        shutting -= 1
        node = shut[shutting]
        if is_set(refined, node) and (node != root or root == 0):
            clear_bit(refined, node)
            closed[n_closed] = node
            n_closed += 1
        if is_set(roots, node) and node != root:
            continue
        first, count = ints[node, FIRST_CHILD], ints[node, CHILD_COUNT]
        for child in range(first, first + count):
            if is_set(refined, child):
                shut[shutting] = child
                shutting += 1
    return n_closed


@njit(cache=True, error_model="numpy", nogil=True)
def search_treelets(  # type: ignore[no-untyped-def]
    cx, cy, cz, k, grow, floats, ints, roots, refined, bearing, treelets, balls, keep
):
    """Re-test treelets until nothing changes; ``refined`` and ``bearing`` are brought up to date.

    ``treelets`` are the bearing ones, ``balls`` [.., 4] float64 the camera at which each was
    tested and how far it may come before that must be done again; with ``keep`` those are left
    out that are still valid. Returns both lists anew, events (in no order), nodes tested.
    """
    # room for the worst case; memory is taken by what is written
    nodes = len(ints)
    opened, closed = np.empty(nodes, np.int32), np.empty(nodes, np.int32)
    stack, shut = np.empty(nodes, np.int32), np.empty(nodes, np.int32)
    queue = np.empty(2 * nodes, np.int32)  # a treelet is asked for at most once from each side
    borne = np.empty(nodes, np.int32)
    holds = np.empty((nodes, 4), np.float64)
    n_opened = n_closed = queued = tested = kept = i = 0
    known = len(treelets)
    while i < known + queued:
        root = treelets[i] if i < known else queue[i - known]
        if keep and i < known and _is_valid(balls[i], cx, cy, cz):
            borne[kept] = root
            for column in range(4):
                holds[kept, column] = balls[i, column]
            kept += 1
            i += 1
            continue
        i += 1
        tested += 1
        was = is_set(refined, root)
        now = _decide(root, cx, cy, cz, floats, k, grow, was)
        least = _margin(root, cx, cy, cz, floats, k, grow, now)
        if ints[root, CHILD_COUNT] == 0:
            least = np.inf  # a tree of one leaf: nothing ever changes
        if now:
            if not was and root == 0:
                set_bit(refined, root)
                opened[n_opened] = root
                n_opened += 1
            bears, least, below, n_opened, queued, shutting = _test_below(
                root, cx, cy, cz, k, grow, floats, ints, roots, refined, bearing, keep,
                least, stack, opened, n_opened, queue, queued, shut,
            )  # fmt: skip
            tested += below
        else:
            bears = root == 0
            shut[0] = root
            shutting = 1
            if root > 0 and was:
                queued = _ask_for(_treelet_of(root, ints, roots), bearing, queue, queued)
        n_closed = _close(root, ints, roots, refined, shut, shutting, closed, n_closed)
        if not bears:
            clear_bit(bearing, root)
            continue
        set_bit(bearing, root)
        borne[kept] = root
        holds[kept, 0], holds[kept, 1], holds[kept, 2] = cx, cy, cz
        holds[kept, 3] = max(least, 0.0)
        kept += 1
    return (
        borne[:kept].copy(), holds[:kept].copy(),
        opened[:n_opened].copy(), closed[:n_closed].copy(), tested,
    )  # fmt: skip
