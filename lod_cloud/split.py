"""Median split: the order of the leaves from left to right, and the upper part of the tree.

Ranges of leaves are halved at the median of the longest axis of their means' box until no more
than ``group`` are left; equal coordinates are ordered by id. The shape of this upper part follows
from the number of leaves alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from gaussians.parallel import run_chunks
from lod_cloud.lod_tree import Float32, Int32

_JOINT_LEVELS = 6  # below this level there are enough ranges to split each to the end on its own
_STACK = 64  # twice the depth of any tree of 2**31 leaves


@dataclass(frozen=True)
class UpperTree:
    """The nodes above the groups, breadth-first, and the groups of neighbouring leaves below.

    Nodes of the unfinished tree are numbered: leaves 0 .. N by place in the order, then the
    interior nodes of all groups (size - 1 each, a group's root last), then the upper nodes.
    """

    bounds: Int32  # [groups + 1] group g is places bounds[g] .. bounds[g + 1]
    children: Int32  # [upper nodes, 2] unfinished-tree numbers
    level_offsets: Int32  # [levels + 1] upper nodes of each level

    @property
    def groups(self) -> int:
        return len(self.bounds) - 1

    @property
    def root(self) -> int:
        """Unfinished-tree number of the root."""
        leaves = int(self.bounds[-1])
        return 2 * leaves - 1 - len(self.children) if len(self.children) else 2 * leaves - 2


def upper_tree(count: int, group: int) -> UpperTree:
    """Shape above groups of at most ``group`` of ``count`` leaves, which no coordinate changes."""
    lows, sizes = np.zeros(1, np.int32), np.full(1, count, np.int32)
    levels: list[tuple[Int32, Int32]] = []
    ends: list[Int32] = []
    while len(lows):
        inner = sizes > group
        ends.append(lows[~inner])
        lows, sizes = lows[inner], sizes[inner]
        levels.append((lows, sizes))
        left = sizes // 2
        lows = np.stack([lows, lows + left], axis=1).reshape(-1)
        sizes = np.stack([left, sizes - left], axis=1).reshape(-1)
    bounds = np.sort(np.concatenate([*ends, [np.int32(count)]]), kind="stable").astype(np.int32)
    groups = len(bounds) - 1
    offsets = np.cumsum([0, *(len(lows) for lows, _ in levels)])
    first = 2 * count - groups  # number of upper node 0
    children = np.empty((offsets[-1], 2), np.int32)
    for level, (lows, sizes) in enumerate(levels):
        left = sizes // 2
        below = np.stack([lows, lows + left], axis=1).reshape(-1)
        sizes = np.stack([left, sizes - left], axis=1).reshape(-1)
        inner = sizes > group
        numbers = np.empty(len(below), np.int64)
        numbers[inner] = first + offsets[level + 1] + np.arange(np.count_nonzero(inner))
        numbers[~inner] = group_roots(
            bounds, np.searchsorted(bounds, below[~inner]).astype(np.int32)
        )
        children[offsets[level] : offsets[level + 1]] = numbers.reshape(-1, 2)
    return UpperTree(bounds, children, offsets[: len(levels)].astype(np.int32))


def group_roots(bounds: Int32, groups: Int32) -> Int32:
    """Unfinished-tree numbers of the roots of groups (a leaf, where a group has only one)."""
    count = bounds[-1]
    low, high = bounds[groups], bounds[groups + 1]
    return np.where(high - low == 1, low, count + high - groups - 2).astype(np.int32)


def split_order(means: Float32, group: int) -> Int32:
    """[N] ids of the points, from left to right; the order within a group is not specified, but
    the same on any number of threads.
    """
    count = len(means)
    points = np.array(means, np.float32)  # in memory, also where means are a file
    ids = np.arange(count, dtype=np.int32)
    bounds = np.array([0, count], np.int32)
    for _ in range(_JOINT_LEVELS):
        # the first chunk runs alone: an empty range
        run_chunks(
            _split_ranges, len(bounds), np.append(np.int32(0), bounds), 1, group, points, ids
        )
        low, high = bounds[:-1], bounds[1:]
        middles = (low + (high - low) // 2)[high - low > group]
        bounds = np.sort(np.concatenate([bounds, middles]))
    run_chunks(_split_ranges, len(bounds) - 1, bounds, _STACK, group, points, ids)
    return ids


@njit(cache=True, error_model="numpy", nogil=True)
def _split_ranges(begin, end, bounds, levels, group, points, ids):  # type: ignore[no-untyped-def]
    """Split each range bounds[i]..bounds[i + 1] at medians, ``levels`` levels deep."""
    stack = np.empty((_STACK, 3), np.int64)
    for piece in range(begin, end):
        stack[0, 0] = bounds[piece]
        stack[0, 1] = bounds[piece + 1]
        stack[0, 2] = levels
        depth = 1
        while depth:
            depth -= 1
            low, high, left = stack[depth, 0], stack[depth, 1], stack[depth, 2]
            if high - low <= group or left == 0:
                continue
            middle = low + (high - low) // 2
            _select(points, ids, _longest_axis(points, low, high), low, middle, high)
            stack[depth, 0], stack[depth, 1], stack[depth, 2] = low, middle, left - 1
            stack[depth + 1, 0], stack[depth + 1, 1] = middle, high
            stack[depth + 1, 2] = left - 1
            depth += 2


@njit
def _longest_axis(points, low, high):  # type: ignore[no-untyped-def]
    best = np.float32(-1.0)
    longest = 0
    for axis in range(3):
        least = points[low, axis]
        greatest = least
        for i in range(low + 1, high):
            value = points[i, axis]
            if value < least:
                least = value
            if value > greatest:
                greatest = value
        if greatest - least > best:
            best = greatest - least
            longest = axis
    return longest


@njit
def _less(value, number, pivot, pivot_number):  # type: ignore[no-untyped-def]
    return value < pivot or (value == pivot and number < pivot_number)


@njit
def _swap(points, ids, i, j):  # type: ignore[no-untyped-def]
    for axis in range(3):
        points[i, axis], points[j, axis] = points[j, axis], points[i, axis]
    ids[i], ids[j] = ids[j], ids[i]


@njit
def _select(points, ids, axis, low, middle, high):  # type: ignore[no-untyped-def]
    """Quickselect by (coordinate, id): low..middle hold the smaller ones afterwards.

    The order is total, so which ones they are does not depend on how this function works.
    """
    last = high - 1
    while low < last:
        centre = low + (last - low) // 2
        if _less(points[centre, axis], ids[centre], points[low, axis], ids[low]):
            _swap(points, ids, centre, low)
        if _less(points[last, axis], ids[last], points[low, axis], ids[low]):
            _swap(points, ids, last, low)
        if _less(points[last, axis], ids[last], points[centre, axis], ids[centre]):
            _swap(points, ids, last, centre)
        pivot, pivot_id = points[centre, axis], ids[centre]
        i, j = low, last
        while i <= j:
            while _less(points[i, axis], ids[i], pivot, pivot_id):
                i += 1
            while _less(pivot, pivot_id, points[j, axis], ids[j]):
                j -= 1
            if i <= j:
                _swap(points, ids, i, j)
                i += 1
                j -= 1
        if middle <= j:
            last = j
        elif middle >= i:
            low = i
        else:
            return
