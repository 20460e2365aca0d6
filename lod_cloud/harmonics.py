"""Spherical harmonics of all nodes, level by level from the bottom, in memory or in a file.

    SH = sum w_i SH_i / W    over the children i, with w_i = o_i S_i, W = sum w_i; equal weights
                             where W = 0

The children of consecutive nodes are consecutive, so a block of one level needs one block of the
level below and nothing else: memory does not grow with the tree.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numba import njit

from gaussians.parallel import run_chunks
from lod_cloud.lod_tree import Float32, Int32
from lod_cloud.merge import Nodes
from lod_cloud.moments import surface
from lod_cloud.numbering import Numbering

_BLOCK = 1 << 14  # nodes


class Rows(Protocol):
    """Rows of an array [N, K] in memory or in a file; blocks do not overlap."""

    def read(self, begin: int, end: int) -> Float32: ...

    def target(self, begin: int, end: int) -> Float32:
        """[end - begin, K] to be filled and handed to ``write``."""

    def write(self, begin: int, rows: Float32) -> None: ...


class MemoryRows:
    """Rows of an array in memory; reads and writes are views of it."""

    def __init__(self, array: Float32) -> None:
        self._array = array

    def read(self, begin: int, end: int) -> Float32:
        return self._array[begin:end]

    def target(self, begin: int, end: int) -> Float32:
        return self._array[begin:end]

    def write(self, begin: int, rows: Float32) -> None:
        """Nothing is left to do: ``rows`` is a view."""


def merge_harmonics(
    numbering: Numbering,
    nodes: Nodes,
    leaf_id: Int32,
    sh: Float32,
    out: Rows,
    release: Callable[[], None] = lambda: None,
) -> None:
    """Fill ``out`` [N, K] from the leaves' coefficients ``sh`` [leaves, K], rows by ``leaf_id``.

    ``release`` is called now and then to let go of what was read of ``sh``.
    """
    offsets = numbering.level_offsets
    for level in range(len(offsets) - 2, -1, -1):
        begin, end = int(offsets[level]), int(offsets[level + 1])
        run_chunks(_blocks, end - begin, begin, numbering, nodes, leaf_id, sh, out, release)


def _blocks(
    begin: int,
    end: int,
    offset: int,
    numbering: Numbering,
    nodes: Nodes,
    leaf_id: Int32,
    sh: Float32,
    out: Rows,
    release: Callable[[], None],
) -> None:
    for low in range(offset + begin, offset + end, _BLOCK):
        high = min(low + _BLOCK, offset + end)
        inner = np.flatnonzero(numbering.child_count[low:high])
        first = last = 0
        if len(inner):
            final = low + int(inner[-1])
            first = int(numbering.first_child[low + int(inner[0])])
            last = int(numbering.first_child[final] + numbering.child_count[final])
        rows = out.target(low, high)
        _fill(
            low,
            first,
            numbering.first_child,
            numbering.child_count,
            numbering.nodes,
            leaf_id,
            nodes.opacities,
            nodes.scales,
            sh,
            out.read(first, last),
            rows,
        )
        out.write(low, rows)
    release()


@njit(cache=True, error_model="numpy", nogil=True)
def _fill(  # type: ignore[no-untyped-def]
    begin, below, first_child, child_count, nodes, leaf_id, opacities, scales, sh, children, rows
):
    width = rows.shape[1]
    sums = np.empty(width, np.float64)
    for row in range(len(rows)):
        node = begin + row
        number = child_count[node]
        if number == 0:
            leaf = leaf_id[node]
            for k in range(width):
                rows[row, k] = sh[leaf, k]
            continue
        first = first_child[node]
        total = 0.0
        for child in range(first, first + number):
            total += _mass(nodes[child], opacities, scales)
        for k in range(width):
            sums[k] = 0.0
        for child in range(first, first + number):
            weight = 1.0 / number
            if total > 0.0:
                weight = _mass(nodes[child], opacities, scales) / total
            values = children[child - below]
            for k in range(width):
                sums[k] += weight * np.float64(values[k])
        for k in range(width):
            rows[row, k] = np.float32(sums[k])


@njit
def _mass(node, opacities, scales):  # type: ignore[no-untyped-def]
    """Opacity times surface of a node of the unfinished tree."""
    return np.float64(opacities[node]) * surface(scales, node)
