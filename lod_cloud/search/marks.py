"""What the search kernels share: one bit per node, and the node test with hysteresis.

Marks are uint8 arrays, node n is bit ``n & 7`` of byte ``n >> 3``; their length is a multiple of
8 bytes, so that they are also arrays of 64-bit words. Listed in `gaussians.kernel_cache`, because
kernels of other files call these functions.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lod_cloud.criterion import refines

BLOCK = 64  # nodes tested side by side: one word of marks
ONE = np.float32(1.0)
_PAIRS, _FOURS, _EIGHT = (np.uint64(m) for m in (0x0003000300030003, 0x0000000F0000000F, 0xFF))
_7, _14, _28 = np.uint64(7), np.uint64(14), np.uint64(28)


@njit
def is_set(marks, node):  # type: ignore[no-untyped-def]
    """Whether the bit of a node is set."""
    return (marks[node >> 3] >> (node & 7)) & 1 != 0


@njit
def set_bit(marks, node):  # type: ignore[no-untyped-def]
    marks[node >> 3] |= np.uint8(1 << (node & 7))


@njit
def clear_bit(marks, node):  # type: ignore[no-untyped-def]
    marks[node >> 3] &= np.uint8(255 - (1 << (node & 7)))


@njit
def any_set(marks, first, count):  # type: ignore[no-untyped-def]
    """Whether any of ``count`` nodes from ``first`` on has its bit set."""
    for node in range(first, first + count):  # noqa: SIM110 (compiled: no generators)
        if is_set(marks, node):
            return True
    return False


@njit
def stays_refined(cx, cy, cz, mx, my, mz, radius, extent, k, grow, was):  # type: ignore[no-untyped-def]
    """The node test of a node that was (not) refined before: hysteresis.

    A refined node stays refined until the camera has left the sphere ``grow`` (>= 1) times as
    large; R and k are multiplied by it, so that the rule is the node test of a tree with other
    numbers, nested for the same reason.
    """
    if refines(cx, cy, cz, mx, my, mz, radius, extent, k):
        return True
    return was and refines(cx, cy, cz, mx, my, mz, grow * radius, extent, grow * k)


@njit
def _test_many(flags, cx, cy, cz, k, grow, child_count, positions, radius, extent):  # type: ignore[no-untyped-def]
    """Flags of all nodes of the slices given; ``positions`` is flat. The loop becomes vectors."""
    for i in range(len(radius)):
        flags[i] = np.uint8(
            refines(
                cx, cy, cz, positions[3 * i], positions[3 * i + 1], positions[3 * i + 2],
                grow * radius[i], extent[i], grow * k,
            )
        ) & np.uint8(child_count[i] > 0)  # fmt: skip


@njit
def _gathered(word):  # type: ignore[no-untyped-def]
    """The lowest bits of 8 bytes as one byte."""
    word = (word | (word >> _7)) & _PAIRS
    word = (word | (word >> _14)) & _FOURS
    return np.uint8((word | (word >> _28)) & _EIGHT)


@njit
def test_block(block, cx, cy, cz, k, grow, child_count, positions, radius, extent, marks, flags):  # type: ignore[no-untyped-def]
    """Test the 64 nodes of a block and replace their marks; ``flags`` [64] uint8 is scratch.

    ``positions`` are the means, flat. Nodes whose parent is not refined come out as not refined,
    because the test is nested. The block's last flags are beyond the last node: they stay 0.
    """
    low = block * BLOCK
    high = min(low + BLOCK, len(radius))
    counts, means = child_count[low:high], positions[3 * low : 3 * high]
    radii, extents = radius[low:high], extent[low:high]
    words = flags.view(np.uint64)
    flags[high - low :] = 0
    _test_many(flags, cx, cy, cz, k, ONE, counts, means, radii, extents)
    if grow > ONE:
        before = marks[block * 8 : block * 8 + 8].copy()
        for i in range(8):
            marks[block * 8 + i] = _gathered(words[i])
        _test_many(flags, cx, cy, cz, k, grow, counts, means, radii, extents)
        for i in range(8):
            marks[block * 8 + i] |= before[i] & _gathered(words[i])
    else:
        for i in range(8):
            marks[block * 8 + i] = _gathered(words[i])
