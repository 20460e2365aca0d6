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

from gaussians.parallel import run_chunks
from gaussians.scene import Scene
from lod_cloud.lod_tree import Float32, Int32
from lod_cloud.moments import (
    LANES,
    NEST_MARGIN,
    ROWS,
    around,
    box,
    covariance,
    find_axes,
    rounded_up,
    store_axes,
    surface,
)
from lod_cloud.pairing import (
    COSTS_ROW,
    MASS,
    MOMENTS,
    MOST_SLOTS,
    OPACITY,
    RED,
    ROW,
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
from lod_cloud.split import STACK, halved

_PIECE = 4096  # leaves, at most, that are merged on their own first
_TAKEN_PIECES = 16  # at a time
_RELEASED = 16  # such times between two releases
_NO_COLOURS = np.empty((0, 3), np.float32)


class Nodes(NamedTuple):
    """Nodes of an unfinished tree; no harmonics. Leaves come first, by their place in the order,
    children before their parents, the root last.
    """

    means: Float32  # [M, 3]
    quaternions: Float32  # [M, 4]
    scales: Float32  # [M, 3]
    opacities: Float32  # [M]
    radius: Float32  # [M] R of the node test
    extent: Float32  # [M] e of the node test

    @classmethod
    def empty(cls, count: int) -> Nodes:
        """Memory for ``count`` nodes; any content."""
        shapes = ((count, 3), (count, 4), (count, 3), count, count, count)
        return cls(*(np.empty(shape, np.float32) for shape in shapes))


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
    release: Callable[[], None] = lambda: None,
) -> tuple[Nodes, Int32]:
    """All nodes over the leaves ``ids`` (left to right), and the children [N - 1, 2] of the
    interior ones.

    ``margin`` is the factor by which a node's R and e exceed its children's; ``release`` is called
    now and then to let go of what was read of the scene.
    """
    count, keep = len(ids), max(1, pair_within // 2)
    nodes = Nodes.empty(2 * count - 1)
    children = np.empty((count - 1, 2), np.int32)
    size = max(_PIECE, pair_within)
    bounds = halved(count, size)
    pieces = len(bounds) - 1
    nothing, kept, root = (_Kept.empty(ranges, keep) for ranges in (0, pieces, 1))
    first = (count + bounds - keep * np.arange(pieces + 1)).astype(np.int32)

    def merge(begin: int, end: int) -> None:
        for turn, low in enumerate(range(begin, end, _TAKEN_PIECES)):
            if turn % _RELEASED == 0:
                release()
            high = min(low + _TAKEN_PIECES, end)
            colours = _take(scene, ids, bounds[low], bounds[high], nodes)
            rule = bounds[low : high + 1], first[low:], pair_within, keep, margin
            _merge(
                rule,
                colours,
                nothing,
                _Kept(kept.numbers[low:], kept.moments[low:]),
                nodes,
                children,
            )

    run_chunks(merge, pieces)
    release()
    first = np.array([2 * count - kept.numbers[:, 0].sum()], np.int32)
    whole = np.array([0, count], np.int32)
    _merge((whole, first, size, 1, margin), _NO_COLOURS, kept, root, nodes, children)
    return nodes, children


def _take(scene: Scene, ids: Int32, low: int, high: int, nodes: Nodes) -> Float32:
    """Leaves to their places; returns [high - low, 3] their harmonics of degree 0.

    One array after the other: that hides how far apart in memory they are.
    """
    rows = ids[low:high]
    for name in ("means", "quaternions", "scales", "opacities"):
        # mode "clip" writes to ``out`` directly; every id is within the scene
        np.take(getattr(scene, name), rows, axis=0, out=getattr(nodes, name)[low:high], mode="clip")
    return scene.sh[rows, 0]


@njit(cache=True, error_model="numpy", nogil=True)
def _merge(rule, colours, below, out, nodes, children):  # type: ignore[no-untyped-def]
    """Merge the leaves bounds[r]..bounds[r + 1] of every range r until ``leave`` are left; its new
    nodes are numbered from first[r].

    Ranges of at most ``least`` leaves are what was kept ``below``; with nothing there, leaves.
    """
    # arrays on their own: taken from a tuple again and again, they are counted every time
    bounds, first, least, leave, margin = rule
    means, quaternions, scales, opacities, radius, extent = nodes
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
    waiting = 0
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
                for slot in range(count):
                    node = low + slot
                    numbers[slot] = node
                    _enter(node, slot, means, quaternions, scales, opacities, moments)
                    for axis in range(3):
                        colour = colours[node - bounds[0], axis]
                        moments[np.uint64(axis) * ROW + RED + np.uint64(slot)] = colour
                    size, side = box(*_diagonal(slot, moments))
                    radius[node], extent[node] = rounded_up(size), rounded_up(side)
            for slot in range(half):  # leaves with all, else the one half with the other
                judge(slot, half if joins else slot + 1, count, moments, costs)
            find_partners(count, costs, partners)
            target = leave if depth == 0 else keep
            while count > target:
                a, b = cheapest(count, partners)
                left, right = numbers[a], numbers[b]
                children[new - leaves, 0], children[new - leaves, 1] = left, right
                combine(a, b, moments)
                numbers[a], numbers[b] = new, numbers[count - 1]
                _wrap(new, left, right, a, moments, means, radius, extent, margin)
                _queue(new, a, moments, lanes, waiting, jobs, masses)
                waiting += 1
                if waiting == LANES:
                    _store(waiting, lanes, jobs, masses, quaternions, scales, opacities)
                    waiting = 0
                replace(a, b, count, moments, costs, partners)
                new += 1
                count -= 1
            if depth:
                set_aside(count, numbers, moments, costs, held_numbers, held_moments, top)
                top += 1
            else:
                set_aside(count, numbers, moments, costs, out_numbers, out_moments, piece)
    _store(waiting, lanes, jobs, masses, quaternions, scales, opacities)


@njit
def _enter(node, slot, means, quaternions, scales, opacities, moments):  # type: ignore[no-untyped-def]
    """Moments of a leaf, all but its colour."""
    i = np.uint64(slot)
    xx, xy, xz, yy, yz, zz = covariance(quaternions, scales, node)
    moments[i + XX], moments[i + XY], moments[i + XZ] = xx, xy, xz
    moments[i + YY], moments[i + YZ], moments[i + ZZ] = yy, yz, zz
    moments[i + X], moments[i + Y], moments[i + Z] = means[node, 0], means[node, 1], means[node, 2]
    moments[i + OPACITY] = opacities[node]
    moments[i + MASS] = moments[i + OPACITY] * surface(scales, node)


@njit
def _diagonal(slot, moments):  # type: ignore[no-untyped-def]
    """Of the covariance."""
    i = np.uint64(slot)
    return moments[i + XX], moments[i + YY], moments[i + ZZ]


@njit
def _wrap(node, left, right, slot, moments, means, radius, extent, margin):  # type: ignore[no-untyped-def]
    """Mean, R and e of a node: around its own box and its children's spheres."""
    for axis in range(3):
        means[node, axis] = np.float32(moments[(6 + axis) * MOST_SLOTS + slot])
    half, side = box(*_diagonal(slot, moments))
    for child in (left, right):
        reach, length = around(radius[child], extent[child], means, child, means, node, margin)
        half, side = max(half, reach), max(side, length)
    radius[node], extent[node] = rounded_up(half), rounded_up(side)


@njit
def _queue(node, slot, moments, lanes, lane, jobs, masses):  # type: ignore[no-untyped-def]
    """Leave the axes of a node for `_store`, many at a time."""
    jobs[lane] = node
    for k in range(6):
        lanes[k * LANES + lane] = moments[k * MOST_SLOTS + slot]
    masses[0, lane] = moments[np.uint64(slot) + MASS]
    masses[1, lane] = moments[np.uint64(slot) + OPACITY]


@njit
def _store(count, lanes, jobs, masses, quaternions, scales, opacities):  # type: ignore[no-untyped-def]
    """Rotations, scales and opacities of the nodes that wait."""
    find_axes(lanes, count)
    for lane in range(count):
        node, mass = jobs[lane], masses[0, lane]
        area = store_axes(lanes, lane, node, quaternions, scales)
        kept = mass > 0.0 and area > 0.0
        opacities[node] = np.float32(mass / area if kept else masses[1, lane])
