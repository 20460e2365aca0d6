"""Decisions of the timing wheel: the nodes that are due, and what follows where one changes.

A node is *active* when its decision can be the next to change: a cut node can expand, a refined
node without refined child collapse. ``scheduled`` marks the nodes that have an entry in the wheel,
or are due and not settled yet; a mark that is set means that somebody else looks after the node.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gaussians.lanes import prefetch
from lod_cloud.search.marks import any_set, clear_bit, is_set, set_bit, stays_refined
from lod_cloud.search.prefetching import BATCH, gather
from lod_cloud.search.wheel_buckets import ENTRIES, chunks_for, find_keys, put
from lod_cloud.search_arrays import CHILD_COUNT, FIRST_CHILD, PARENT, RECORD_COLUMNS

OPENED, CLOSED, WAITING = 0, 1, 2  # rows of ``lists``
_ROOT, _ONE_NODE = np.int32(0), np.int32(1)
_NEAR = 12  # nodes whose neighbours' marks are asked for in advance


@njit(forceinline=True)
def _is_active(node, is_refined, ints, refined):  # type: ignore[no-untyped-def]
    """Whether no child of a refined node is refined, or the parent of another one is (the root has
    none). Without branches: what comes next in a list is hard to predict.
    """
    above = ints[node, PARENT]
    first = ints[node, FIRST_CHILD] if is_refined else max(above, _ROOT)
    count = ints[node, CHILD_COUNT] if is_refined else _ONE_NODE
    if count > 8:
        return not any_set(refined, first, count)
    at = np.intp(first >> 3)
    marks = np.int64(refined[at]) | np.int64(refined[min(at + 1, len(refined) - 1)]) << 8
    found = (marks >> (first & 7)) & ((1 << count) - 1)
    return ((found != 0) != is_refined) | ((above < 0) & (not is_refined))


@njit(forceinline=True)
def _compare(held, cx, cy, cz, k, grow, rows, was, changed):  # type: ignore[no-untyped-def]
    """Which nodes of a batch decide otherwise than before."""
    for i in range(held):
        now = stays_refined(
            cx, cy, cz, rows[0, i], rows[1, i], rows[2, i], rows[3, i], rows[4, i], k, grow, was[i]
        )  # fmt: skip
        changed[i] = now != was[i]


@njit(forceinline=True)
def _sift(nodes, was, changed, ints, refined, others, places, keys):  # type: ignore[no-untyped-def]
    """Move the nodes of a batch that stay as they are, and their keys, to its front; those that
    change or are not active to ``others``, and where in the batch they stood to ``places``. How
    many there are of the latter.
    """
    margins, ways, sectors = keys
    for i in range(len(nodes)):
        node = nodes[i]
        near = ints[node, FIRST_CHILD] if was[i] else max(ints[node, PARENT], _ROOT)
        prefetch(refined, np.intp(near >> 3))
    stayed = found = 0
    for i in range(len(nodes)):
        node = nodes[i]
        stays = _is_active(node, was[i], ints, refined) & (not changed[i])
        others[found], places[found] = node, i
        found += np.int64(not stays)
        nodes[stayed], margins[stayed] = node, margins[i]
        ways[stayed], sectors[stayed] = ways[i], sectors[i]
        stayed += np.int64(stays)
    return found


@njit(forceinline=True)
def _ask_for_neighbours(node, was, ints, scheduled):  # type: ignore[no-untyped-def]
    """Ask for what is looked at when a node changes its decision."""
    first = max(ints[node, PARENT], _ROOT) if was else ints[node, FIRST_CHILD]
    last = first if was else first + ints[node, CHILD_COUNT] - 1
    prefetch(scheduled, np.intp(node >> 3))
    prefetch(scheduled, np.intp(first >> 3))
    prefetch(ints, np.intp(first) * RECORD_COLUMNS)
    prefetch(ints, np.intp(last) * RECORD_COLUMNS)


@njit(forceinline=True)
def _append(node, which, lists, counts):  # type: ignore[no-untyped-def]
    lists[which, counts[which]] = node
    counts[which] += 1


@njit(forceinline=True)
def _collapse(node, ints, refined, scheduled, lists, counts, queue, tail):  # type: ignore[no-untyped-def]
    """Collapse a node; its parent may be due then. The end of the queue."""
    clear_bit(refined, node)
    _append(node, CLOSED, lists, counts)
    _append(node, WAITING, lists, counts)
    above = ints[node, PARENT]
    if above >= 0 and not is_set(scheduled, above) and _is_active(above, True, ints, refined):
        set_bit(scheduled, above)
        queue[tail] = above
        tail += 1
    return tail


@njit(forceinline=True)
def _expand(node, ints, refined, scheduled, lists, counts, queue, tail):  # type: ignore[no-untyped-def]
    """Expand a node; its children are due then. The end of the queue."""
    set_bit(refined, node)
    clear_bit(scheduled, node)
    _append(node, OPENED, lists, counts)
    first = ints[node, FIRST_CHILD]
    for child in range(first, first + ints[node, CHILD_COUNT]):
        if ints[child, CHILD_COUNT] and not is_set(scheduled, child):
            set_bit(scheduled, child)
            queue[tail] = child
            tail += 1
    return tail


@njit(cache=True, error_model="numpy", nogil=True)
def settle(  # type: ignore[no-untyped-def]
    queue, due, cx, cy, cz, k, grow, floats, ints, refined, scheduled, budget, lists, events,
    hands, rates, heads, counts, chunks,
):  # fmt: skip
    """Test the first ``due`` nodes of a queue and everything that follows from those that change.

    Nodes that stay as they are get new entries as long as there are chunks. Writes expanded,
    collapsed (in no order) and other nodes to insert to ``lists`` [3, nodes], their numbers to
    ``events``; returns the number of nodes tested. Stops, with nothing in order but the two lists
    of events, once more than ``budget`` nodes have been tested.

    In batches. Nobody else changes the decision of a node that is due, so all of a batch are
    tested at once; whether they are active may change while others of the batch are looked at.
    What becomes due is put at the end of the queue, which has room for 2 N: no node twice, but
    for those that were due before and not active. The queue behind its head is overwritten.
    """
    rows = np.zeros((5, BATCH), np.float32)
    was, changed = np.zeros(BATCH, np.bool_), np.zeros(BATCH, np.bool_)
    others, places = np.empty(BATCH, np.int32), np.empty(BATCH, np.intp)
    margins, ways = np.empty(BATCH, np.float32), np.empty(BATCH, np.float32)
    sectors, buckets = np.empty(BATCH, np.int32), np.empty(BATCH, np.intp)
    keys = margins, ways, sectors
    head, tail = 0, due
    events[:] = 0
    tested = 0
    while head < tail and tested <= budget:
        held = gather(queue, head, tail, floats, refined, rows, was)
        batch = queue[head : head + held]
        head += held
        _compare(held, cx, cy, cz, k, grow, rows, was, changed)
        find_keys(held, cx, cy, cz, k, grow, rows, was, margins, ways, sectors)
        found = _sift(batch, was, changed, ints, refined, others, places, keys)
        stay = batch[: held - found]
        tested += len(stay)
        if chunks_for(counts[ENTRIES] + held) <= len(chunks):
            put(stay, keys, buckets, hands, rates, heads, counts, chunks)
        else:
            lists[WAITING, events[WAITING] : events[WAITING] + len(stay)] = stay
            events[WAITING] += len(stay)
        for i in range(found):
            place, later = places[i], min(i + _NEAR, found - 1)
            _ask_for_neighbours(others[later], was[places[later]], ints, scheduled)
            node = others[i]
            if not _is_active(node, was[place], ints, refined):
                clear_bit(scheduled, node)
                continue
            tested += 1
            if tested > budget:
                break
            if not changed[place]:
                _append(node, WAITING, lists, events)
            elif was[place]:
                tail = _collapse(node, ints, refined, scheduled, lists, events, queue, tail)
            else:
                tail = _expand(node, ints, refined, scheduled, lists, events, queue, tail)
    for node in lists[OPENED, : events[OPENED]]:
        if _is_active(node, True, ints, refined) and not is_set(scheduled, node):
            set_bit(scheduled, node)
            _append(node, WAITING, lists, events)
    return tested


@njit(cache=True, error_model="numpy", nogil=True)
def active_nodes(begin, end, most, first_child, child_count, refined, words, scheduled):  # type: ignore[no-untyped-def]
    """Active nodes without entry among the refined nodes ``begin``..``end``, and their children,
    until ``most`` were found; and where to go on. Marks them as scheduled.

    ``words`` are the marks ``refined``, 64 at a time.
    """
    waiting = np.empty(len(child_count), np.int32)  # memory is taken by what is written
    made = 0
    node = begin
    if not is_set(refined, 0):
        node = end = len(child_count)
        if child_count[0] and not is_set(scheduled, 0):
            set_bit(scheduled, 0)
            waiting[made] = 0
            made = 1
    while node < end and made < most:
        if node & 63 == 0 and words[node >> 6] == 0:
            node += 64
            continue
        if is_set(refined, node):
            any_refined = False
            first, count = first_child[node], child_count[node]
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
    return waiting[:made].copy(), min(node, end)


@njit(cache=True, error_model="numpy", nogil=True)
def active_among(nodes, ints, refined, scheduled):  # type: ignore[no-untyped-def]
    """Those of the nodes, of their parents and of their children that are active and have no
    entry. Marks them as scheduled.
    """
    waiting = np.empty(len(ints), np.int32)
    made = 0
    for node in nodes:
        first, count = ints[node, FIRST_CHILD], ints[node, CHILD_COUNT]
        for i in range(-2, count):
            near = first + i
            if i < 0:
                near = node if i == -1 else ints[node, PARENT]
            if (
                near >= 0
                and ints[near, CHILD_COUNT]
                and not is_set(scheduled, near)
                and _is_active(near, is_set(refined, near), ints, refined)
            ):
                set_bit(scheduled, near)
                waiting[made] = near
                made += 1
    return waiting[:made].copy()


@njit(cache=True, error_model="numpy", nogil=True)
def children_of(nodes, ints):  # type: ignore[no-untyped-def]
    """How many children nodes have together."""
    total = 0
    for node in nodes:
        total += ints[node, CHILD_COUNT]
    return total
