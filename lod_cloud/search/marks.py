"""What the search kernels share: one bit per node, and the node test with hysteresis.

Marks are uint8 arrays, node n is bit ``n & 7`` of byte ``n >> 3``; their length is a multiple of
8 bytes, so that they are also arrays of 64-bit words, and of 16-bit ones: a number for each group
of 16 nodes. Listed in `gaussians.kernel_cache`, because kernels of other files call these
functions.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gaussians.lanes import bits, load
from lod_cloud.criterion import refines
from lod_cloud.search_arrays import GROUP, GROUP_NUMBERS

ONE = np.float32(1.0)


@njit(forceinline=True)
def is_set(marks, node):  # type: ignore[no-untyped-def]
    """Whether the bit of a node is set."""
    return (marks[node >> 3] >> (node & 7)) & 1 != 0


@njit(forceinline=True)
def set_bit(marks, node):  # type: ignore[no-untyped-def]
    marks[node >> 3] |= np.uint8(1 << (node & 7))


@njit(forceinline=True)
def clear_bit(marks, node):  # type: ignore[no-untyped-def]
    marks[node >> 3] &= np.uint8(255 - (1 << (node & 7)))


@njit(cache=True, error_model="numpy", nogil=True)
def set_marks(nodes, marks, value):  # type: ignore[no-untyped-def]
    """Set (or clear) the marks of nodes."""
    for node in nodes:
        if value:
            set_bit(marks, node)
        else:
            clear_bit(marks, node)


@njit(forceinline=True)
def any_set(marks, first, count):  # type: ignore[no-untyped-def]
    """Whether any of ``count`` nodes from ``first`` on has its bit set."""
    for node in range(first, first + count):  # noqa: SIM110 (compiled: no generators)
        if is_set(marks, node):
            return True
    return False


@njit(forceinline=True)
def stays_refined(cx, cy, cz, mx, my, mz, radius, extent, k, grow, was):  # type: ignore[no-untyped-def]
    """The node test of a node that was (not) refined before: hysteresis.

    A refined node stays refined until the camera has left the sphere ``grow`` (>= 1) times as
    large; R and k are multiplied by it, so that the rule is the node test of a tree with other
    numbers, nested for the same reason. Rounding is monotonic: the larger sphere holds the other.
    """
    scale = grow if was else ONE
    return refines(cx, cy, cz, mx, my, mz, scale * radius, extent, scale * k)


@njit(forceinline=True)
def test_group(group, cx, cy, cz, k, grow, groups, before):  # type: ignore[no-untyped-def]
    """The marks of a group of 16 nodes, as a number, from those it had ``before``.

    Nodes whose parent is not refined come out as not refined, because the test is nested. Without
    a branch on ``grow``: with one, references to the arrays are counted for every group.
    """
    stay = np.intp(before[group]) & inside_group(group, cx, cy, cz, k, grow, groups)
    return stay | inside_group(group, cx, cy, cz, k, ONE, groups)


@njit(forceinline=True)
def inside_group(group, cx, cy, cz, k, scale, groups):  # type: ignore[no-untyped-def]
    """The node test of 16 nodes at once, as a number."""
    start = np.intp(group) * GROUP_NUMBERS
    x, y, z = load(groups, start), load(groups, start + GROUP), load(groups, start + 2 * GROUP)
    radius, extent = load(groups, start + 3 * GROUP), load(groups, start + 4 * GROUP)
    return bits(refines(cx, cy, cz, x, y, z, scale * radius, extent, scale * k))
