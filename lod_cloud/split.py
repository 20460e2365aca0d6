"""Median split: the order of the leaves from left to right.

Ranges of leaves are halved at the median of the longest axis of their means' box until no more
than ``group`` are left; equal coordinates are ordered by id. Where the bounds are follows from
the number of leaves alone.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gaussians.parallel import run_chunks
from lod_cloud.lod_tree import Float32, Int32

_FILLED_ROWS = 1 << 16
_MOST_SAMPLES = 63
_JOINT_LEVELS = 6  # below this level there are enough ranges to split each to the end on its own
# Places in a point: x, y, z, id. Unsigned: signed indices may count from the end, and are slow.
_WIDTH, _Y, _Z, _NUMBER = (np.uint64(place) for place in (4, 1, 2, 3))
_HALVES, _SECOND = np.uint64(2), np.uint64(1)  # the same, as int64
STACK = 96  # three times the depth of any tree of 2**31 leaves


def halved(count: int, most: int) -> Int32:
    """[ranges + 1] bounds of 0..count halved until no range has more than ``most``."""
    bounds = np.array([0, count], np.int32)
    while (wide := np.diff(bounds) > most).any():
        low, high = bounds[:-1][wide], bounds[1:][wide]
        bounds = np.sort(np.concatenate([bounds, low + (high - low) // 2]))
    return bounds


def split_order(means: Float32, group: int) -> Int32:
    """[N] ids of the points, from left to right; the order within a group is not specified, but
    the same on any number of threads.
    """
    count = len(means)
    points = np.empty(4 * count, np.int32)
    run_chunks(_fill, count, means, points.reshape(count, 4))
    bounds = np.array([0, count], np.int32)
    for _ in range(_JOINT_LEVELS):
        # the first chunk runs alone: an empty range
        run_chunks(_split_ranges, len(bounds), np.append(np.int32(0), bounds), 1, group, points)
        low, high = bounds[:-1], bounds[1:]
        middles = (low + (high - low) // 2)[high - low > group]
        bounds = np.sort(np.concatenate([bounds, middles]))
    run_chunks(_split_ranges, len(bounds) - 1, bounds, STACK, group, points)
    return points[3::4].copy()


def _fill(begin: int, end: int, means: Float32, points: Int32) -> None:
    """x, y, z as integers of the same order, and the id: 16 bytes that move together."""
    for low in range(begin, end, _FILLED_ROWS):
        high = min(low + _FILLED_ROWS, end)
        bits = (means[low:high] + np.float32(0.0)).view(np.int32)  # -0 becomes 0
        points[low:high, :3] = bits ^ ((bits >> 31) & np.int32(0x7FFFFFFF))
        points[low:high, 3] = np.arange(low, high, dtype=np.int32)


@njit(cache=True, error_model="numpy", nogil=True)
def _split_ranges(begin, end, bounds, levels, group, points):  # type: ignore[no-untyped-def]
    """Split each range bounds[i]..bounds[i + 1] at medians, ``levels`` levels deep."""
    stack = np.empty((STACK, 3), np.int64)
    sample = np.empty(_MOST_SAMPLES, np.int64)
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
            axis = _longest_axis(points, low, high)
            _select(points, axis, low, middle, high, sample)
            stack[depth, 0], stack[depth, 1], stack[depth, 2] = low, middle, left - 1
            stack[depth + 1, 0], stack[depth + 1, 1] = middle, high
            stack[depth + 1, 2] = left - 1
            depth += 2


@njit
def _longest_axis(points, low, high):  # type: ignore[no-untyped-def]
    at = np.uint64(low) * _WIDTH
    x0 = x1 = points[at]
    y0 = y1 = points[at + _Y]
    z0 = z1 = points[at + _Z]
    for i in range(np.uint64(low), np.uint64(high)):
        at = i * _WIDTH
        x, y, z = points[at], points[at + _Y], points[at + _Z]
        x0, x1 = min(x0, x), max(x1, x)
        y0, y1 = min(y0, y), max(y1, y)
        z0, z1 = min(z0, z), max(z1, z)
    dx, dy, dz = _length(x0, x1), _length(y0, y1), _length(z0, z1)
    if dx >= dy and dx >= dz:
        return 0
    return 1 if dy >= dz else 2


@njit
def _length(least, greatest):  # type: ignore[no-untyped-def]
    return _coordinate(greatest) - _coordinate(least)


@njit
def _coordinate(key):  # type: ignore[no-untyped-def]
    bits = key ^ ((key >> np.int32(31)) & np.int32(0x7FFFFFFF))
    return np.int32(bits).view(np.float32)


@njit
def _select(points, axis, low, middle, high, sample):  # type: ignore[no-untyped-def]
    """Quickselect by (coordinate, id): low..middle hold the smaller ones afterwards.

    The order is total, so which ones they are does not depend on how this function works. Both
    sides of a pivot are written without a branch, which nobody could predict.
    """
    halves = points.view(np.int64)  # two move a point
    while low < middle < high:
        pivot = _pivot(points, axis, low, middle, high, sample)
        free = np.uint64(low)
        for i in range(np.uint64(low), np.uint64(high)):
            here, there = i * _HALVES, free * _HALVES
            first, second = halves[here], halves[here + _SECOND]
            is_smaller = _key(points, i, axis) < pivot
            halves[here], halves[here + _SECOND] = halves[there], halves[there + _SECOND]
            halves[there], halves[there + _SECOND] = first, second
            free += np.uint64(is_smaller)
        place = np.int64(free)
        if middle <= place:
            high = place
        else:
            low = place


@njit
def _pivot(points, axis, low, middle, high, sample):  # type: ignore[no-untyped-def]
    """A key of low..high that as many are smaller than, about, as before ``middle``; not the
    smallest one, which would leave all on one side.
    """
    count = high - low
    size = min(count, 3 if count < 200 else 15 if count < 10_000 else _MOST_SAMPLES)
    for taken in range(size):
        key = _key(points, np.uint64(low + taken * count // size), axis)
        place = taken
        while place > 0 and sample[place - 1] > key:
            sample[place] = sample[place - 1]
            place -= 1
        sample[place] = key
    return sample[min(max((middle - low) * size // count, 1), size - 1)]


@njit(forceinline=True)
def _key(points, i, axis):  # type: ignore[no-untyped-def]
    at = i * _WIDTH
    return (np.int64(points[at + np.uint64(axis)]) << 32) | np.int64(points[at + _NUMBER])
