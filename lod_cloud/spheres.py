"""Node spheres of an irregular tree, around the children a node has after others were left out."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gaussians.parallel import run_chunks
from lod_cloud.merge import NEST_MARGIN, Nodes
from lod_cloud.moments import covariance, rounded_up
from lod_cloud.numbering import Numbering


def tighten_spheres(numbering: Numbering, nodes: Nodes, margin: float = NEST_MARGIN) -> None:
    """Give the numbered interior nodes the R and e of `lod_cloud.build` over their own children.

    The binary tree's spheres hold these children too, but more loosely: a path over nodes that
    were left out is no shorter than the direct one, and each of its steps has a margin.
    """
    offsets = numbering.level_offsets
    for level in range(len(offsets) - 2, -1, -1):
        begin, end = int(offsets[level]), int(offsets[level + 1])
        run_chunks(
            _tighten,
            end - begin,
            begin,
            numbering.first_child,
            numbering.child_count,
            numbering.nodes,
            nodes,
            margin,
        )


@njit(cache=True, error_model="numpy", nogil=True)
def _tighten(begin, end, offset, first_child, child_count, numbers, nodes, margin):  # type: ignore[no-untyped-def]
    for row in range(offset + begin, offset + end):
        if child_count[row] == 0:
            continue
        node = numbers[row]
        xx, _, _, yy, _, zz = covariance(nodes.quaternions, nodes.scales, node)
        half, side = 3.0 * math.sqrt(xx + yy + zz), 6.0 * math.sqrt(max(xx, yy, zz))
        for k in range(first_child[row], first_child[row] + child_count[row]):
            child = numbers[k]
            gap = 0.0
            for axis in range(3):
                d = np.float64(nodes.means[child, axis]) - np.float64(nodes.means[node, axis])
                gap += d * d
            half = max(half, (np.float64(nodes.radius[child]) + math.sqrt(gap)) * margin)
            side = max(side, np.float64(nodes.extent[child]) * margin)
        nodes.radius[node], nodes.extent[node] = rounded_up(half), rounded_up(side)
