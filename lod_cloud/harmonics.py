"""Spherical harmonics of all nodes, level by level from the bottom, in memory or in a file.

    SH = sum w_i SH_i / W    over the children i, with w_i = o_i S_i, W = sum w_i; equal weights
                             where W = 0

The children of consecutive nodes are consecutive, and so are theirs: the nodes below some
neighbours of one level are one range of every level beneath. *Clumps* of at most 32 768 nodes,
neighbours and all below them, are filled from the bottom up in memory and written range by range;
the few nodes above the clumps read their children's rows back. Memory does not grow with the tree,
and no leaf is looked at twice.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.lanes import prefetch
from gaussians.parallel import run_chunks
from lod_cloud.lod_tree import Float32, Int32
from lod_cloud.numbering import Numbering

_CLUMP = 1 << 15  # nodes
_AHEAD = 16  # nodes whose leaves are on their way from memory
_LINE = 16  # numbers in a cache line


class Rows(Protocol):
    """Rows of an array [N, K] in memory or in a file; blocks do not overlap."""

    def read(self, begin: int, end: int) -> Float32: ...

    def write(self, begin: int, rows: Float32) -> None: ...


class MemoryRows:
    """Rows of an array in memory."""

    def __init__(self, array: Float32) -> None:
        self._array = array

    def read(self, begin: int, end: int) -> Float32:
        return self._array[begin:end]

    def write(self, begin: int, rows: Float32) -> None:
        self._array[begin : begin + len(rows)] = rows


def merge_harmonics(
    numbering: Numbering,
    masses: NDArray[np.float64],
    leaf_id: Int32,
    sh: Float32,
    out: Rows,
    was_read: Callable[[int], None] = lambda leaves: None,
) -> None:
    """Fill ``out`` [N, K] from the leaves' coefficients ``sh`` [leaves, K], rows by ``leaf_id``;
    ``masses`` [N] are o_i S_i.

    ``was_read`` is told how many more rows of ``sh`` were read.
    """
    clumps, above = _clumps(numbering.parent)
    # from left to right: neighbours of any level read the same part of ``sh``
    clumps.sort(key=lambda clump: _leftmost(numbering, clump[0]))
    width = sh.shape[1]

    def fill(low: int, high: int, below: int, children: Float32, rows: Float32) -> None:
        tree = numbering.first_child, numbering.child_count, leaf_id, masses
        _fill(low, below, *tree, sh, children, rows[: high - low])

    def fill_clumps(begin: int, end: int) -> None:
        buffer = np.empty((_CLUMP, width), np.float32)
        for place in range(begin, end):
            ranges = _ranges(numbering.parent, *clumps[place])
            free, below, children = 0, 0, buffer[:0]
            for low, high in reversed(ranges):
                rows = buffer[free : free + high - low]
                fill(low, high, below, children, rows)
                out.write(low, rows)
                free, below, children = free + high - low, low, rows
            was_read(free // 2)

    run_chunks(fill_clumps, len(clumps))
    row = np.empty((1, width), np.float32)
    for node in reversed(above):
        first = int(numbering.first_child[node])
        children = out.read(first, first + int(numbering.child_count[node]))
        fill(node, node + 1, first, children, row)
        out.write(node, row)


def _children(parent: Int32, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """The first child at or behind every node."""
    # of the parent's type, which would be copied as a whole otherwise
    return np.searchsorted(parent, nodes.astype(np.int32))


def _ranges(parent: Int32, low: int, high: int) -> list[tuple[int, int]]:
    """Neighbours low..high of one level and, level by level, all below them."""
    ranges = []
    while low < high:
        ranges.append((low, high))
        low, high = _children(parent, np.array([low, high])).tolist()
    return ranges


def _clumps(parent: Int32) -> tuple[list[tuple[int, int]], list[int]]:
    """Neighbours that are at most `_CLUMP` nodes with all below them, and the nodes above those,
    upwards from the root.
    """
    clumps: list[tuple[int, int]] = []
    above: list[int] = []
    level = np.array([0])  # nodes that are not below those of a clump
    while len(level):
        sizes = np.zeros(len(level), np.int64)
        low, high = level, level + 1
        while (low < high).any():
            sizes += high - low
            low, high = _children(parent, low), _children(parent, high)
        held = 0
        for node, size in zip(level.tolist(), sizes.tolist(), strict=True):
            if size > _CLUMP:
                above.append(node)
            elif 0 < held <= _CLUMP - size and clumps[-1][1] == node:
                clumps[-1] = clumps[-1][0], node + 1
                held += size
            else:
                clumps.append((node, node + 1))
                held = size
        large = level[sizes > _CLUMP]
        edges = _children(parent, large), _children(parent, large + 1)
        level = np.concatenate(
            [np.arange(a, b) for a, b in zip(*edges, strict=True)] or [level[:0]]
        )
    return clumps, above


def _leftmost(numbering: Numbering, node: int) -> int:
    """Place in the order of the first leaf at or below a node."""
    while numbering.child_count[node]:
        node = int(numbering.first_child[node])
    return int(numbering.nodes[node])


@njit(cache=True, error_model="numpy", nogil=True)
def _fill(begin, below, first_child, child_count, leaf_id, masses, sh, children, rows):  # type: ignore[no-untyped-def]
    """Rows of the nodes from ``begin`` on: leaves' from ``sh``, others' from those of their
    children, which begin with node ``below``.
    """
    width = rows.shape[1]
    sums = np.empty(width, np.float64)
    last = begin + len(rows) - 1
    for row in range(len(rows)):
        node = begin + row
        ahead = np.int64(leaf_id[min(node + _AHEAD, last)])
        for line in range(0, width, _LINE):
            prefetch(sh, ahead * width + line)
        number = child_count[node]
        if number == 0:
            leaf = leaf_id[node]
            for k in range(width):
                rows[row, k] = sh[leaf, k]
            continue
        first = first_child[node]
        total = 0.0
        for child in range(first, first + number):
            total += masses[child]
        for k in range(width):
            sums[k] = 0.0
        for child in range(first, first + number):
            weight = masses[child] / total if total > 0.0 else 1.0 / number
            values = children[child - below]
            for k in range(width):
                sums[k] += weight * np.float64(values[k])
        for k in range(width):
            rows[row, k] = np.float32(sums[k])
