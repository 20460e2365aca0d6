"""Decisions of the timing wheel: the nodes that are due, and what follows where one changes.

A node is *active* when its decision can be the next to change: a cut node can expand, a refined
node without refined child collapse. ``scheduled`` marks the nodes that have an entry in the wheel,
or are due and not settled yet; a mark that is set means that somebody else looks after the node.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lod_cloud.search.marks import any_set, clear_bit, is_set, longer, set_bit, stays_refined
from lod_cloud.search.prefetching import prefetch
from lod_cloud.search_arrays import CHILD_COUNT, FIRST_CHILD, PARENT, RECORD_COLUMNS

OPENED, CLOSED, WAITING = 0, 1, 2  # rows of ``lists``
_AHEAD, _NEAR = 24, 12  # nodes whose record, and whose neighbours' marks, are asked for in advance


@njit(forceinline=True)
def _test(node, cx, cy, cz, floats, k, grow, was):  # type: ignore[no-untyped-def]
    return stays_refined(
        cx, cy, cz, floats[node, 0], floats[node, 1], floats[node, 2],
        floats[node, 3], floats[node, 4], k, grow, was,
    )  # fmt: skip


@njit(forceinline=True)
def _is_active(node, ints, refined):  # type: ignore[no-untyped-def]
    if is_set(refined, node):
        return not any_set(refined, ints[node, FIRST_CHILD], ints[node, CHILD_COUNT])
    return ints[node, PARENT] < 0 or is_set(refined, ints[node, PARENT])


@njit(forceinline=True)
def _ask_for(due, i, floats, ints, refined, scheduled):  # type: ignore[no-untyped-def]
    """Ask for the record of a node due later, and for what is looked at about one due sooner."""
    if i + _AHEAD < len(due):
        later = np.intp(due[i + _AHEAD])
        prefetch(floats, later * RECORD_COLUMNS)
        prefetch(scheduled, later >> 3)
        prefetch(refined, later >> 3)
    if i + _NEAR < len(due):
        near = due[i + _NEAR]
        above, below = max(ints[near, PARENT], 0), ints[near, FIRST_CHILD]
        prefetch(refined, np.intp(above >> 3))
        prefetch(refined, np.intp(below >> 3))
        prefetch(scheduled, np.intp(below >> 3))
        follower = above if is_set(refined, near) else below
        prefetch(floats, np.intp(follower) * RECORD_COLUMNS)


@njit(forceinline=True)
def _append(node, which, lists, counts):  # type: ignore[no-untyped-def]
    lists[which, counts[which]] = node
    counts[which] += 1


@njit(forceinline=True)
def _schedule(node, scheduled, lists, counts):  # type: ignore[no-untyped-def]
    set_bit(scheduled, node)
    _append(node, WAITING, lists, counts)


@njit(cache=True, error_model="numpy", nogil=True)
def settle(  # type: ignore[no-untyped-def]
    due, cx, cy, cz, k, grow, floats, ints, refined, scheduled, budget, lists, counts
):
    """Test the nodes that are due and everything that follows from those that change.

    Writes expanded, collapsed (in no order) and nodes to insert to ``lists`` [3, nodes], their
    numbers to ``counts``; returns the number of nodes tested. Stops, with nothing in order but the
    two lists of events, once more than ``budget`` nodes have been tested.
    """
    counts[:] = 0
    tested = 0
    for i in range(len(due)):
        _ask_for(due, i, floats, ints, refined, scheduled)
        node = due[i]
        clear_bit(scheduled, node)
        if not _is_active(node, ints, refined):
            continue
        tested += 1
        was = is_set(refined, node)
        if _test(node, cx, cy, cz, floats, k, grow, was) == was:
            _schedule(node, scheduled, lists, counts)
            continue
        if tested > budget:
            break
        if was:
            tested += _collapse(
                node, cx, cy, cz, k, grow, floats, ints, refined, scheduled, lists, counts
            )
        else:
            tested += _expand(
                node, cx, cy, cz, k, grow, floats, ints, refined, scheduled, budget - tested,
                lists, counts,
            )  # fmt: skip
    return tested


@njit(forceinline=True)
def _collapse(node, cx, cy, cz, k, grow, floats, ints, refined, scheduled, lists, counts):  # type: ignore[no-untyped-def]
    """Collapse a node, and upwards as far as it goes; nodes tested."""
    tested = 0
    while True:
        clear_bit(refined, node)
        _append(node, CLOSED, lists, counts)
        _schedule(node, scheduled, lists, counts)
        node = ints[node, PARENT]
        if node < 0 or is_set(scheduled, node) or any_set(
            refined, ints[node, FIRST_CHILD], ints[node, CHILD_COUNT]
        ):  # fmt: skip
            return tested
        tested += 1
        if _test(node, cx, cy, cz, floats, k, grow, True):
            _schedule(node, scheduled, lists, counts)
            return tested


@njit(forceinline=True)
def _expand(  # type: ignore[no-untyped-def]
    node, cx, cy, cz, k, grow, floats, ints, refined, scheduled, budget, lists, counts
):
    """Expand a node, and downwards as far as it goes or until more than ``budget`` nodes have been
    tested; nodes tested.
    """
    tested = 0
    at = counts[OPENED]  # nodes from here on were opened, and their children not looked at
    set_bit(refined, node)
    _append(node, OPENED, lists, counts)
    while at < counts[OPENED] and tested <= budget:
        node = lists[OPENED, at]
        at += 1
        first, count = ints[node, FIRST_CHILD], ints[node, CHILD_COUNT]
        any_refined = False
        for child in range(first, first + count):
            if ints[child, CHILD_COUNT] == 0 or is_set(scheduled, child):
                continue
            tested += 1
            if _test(child, cx, cy, cz, floats, k, grow, False):
                any_refined = True
                set_bit(refined, child)
                _append(child, OPENED, lists, counts)
            else:
                _schedule(child, scheduled, lists, counts)
        if not any_refined:
            _schedule(node, scheduled, lists, counts)
    return tested


@njit(cache=True, error_model="numpy", nogil=True)
def active_nodes(begin, most, first_child, child_count, refined, scheduled):  # type: ignore[no-untyped-def]
    """Active nodes without entry among refined nodes, from node ``begin`` on, and
    their children, until ``most`` were found; and where to go on. Marks them as scheduled.
    """
    waiting = np.empty(1024, np.int32)
    made = 0
    node = begin
    nodes = len(child_count)
    if not is_set(refined, 0):
        node = nodes
        if child_count[0] and not is_set(scheduled, 0):
            set_bit(scheduled, 0)
            waiting[made] = 0
            made = 1
    while node < nodes and made < most:
        if node & 7 == 0 and refined[node >> 3] == 0:
            node += 8
            continue
        if is_set(refined, node):
            any_refined = False
            first, count = first_child[node], child_count[node]
            if made + count + 1 > len(waiting):
                waiting = longer(waiting, count + 1)
            for child in range(first, first + count):
                if is_set(refined, child):
                    any_refined = True
                elif child_count[child] and not is_set(scheduled, child):
                    set_bit(scheduled, child)
                    waiting[made] = child
                    made += 1
            if not any_refined and not is_set(scheduled, node):
                set_bit(scheduled, node)
                waiting[made] = node
                made += 1
        node += 1
    return waiting[:made], min(node, nodes)


@njit(cache=True, error_model="numpy", nogil=True)
def active_among(nodes, ints, refined, scheduled):  # type: ignore[no-untyped-def]
    """Those of the nodes, of their parents and of their children that are active and have no
    entry. Marks them as scheduled.
    """
    waiting = np.empty(1024, np.int32)
    made = 0
    for node in nodes:
        first, count = ints[node, FIRST_CHILD], ints[node, CHILD_COUNT]
        if made + count + 2 > len(waiting):
            waiting = longer(waiting, count + 2)
        for i in range(-2, count):
            near = first + i
            if i < 0:
                near = node if i == -1 else ints[node, PARENT]
            if (
                near >= 0
                and ints[near, CHILD_COUNT]
                and not is_set(scheduled, near)
                and _is_active(near, ints, refined)
            ):
                set_bit(scheduled, near)
                waiting[made] = near
                made += 1
    return waiting[:made]


@njit(cache=True, error_model="numpy", nogil=True)
def set_marks(nodes, marks, value):  # type: ignore[no-untyped-def]
    """Set (or clear) the marks of nodes."""
    for node in nodes:
        if value:
            set_bit(marks, node)
        else:
            clear_bit(marks, node)
