"""Merges leaves into the interior nodes of a tree: Gaussians without harmonics, node spheres.

Children i with opacity o_i, means m_i, covariances C_i, surfaces S = s0 s1 + s0 s2 + s1 s2:

    w_i = o_i S_i            W = sum w_i
    m   = sum w_i m_i / W    C = sum w_i (C_i + (m_i - m)(m_i - m)^T) / W
    o   = W / S(C)           (may exceed 1; kept)

so the mass o S of a node is that of its leaves. Where W = 0 (transparent children, or points and
lines, which have no surface) all children weigh the same and o is the mean of their opacities;
where only S(C) = 0, o is their weighted mean. Everything is float64 from the leaves to the root,
rounded once per stored number; spheres start from the children's float32 values.

*What merges with what.* Ranges of leaves are halved (`lod_cloud.split`) down to groups of at most
``pair_within``. Within a group the cheapest pair merges first (`lod_cloud.pairing`), until half of
``pair_within`` are left; they join those of the range's other half, and so on up to the root,
where one is left. So there are always ``pair_within`` neighbours to choose from, whatever the
level, and no border of a group forces unlike ones together (docs/lod_tree.md has what that is
worth). Each half keeps a single node, as in HierGS, with a ``pair_within`` of 1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.constants import OPACITY_LIMIT
from gaussians.errors import InputError
from gaussians.lanes import prefetch
from gaussians.parallel import run_chunks
from gaussians.scene import Scene
from lod_cloud.lod_tree import Int32
from lod_cloud.moments import (
    LANES,
    NEST_MARGIN,
    ROWS,
    around_at,
    box,
    covariance_of,
    find_axes,
    rounded_up,
    store_axes,
    surface_of,
)
from lod_cloud.nodes import COLUMNS, OPACITY, QUATERNION, SCALES, SPHERE, Nodes
from lod_cloud.pairing import (
    BLUE,
    COSTS_ROW,
    EXTENT,
    GREEN,
    MASS,
    MEAN_OPACITY,
    MOMENTS,
    MOST_SLOTS,
    RADIUS,
    RED,
    XX,
    XY,
    XZ,
    YY,
    YZ,
    ZZ,
    X,
    Y,
    Z,
    cheapest,
    combine,
    find_partners,
    judge,
    replace,
    restore,
    set_aside,
)
from lod_cloud.search_arrays import aligned
from lod_cloud.split import STACK, halved

_PIECE = 4096  # leaves, at most, that are merged on their own first, while they are in cache
_AHEAD = 24  # leaves that are on their way from memory
_COLOUR = 13  # first column of a leaf's harmonics


class _Kept(NamedTuple):
    """What is left of ranges of leaves: nodes without parents, see `lod_cloud.pairing`."""

    numbers: NDArray[np.int64]  # [ranges, 1 + keep + keep * keep] how many, nodes, costs
    moments: NDArray[np.float64]  # [ranges, keep * MOMENTS]

    @classmethod
    def empty(cls, ranges: int, keep: int) -> _Kept:
        return cls(
            np.zeros((ranges, 1 + keep + keep * keep), np.int64),
            np.empty((ranges, keep * MOMENTS)),
        )


def merge_leaves(
    scene: Scene,
    ids: Int32,
    pair_within: int,
    margin: float = NEST_MARGIN,
    was_read: Callable[[int], None] = lambda leaves: None,
) -> tuple[Nodes, Int32]:
    """All nodes over the leaves ``ids`` (left to right), and the children [N - 1, 2] of the
    interior ones.

    ``margin`` is the factor by which a node's R and e exceed its children's; ``was_read`` is
    told how many more leaves of the scene were read. Raises InputError where merged opacities
    exceed 1e6.
    """
    count, keep = len(ids), max(1, pair_within // 2)
    rows = aligned(count - 1, COLUMNS)
    children = np.empty((count - 1, 2), np.int32)
    size = max(_PIECE, pair_within)
    bounds = halved(count, size)
    pieces = len(bounds) - 1
    nothing, kept, root = (_Kept.empty(ranges, keep) for ranges in (0, pieces, 1))
    first = (count + bounds - keep * np.arange(pieces + 1)).astype(np.int32)
    source = scene.means, scene.quaternions, scene.scales, scene.opacities, scene.sh

    def merge(begin: int, end: int) -> float:
        densest, taken = 0.0, aligned(size, COLUMNS)
        for piece in range(begin, end):
            _take(bounds[piece], bounds[piece + 1], ids, *source, taken)
            was_read(int(bounds[piece + 1] - bounds[piece]))
            rule = bounds[piece : piece + 2], first[piece:], pair_within, keep, margin
            out = _Kept(kept.numbers[piece:], kept.moments[piece:])
            densest = max(densest, _merge(rule, taken, nothing, out, rows, children))
        return densest

    densest = max(run_chunks(merge, pieces))
    first = np.array([2 * count - kept.numbers[:, 0].sum()], np.int32)
    whole = np.array([0, count], np.int32)
    rule = whole, first, size, 1, margin
    densest = max(densest, _merge(rule, rows[:0], kept, root, rows, children))
    if densest > OPACITY_LIMIT:
        raise InputError(
            f"merged opacities must not exceed {OPACITY_LIMIT:g}, not reach {densest:g}: "
            "too many Gaussians lie on top of each other"
        )
    return Nodes(rows, ids, scene), children


@njit(cache=True, error_model="numpy", nogil=True)
def _take(low, high, ids, means, quaternions, scales, opacities, sh, rows):  # type: ignore[no-untyped-def]
    """Leaves low..high, to rows of their own, with their harmonics of degree 0 at the end."""
    width = sh.shape[1] * 3
    for place in range(low, high):
        ahead = np.int64(ids[min(place + _AHEAD, high - 1)])
        prefetch(means, ahead * 3)
        prefetch(quaternions, ahead * 4)
        prefetch(scales, ahead * 3)
        prefetch(opacities, ahead)
        prefetch(sh, ahead * width)
        leaf, row = ids[place], place - low
        for axis in range(3):
            rows[row, axis] = means[leaf, axis]
            rows[row, SCALES + axis] = scales[leaf, axis]
            rows[row, _COLOUR + axis] = sh[leaf, 0, axis]
        for k in range(4):
            rows[row, QUATERNION + k] = quaternions[leaf, k]
        rows[row, OPACITY] = opacities[leaf]


@njit(cache=True, error_model="numpy", nogil=True)
def _merge(rule, leaf_rows, below, out, rows, children):  # type: ignore[no-untyped-def]
    """Merge the leaves bounds[r]..bounds[r + 1] of every range r until ``leave`` are left; its new
    nodes are numbered from first[r]. Returns the largest opacity of one.

    Ranges of at most ``least`` leaves are what was kept ``below``; with nothing there, leaves,
    and ``leaf_rows`` are those of the first range.
    """
    # arrays on their own: taken from a tuple again and again, they are counted every time
    bounds, first, least, leave, margin = rule
    below_numbers, below_moments = below
    out_numbers, out_moments = out
    keep = out_moments.shape[1] // MOMENTS
    leaves = len(children) + 1
    held_numbers = np.empty((STACK, out_numbers.shape[1]), np.int64)
    held_moments = np.empty((STACK, out_moments.shape[1]))
    numbers = np.empty(MOST_SLOTS, np.int64)  # of the nodes in slots
    moments = np.zeros((MOMENTS + 1) * MOST_SLOTS)
    costs = np.empty(MOST_SLOTS * np.int64(COSTS_ROW), np.int64)
    partners = np.empty(MOST_SLOTS, np.int64)
    lanes, jobs = np.zeros(ROWS * LANES), np.empty(LANES, np.int64)
    masses = np.empty((2, LANES))
    waiting, densest = 0, np.float32(0.0)
    todo = np.empty((STACK, 3), np.int64)  # range of leaves, are both its halves held?
    for piece in range(len(bounds) - 1):
        todo[0, 0], todo[0, 1], todo[0, 2] = bounds[piece], bounds[piece + 1], 0
        depth, top, taken, new = 1, 0, 0, np.int64(first[piece])
        while depth:
            depth -= 1
            low, high, joins = todo[depth, 0], todo[depth, 1], todo[depth, 2]
            middle = low + (high - low) // 2
            if high - low > least and not joins:
                todo[depth, 2] = 1
                todo[depth + 1, 0], todo[depth + 1, 1], todo[depth + 1, 2] = middle, high, 0
                todo[depth + 2, 0], todo[depth + 2, 1], todo[depth + 2, 2] = low, middle, 0
                depth += 3
                continue
            count = half = 0
            if joins:
                top -= 2
                for part in range(2):
                    half = count
                    count = restore(
                        held_numbers, held_moments, top + part, count, numbers, moments, costs
                    )
            elif len(below_numbers):
                count = restore(below_numbers, below_moments, taken, 0, numbers, moments, costs)
                taken += 1
            else:
                half = count = high - low
                _enter(low, count, leaf_rows, low - bounds[0], numbers, moments)
            for slot in range(half):  # leaves with all, else the one half with the other
                judge(slot, half if joins else slot + 1, count, moments, costs)
            find_partners(count, costs, partners)
            target = leave if depth == 0 else keep
            while count > target:
                a, b = cheapest(count, partners)
                left, right = numbers[a], numbers[b]
                children[new - leaves, 0], children[new - leaves, 1] = left, right
                spheres = _sphere(a, moments), _sphere(b, moments)
                combine(a, b, moments)
                numbers[a], numbers[b] = new, numbers[count - 1]
                _wrap(new - leaves, a, spheres, moments, rows, margin)
                _queue(new - leaves, a, moments, lanes, waiting, jobs, masses)
                waiting += 1
                if waiting == LANES:
                    densest = max(densest, _store(waiting, lanes, jobs, masses, rows))
                    waiting = 0
                replace(a, b, count, moments, costs, partners)
                new += 1
                count -= 1
            if depth:
                set_aside(count, numbers, moments, costs, held_numbers, held_moments, top)
                top += 1
            else:
                set_aside(count, numbers, moments, costs, out_numbers, out_moments, piece)
    return max(densest, _store(waiting, lanes, jobs, masses, rows))


@njit(forceinline=True)  # called, it passes on 40 numbers that describe its arrays
def _enter(low, count, rows, first, numbers, moments):  # type: ignore[no-untyped-def]
    """Leaves low..low + count, which are the rows from ``first`` on, to slots."""
    for i in range(np.uint64(count)):
        node = np.uint64(first) + i
        numbers[i] = low + np.int64(i)
        w, x = np.float64(rows[node, QUATERNION]), np.float64(rows[node, QUATERNION + 1])
        y, z = np.float64(rows[node, QUATERNION + 2]), np.float64(rows[node, QUATERNION + 3])
        s0, s1 = np.float64(rows[node, SCALES]), np.float64(rows[node, SCALES + 1])
        s2 = np.float64(rows[node, SCALES + 2])
        xx, xy, xz, yy, yz, zz = covariance_of(w, x, y, z, s0, s1, s2)
        moments[i + XX], moments[i + XY], moments[i + XZ] = xx, xy, xz
        moments[i + YY], moments[i + YZ], moments[i + ZZ] = yy, yz, zz
        moments[i + X], moments[i + Y], moments[i + Z] = rows[node, 0], rows[node, 1], rows[node, 2]
        moments[i + RED], moments[i + GREEN] = rows[node, _COLOUR], rows[node, _COLOUR + 1]
        moments[i + BLUE] = rows[node, _COLOUR + 2]
        moments[i + MEAN_OPACITY] = rows[node, OPACITY]
        moments[i + MASS] = moments[i + MEAN_OPACITY] * surface_of(s0, s1, s2)
        half, side = box(xx, yy, zz)
        moments[i + RADIUS], moments[i + EXTENT] = rounded_up(half), rounded_up(side)


@njit
def _diagonal(slot, moments):  # type: ignore[no-untyped-def]
    """Of the covariance."""
    i = np.uint64(slot)
    return moments[i + XX], moments[i + YY], moments[i + ZZ]


@njit
def _sphere(slot, moments):  # type: ignore[no-untyped-def]
    """Mean as it is stored, R and e."""
    i = np.uint64(slot)
    x, y, z = np.float32(moments[i + X]), np.float32(moments[i + Y]), np.float32(moments[i + Z])
    return np.float64(x), np.float64(y), np.float64(z), moments[i + RADIUS], moments[i + EXTENT]


@njit
def _wrap(row, slot, spheres, moments, rows, margin):  # type: ignore[no-untyped-def]
    """Mean, R and e of a node: around its own box and its children's spheres."""
    i = np.uint64(slot)
    x, y, z, _, _ = _sphere(slot, moments)
    half, side = box(*_diagonal(slot, moments))
    for child in spheres:
        dx, dy, dz = child[0] - x, child[1] - y, child[2] - z
        reach, length = around_at(child[3], child[4], dx, dy, dz, margin)
        half, side = max(half, reach), max(side, length)
    rows[row, 0], rows[row, 1], rows[row, 2] = np.float32(x), np.float32(y), np.float32(z)
    rows[row, SPHERE], rows[row, SPHERE + 1] = rounded_up(half), rounded_up(side)
    moments[i + RADIUS], moments[i + EXTENT] = rows[row, SPHERE], rows[row, SPHERE + 1]


@njit
def _queue(row, slot, moments, lanes, lane, jobs, masses):  # type: ignore[no-untyped-def]
    """Leave the axes of a node for `_store`, many at a time."""
    jobs[lane] = row
    for k in range(6):
        lanes[k * LANES + lane] = moments[k * MOST_SLOTS + slot]
    masses[0, lane] = moments[np.uint64(slot) + MASS]
    masses[1, lane] = moments[np.uint64(slot) + MEAN_OPACITY]


@njit
def _store(count, lanes, jobs, masses, rows):  # type: ignore[no-untyped-def]
    """Rotations, scales and opacities of the nodes that wait; returns the largest opacity."""
    quaternions, scales = rows[:, QUATERNION:SCALES], rows[:, SCALES:OPACITY]
    find_axes(lanes, count)
    densest = np.float32(0.0)
    for lane in range(count):
        row, mass = jobs[lane], masses[0, lane]
        area = store_axes(lanes, lane, row, quaternions, scales)
        kept = mass > 0.0 and area > 0.0
        opacity = np.float32(mass / area if kept else masses[1, lane])
        rows[row, OPACITY] = opacity
        densest = max(densest, opacity)
    return densest
