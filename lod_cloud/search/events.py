"""Refined sets compared, and turned into cuts."""

from __future__ import annotations

import numpy as np
from numba import njit

from lod_cloud.lod_tree import Int32
from lod_cloud.search.marks import is_set
from lod_cloud.search.search_tree import Marks, SearchTree


def nodes_that_differ(marks: Marks, before: Marks) -> tuple[Int32, Int32]:
    """Nodes marked now and not before, and before and not now, both ascending."""
    return _differences(marks.view(np.uint64), before.view(np.uint64), marks, before)


def nodes_that_entered(tree: SearchTree, opened: Int32, closed: Int32) -> Int32:
    """Nodes in the cut after the events and not before: children of ``opened`` nodes that were not
    opened themselves, and ``closed`` nodes whose parent was not closed. Ascending.

    With the arguments exchanged: the nodes that left the cut.
    """
    return _entered(opened, closed, tree.parent, tree.first_child, tree.child_count)


def cut_nodes(tree: SearchTree, refined: Marks, size: int) -> Int32:
    """[size] the cut, ascending."""
    if not refined[0] & 1:
        return np.zeros(1, np.int32)
    return _cut(refined, tree.first_child, tree.child_count, size)


@njit(cache=True, error_model="numpy", nogil=True)
def _differences(words, words_before, marks, before):  # type: ignore[no-untyped-def]
    count = 0
    for w in range(len(words)):
        count += words[w] != words_before[w]
    both = np.empty((2, 64 * count), np.int32)
    more = fewer = 0
    for w in range(len(words)):
        if words[w] != words_before[w]:
            for byte in range(8 * w, 8 * w + 8):
                now, then = np.int32(marks[byte]), np.int32(before[byte])
                if now != then:
                    for bit in range(8):
                        both[0, more] = both[1, fewer] = 8 * byte + bit
                        more += ((now & ~then) >> bit) & 1
                        fewer += ((then & ~now) >> bit) & 1
    return both[0, :more].copy(), both[1, :fewer].copy()


@njit(cache=True, error_model="numpy", nogil=True)
def _cut(refined, first_child, child_count, size):  # type: ignore[no-untyped-def]
    ids = np.empty(size + 1, np.int32)  # one place for what is written and not kept
    found = 0
    for byte in range(len(refined)):
        if refined[byte] == 0:
            continue
        for node in range(8 * byte, 8 * byte + 8):
            if is_set(refined, node):
                first = first_child[node]
                for child in range(first, first + child_count[node]):
                    ids[found] = child
                    found += not is_set(refined, child)
    return ids[:size]


@njit(cache=True, error_model="numpy", nogil=True)
def _entered(opened, closed, parent, first_child, child_count):  # type: ignore[no-untyped-def]
    most = len(closed)
    for node in opened:
        most += child_count[node]
    ids = np.empty(most + 1, np.int32)
    found = child = last = at = above = opener = 0
    # two ascending lists are merged: the children of opened nodes, and closed nodes
    while opener < len(opened) or at < len(closed):
        candidate = -1
        if opener < len(opened):
            candidate = first_child[opened[opener]] + child
        if at < len(closed) and (candidate < 0 or closed[at] < candidate):
            node = closed[at]
            at += 1
            while above < len(closed) and closed[above] < parent[node]:
                above += 1
            ids[found] = node
            found += not (above < len(closed) and closed[above] == parent[node])
            continue
        child += 1
        if child == child_count[opened[opener]]:
            opener += 1
            child = 0
        while last < len(opened) and opened[last] < candidate:
            last += 1
        ids[found] = candidate
        found += not (last < len(opened) and opened[last] == candidate)
    return ids[:found].copy()
