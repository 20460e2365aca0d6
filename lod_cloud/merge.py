"""Merges leaves into the interior nodes of a tree: Gaussians without harmonics, node spheres.

Children i with opacity o_i, means m_i, covariances C_i, surfaces S = s0 s1 + s0 s2 + s1 s2:

    w_i = o_i S_i            W = sum w_i
    m   = sum w_i m_i / W    C = sum w_i (C_i + (m_i - m)(m_i - m)^T) / W
    o   = W / S(C)           (may exceed 1; kept)

so the mass o S of a node is that of its leaves. Where W = 0 (transparent children, or points and
lines, which have no surface) all children weigh the same and o is the mean of their opacities;
where only S(C) = 0, o is their weighted mean. Everything is float64, rounded once per stored
number; above the groups, and for the spheres, it starts from the children's float32 values.

*Within a group* of neighbouring leaves the two nodes with the least ``S(C)^2 (1 + |dc|^2)^2``
merge first, where C is their merged covariance and dc the difference of their harmonics of degree
0. Small and alike things vanish first, which is worth 0.5
to 0.8 dB at equal count against splitting on to the last leaf (docs/lod_tree.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit

from gaussians.parallel import run_chunks
from gaussians.scene import Scene
from lod_cloud.lod_tree import Float32, Int32
from lod_cloud.moments import (
    LANES,
    ROWS,
    covariance,
    find_axes,
    rounded_up,
    store_axes,
    surface,
)
from lod_cloud.split import UpperTree

# Moments of a slot, in rows of MOST_LEAVES slots: first the covariance.
MOST_LEAVES = 64  # of a group
_ROW = np.uint64(MOST_LEAVES)  # unsigned: see `lod_cloud.moments`
_XX, _XY, _XZ, _YY, _YZ, _ZZ = (np.uint64(row * MOST_LEAVES) for row in range(6))
_X, _Y, _Z = (np.uint64(row * MOST_LEAVES) for row in range(6, 9))
_RED, _GREEN, _BLUE = (np.uint64(row * MOST_LEAVES) for row in range(9, 12))
_OPACITY, _MASS = (np.uint64(row * MOST_LEAVES) for row in range(12, 14))
_MEANS = 13  # rows that are weighted means; the mass is a sum
_BLOCK_GROUPS = 1024
NEST_MARGIN = 1.0 + 2.0**-19  # exceeds the rounding of the float32 node test


class Nodes(NamedTuple):
    """Nodes of an unfinished tree, numbered as in `lod_cloud.split.UpperTree`; no harmonics."""

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


def merge_leaves(
    scene: Scene,
    ids: Int32,
    upper: UpperTree,
    margin: float = NEST_MARGIN,
    release: Callable[[], None] = lambda: None,
) -> tuple[Nodes, Int32]:
    """All nodes over the leaves ``ids`` (left to right), and the children [N - 1, 2] of the
    interior ones.

    ``margin`` is the factor by which a node's R and e exceed its children's; ``release`` is called
    now and then to let go of what was read of the scene.
    """
    count = len(ids)
    nodes = Nodes.empty(2 * count - 1)
    children = np.empty((count - 1, 2), np.int32)
    leaves = (
        ids,
        scene.means,
        scene.quaternions,
        scene.scales,
        scene.opacities,
        scene.sh.reshape(count, -1),
    )

    def blocks(begin: int, end: int, *arguments: object) -> None:
        for low in range(begin, end, _BLOCK_GROUPS):
            _merge_groups(low, min(low + _BLOCK_GROUPS, end), *arguments)
            release()

    places = np.arange(count, dtype=np.int32)
    run_chunks(blocks, upper.groups, upper.bounds, places, count, *leaves, nodes, children, margin)
    first = 2 * count - upper.groups
    no_leaves = (ids[:0], *leaves[1:])
    for level in range(len(upper.level_offsets) - 2, -1, -1):  # pairs of halves
        begin, end = (int(v) for v in upper.level_offsets[level : level + 2])
        pairs = np.arange(0, 2 * (end - begin) + 1, 2, dtype=np.int32)
        members = upper.children[begin:end].reshape(-1)
        run_chunks(
            _merge_groups,
            end - begin,
            pairs,
            members,
            first + begin,
            *no_leaves,
            nodes,
            children,
            margin,
        )
    return nodes, children


@njit(cache=True, error_model="numpy", nogil=True)
def _merge_groups(  # type: ignore[no-untyped-def]
    begin, end, bounds, members, base, ids, means, quaternions, scales, opacities, sh, nodes,
    children, margin,
):  # fmt: skip
    """Merge members bounds[g]..bounds[g + 1] of every group to one node; the new ones of group g
    are numbered from base + bounds[g] - g. With ``ids`` the members are leaves, and stored first.
    """
    most = 1
    for group in range(begin, end):
        most = max(most, bounds[group + 1] - bounds[group])
    slots = np.empty(most, np.int32)  # nodes that have no parent yet, and their moments
    moments = np.zeros((_MEANS + 1) * MOST_LEAVES)
    costs = np.empty((most, most))  # of pairs of slots, below the diagonal
    fresh = np.empty(most)
    lanes, jobs = np.zeros(ROWS * LANES), np.empty(LANES, np.int32)
    masses = np.empty((2, LANES))
    waiting = 0
    leaves = len(children) + 1
    for group in range(begin, end):
        low, high = bounds[group], bounds[group + 1]
        for at in range(low, high):
            node, slot = members[at], at - low
            slots[slot] = node
            if len(ids):
                leaf = ids[node]
                for axis in range(3):
                    nodes.means[node, axis] = means[leaf, axis]
                    nodes.scales[node, axis] = scales[leaf, axis]
                    moments[np.uint64(axis) * _ROW + _RED + np.uint64(slot)] = sh[leaf, axis]
                for axis in range(4):
                    nodes.quaternions[node, axis] = quaternions[leaf, axis]
                nodes.opacities[node] = opacities[leaf]
            _enter(node, slot, nodes, moments)
            if len(ids):
                half, side = _box(slot, moments)
                nodes.radius[node], nodes.extent[node] = rounded_up(half), rounded_up(side)
        for slot in range(1, high - low):
            _judge(slot, slot, moments, costs[slot])
        new = base + low - group
        for left in range(high - low, 1, -1):
            a, b = _cheapest(costs, left)
            children[new - leaves, 0], children[new - leaves, 1] = slots[b], slots[a]
            _combine(b, a, moments)
            slots[b] = new
            _wrap(new, children[new - leaves], b, moments, nodes, margin)
            _queue(new, b, moments, lanes, waiting, jobs, masses)
            waiting += 1
            if waiting == LANES:
                _store(waiting, lanes, jobs, masses, nodes)
                waiting = 0
            new += 1
            last = left - 1
            if a != last:
                slots[a] = slots[last]
                for k in range(_MEANS + 1):
                    moments[k * MOST_LEAVES + a] = moments[k * MOST_LEAVES + last]
                for other in range(a):
                    costs[a, other] = costs[last, other]
                for other in range(a + 1, last):
                    costs[other, a] = costs[last, other]
            _judge(b, last, moments, fresh)
            for other in range(b):
                costs[b, other] = fresh[other]
            for other in range(b + 1, last):
                costs[other, b] = fresh[other]
    _store(waiting, lanes, jobs, masses, nodes)


# ---------------------------------------------------------------- moments of slots


@njit
def _enter(node, slot, nodes, moments):  # type: ignore[no-untyped-def]
    """Moments of a stored node, all but its colour."""
    i = np.uint64(slot)
    xx, xy, xz, yy, yz, zz = covariance(nodes.quaternions, nodes.scales, node)
    moments[i + _XX], moments[i + _XY], moments[i + _XZ] = xx, xy, xz
    moments[i + _YY], moments[i + _YZ], moments[i + _ZZ] = yy, yz, zz
    moments[i + _X] = nodes.means[node, 0]
    moments[i + _Y] = nodes.means[node, 1]
    moments[i + _Z] = nodes.means[node, 2]
    moments[i + _OPACITY] = nodes.opacities[node]
    moments[i + _MASS] = moments[i + _OPACITY] * surface(nodes.scales, node)


@njit
def _load(i, moments):  # type: ignore[no-untyped-def]
    """Covariance, mean, colour and mass of a slot (unsigned)."""
    return (
        (moments[i + _XX], moments[i + _XY], moments[i + _XZ]),
        (moments[i + _YY], moments[i + _YZ], moments[i + _ZZ]),
        (moments[i + _X], moments[i + _Y], moments[i + _Z]),
        (moments[i + _RED], moments[i + _GREEN], moments[i + _BLUE]),
        moments[i + _MASS],
    )


@njit
def _pair(a, b):  # type: ignore[no-untyped-def]
    """Share of slot a in the merge of two loaded slots, and the merge's covariance."""
    total = a[4] + b[4]
    p = a[4] / total if total > 0.0 else 0.5
    q = 1.0 - p
    r = p * q
    dx, dy, dz = a[2][0] - b[2][0], a[2][1] - b[2][1], a[2][2] - b[2][2]
    return (
        p,
        p * a[0][0] + q * b[0][0] + r * dx * dx,
        p * a[0][1] + q * b[0][1] + r * dx * dy,
        p * a[0][2] + q * b[0][2] + r * dx * dz,
        p * a[1][0] + q * b[1][0] + r * dy * dy,
        p * a[1][1] + q * b[1][1] + r * dy * dz,
        p * a[1][2] + q * b[1][2] + r * dz * dz,
    )


@njit
def _combine(slot, other, moments):  # type: ignore[no-untyped-def]
    """Slot becomes the merge of the two."""
    i, j = np.uint64(slot), np.uint64(other)
    p, xx, xy, xz, yy, yz, zz = _pair(_load(i, moments), _load(j, moments))
    for row in range(6, _MEANS):
        k = np.uint64(row) * _ROW
        moments[i + k] = p * moments[i + k] + (1.0 - p) * moments[j + k]
    moments[i + _XX], moments[i + _XY], moments[i + _XZ] = xx, xy, xz
    moments[i + _YY], moments[i + _YZ], moments[i + _ZZ] = yy, yz, zz
    moments[i + _MASS] += moments[j + _MASS]


@njit
def _judge(slot, end, moments, costs):  # type: ignore[no-untyped-def]
    """costs[i] of merging a slot with slot i, for all i before ``end``.

    The sum of the covariance's principal minors, times the penalty for unlike colours.
    """
    a = _load(np.uint64(slot), moments)
    for other in range(np.uint64(end)):
        b = _load(other, moments)
        _, xx, xy, xz, yy, yz, zz = _pair(a, b)
        red, green, blue = a[3][0] - b[3][0], a[3][1] - b[3][1], a[3][2] - b[3][2]
        unlike = 1.0 + (red * red + green * green + blue * blue)
        minors = (xx * yy - xy * xy) + (xx * zz - xz * xz) + (yy * zz - yz * yz)
        costs[other] = minors * (unlike * unlike)


@njit
def _cheapest(costs, count):  # type: ignore[no-untyped-def]
    """Two slots a > b of the least cost."""
    a, b = 1, 0
    least = costs[1, 0]
    for i in range(2, count):
        row = costs[i]
        for j in range(i):
            if row[j] < least:
                least, a, b = row[j], i, j
    return a, b


# ---------------------------------------------------------------- finished nodes


@njit
def _box(slot, moments):  # type: ignore[no-untyped-def]
    """Half diagonal and longest side of the 3-sigma box."""
    i = np.uint64(slot)
    xx, yy, zz = moments[i + _XX], moments[i + _YY], moments[i + _ZZ]
    return 3.0 * math.sqrt(xx + yy + zz), 6.0 * math.sqrt(max(xx, yy, zz))


@njit
def _wrap(node, pair, slot, moments, nodes, margin):  # type: ignore[no-untyped-def]
    """Mean, R and e of a node: around its own box and its children's spheres."""
    for axis in range(3):
        nodes.means[node, axis] = np.float32(moments[(6 + axis) * MOST_LEAVES + slot])
    half, side = _box(slot, moments)
    for child in pair:
        gap = 0.0
        for axis in range(3):
            d = np.float64(nodes.means[child, axis]) - np.float64(nodes.means[node, axis])
            gap += d * d
        half = max(half, (np.float64(nodes.radius[child]) + math.sqrt(gap)) * margin)
        side = max(side, np.float64(nodes.extent[child]) * margin)
    nodes.radius[node] = rounded_up(half)
    nodes.extent[node] = rounded_up(side)


@njit
def _queue(node, slot, moments, lanes, lane, jobs, masses):  # type: ignore[no-untyped-def]
    """Leave the axes of a node for `_store`, many at a time."""
    jobs[lane] = node
    for k in range(6):
        lanes[k * LANES + lane] = moments[k * MOST_LEAVES + slot]
    masses[0, lane] = moments[np.uint64(slot) + _MASS]
    masses[1, lane] = moments[np.uint64(slot) + _OPACITY]


@njit
def _store(count, lanes, jobs, masses, nodes):  # type: ignore[no-untyped-def]
    """Rotations, scales and opacities of the nodes that wait."""
    find_axes(lanes, count)
    for lane in range(count):
        node = jobs[lane]
        area = store_axes(lanes, lane, node, nodes.quaternions, nodes.scales)
        if masses[0, lane] > 0.0 and area > 0.0:
            nodes.opacities[node] = np.float32(masses[0, lane] / area)
        else:
            nodes.opacities[node] = np.float32(masses[1, lane])
