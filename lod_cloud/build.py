"""Builds the LoD tree of a scene by the rule of HierGS (doi:10.1145/3658160).

*Structure*: the Gaussians are split at the median of the longest axis of their means' box until
one is left; equal coordinates are ordered by id. *Interior nodes*: the merge of their children
(see `lod_cloud.merge`). *Node spheres*, float64 rounded up to float32, from the node's own
3-sigma box (axis-aligned, centred at its mean) and its children's spheres:

    R = max(half diagonal of the box, max over children (R_ch + |m_ch - m|) (1 + 2^-19))
    e = max(longest side of the box,  max over children e_ch (1 + 2^-19))
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gaussians.constants import OPACITY_LIMIT
from gaussians.errors import InputError
from gaussians.parallel import run_chunks
from gaussians.scene import FIELDS, Scene
from lod_cloud.criterion import LENGTH_LIMIT_M
from lod_cloud.lod_tree import Int32, LodTree, Point, TreeMetadata
from lod_cloud.merge import merge_nodes

NEST_MARGIN = 1.0 + 2.0**-19  # exceeds the rounding of the float32 node test
_SERIAL_LEVELS = 5  # ranges of this level are split independently of each other
_STACK = 64  # twice the depth of any tree of 2**31 leaves


def build_tree(
    scene: Scene,
    *,
    up: Point = (0.0, -1.0, 0.0),
    units_per_metre: float = 1.0,
    start: Point | None = None,
    path: tuple[Point, ...] = (),
) -> LodTree:
    """LoD tree whose leaves are the scene's Gaussians; everything else is only recorded.

    The same scene gives the same bits on any number of threads. Raises InputError for an empty or
    invalid scene, for coordinates or sizes beyond 1e12 m, and where merged opacities exceed 1e6.
    """
    if len(scene) == 0:
        raise InputError("a tree needs at least one Gaussian; the scene is empty")
    scene.validate()
    largest = max(float(np.abs(scene.means).max()), float(scene.scales.max()))
    if largest > LENGTH_LIMIT_M:
        raise InputError(
            f"coordinates and scales must lie within {LENGTH_LIMIT_M:g} m, not {largest:g}"
        )
    parent, first_child, child_count, offsets, lows = _breadth_first_shape(len(scene))
    leaf_id = np.where(child_count == 0, _split_order(scene, offsets, lows)[lows], -1)
    leaf_id = leaf_id.astype(np.int32)
    gaussians = _leaves_in_place(scene, leaf_id)
    radius = np.zeros(len(parent), np.float32)
    extent = np.zeros(len(parent), np.float32)
    merge_nodes(gaussians, first_child, child_count, offsets, radius, extent, NEST_MARGIN)
    densest = gaussians.opacities.max()
    if not densest <= OPACITY_LIMIT:
        raise InputError(
            f"merged opacities must not exceed {OPACITY_LIMIT:g}, not reach {densest:g}: "
            "too many Gaussians lie on top of each other"
        )
    bounds = tuple(tuple(float(v) for v in f(scene.means, axis=0)) for f in (np.min, np.max))
    metadata = TreeMetadata(
        bounds,  # type: ignore[arg-type]  # two tuples of three by construction
        up,
        units_per_metre,
        start,
        path,
        {"split": "median of the longest axis", "merge": "opacity x surface", "margin": "2^-19"},
    )
    return LodTree(
        parent, first_child, child_count, offsets, gaussians, radius, extent, leaf_id, metadata
    )


def _breadth_first_shape(count: int) -> tuple[Int32, Int32, Int32, Int32, Int32]:
    """Shape of the median-split tree of ``count`` leaves, which no coordinate can change.

    Returns parent, first_child, child_count, level_offsets, and per node the first position of
    its range in the order of the leaves from left to right.
    """
    nodes = 2 * count - 1
    parent = np.full(nodes, -1, np.int32)
    first_child = np.full(nodes, -1, np.int32)
    child_count = np.zeros(nodes, np.int32)
    lows = np.zeros(nodes, np.int32)
    size = np.full(1, count, np.int32)
    offsets = [0, 1]
    while offsets[-1] < nodes:
        begin, end = offsets[-2:]
        inner = np.flatnonzero(size > 1).astype(np.int32)
        below = end + 2 * len(inner)
        first_child[begin + inner] = np.arange(end, below, 2, dtype=np.int32)
        child_count[begin + inner] = 2
        parent[end:below] = np.repeat(begin + inner, 2)
        left = size[inner] // 2
        lows[end:below:2] = lows[begin + inner]
        lows[end + 1 : below : 2] = lows[begin + inner] + left
        size = np.stack([left, size[inner] - left], axis=1).reshape(-1)
        offsets.append(below)
    return parent, first_child, child_count, np.array(offsets, np.int32), lows


def _split_order(scene: Scene, offsets: Int32, lows: Int32) -> Int32:
    """[count] ids of the scene's Gaussians, leaves from left to right."""
    count = len(scene)
    points = scene.means.copy()
    ids = np.arange(count, dtype=np.int32)
    top = min(_SERIAL_LEVELS, len(offsets) - 2)
    _split_ranges(0, 1, np.array([0, count], np.int32), top, points, ids)
    # where any node down to that level begins (leaves above it are ranges of one)
    bounds = np.append(np.unique(lows[: offsets[top + 1]]), np.int32(count))
    run_chunks(_split_ranges, len(bounds) - 1, bounds, _STACK, points, ids)
    return ids


def _leaves_in_place(scene: Scene, leaf_id: Int32) -> Scene:
    """Node Gaussians with the leaves filled in; interior rows are still to be written (any
    content).
    """
    arrays = (np.take(getattr(scene, f), leaf_id, axis=0, mode="clip") for f in FIELDS)
    return Scene(*arrays)


@njit(cache=True, error_model="numpy", nogil=True)
def _split_ranges(begin, end, bounds, levels, points, ids):  # type: ignore[no-untyped-def]
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
            if high - low < 2 or left == 0:
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
