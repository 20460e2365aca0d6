"""Node spheres (R, e) of trees whose Gaussians were made elsewhere: trained, or placed copies.

The definition is that of `lod_cloud.build`: a node's sphere holds its own 3-sigma box, and exceeds
the spheres of its children by the margin that makes the float32 node test nested.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gaussians.scene import Scene
from lod_cloud.lod_tree import Float32, Int32
from lod_cloud.merge import NEST_MARGIN
from lod_cloud.moments import covariance, rounded_up


def own_spheres(scene: Scene) -> tuple[Float32, Float32]:
    """R and e [N] of every Gaussian's own 3-sigma box: half diagonal, longest side."""
    radius, extent = np.empty(len(scene), np.float32), np.empty(len(scene), np.float32)
    _own(scene.quaternions, scene.scales, radius, extent)
    return radius, extent


def enclose(
    parents: Int32,
    below: tuple[Float32, Float32, Float32],
    above: tuple[Float32, Float32, Float32],
) -> None:
    """Raise R and e of the nodes ``above`` (means, R, e) until they hold those ``below``.

    ``parents`` [children] is the row in ``above`` of every child.
    """
    _enclose(parents, below, above, NEST_MARGIN)


def enclose_levels(
    parent: Int32, level_offsets: Int32, means: Float32, radius: Float32, extent: Float32
) -> None:
    """`enclose` for all levels of a breadth-first tree, from the bottom; R and e in place."""
    for level in range(len(level_offsets) - 2, 0, -1):
        above, begin, end = (int(v) for v in level_offsets[level - 1 : level + 2])
        lower, upper = slice(begin, end), slice(above, begin)
        enclose(
            parent[lower] - np.int32(above),
            (means[lower], radius[lower], extent[lower]),
            (means[upper], radius[upper], extent[upper]),
        )


@njit(cache=True, error_model="numpy", nogil=True)
def _own(quaternions, scales, radius, extent):  # type: ignore[no-untyped-def]
    for node in range(len(radius)):
        xx, _, _, yy, _, zz = covariance(quaternions, scales, node)
        radius[node] = rounded_up(3.0 * math.sqrt(xx + yy + zz))
        extent[node] = rounded_up(6.0 * math.sqrt(max(xx, yy, zz)))


@njit(cache=True, error_model="numpy", nogil=True)
def _enclose(parents, below, above, margin):  # type: ignore[no-untyped-def]
    means, radius, extent = below
    above_means, above_radius, above_extent = above
    for child in range(len(parents)):
        node = parents[child]
        gap = 0.0
        for axis in range(3):
            d = np.float64(means[child, axis]) - np.float64(above_means[node, axis])
            gap += d * d
        reach = rounded_up((np.float64(radius[child]) + math.sqrt(gap)) * margin)
        side = rounded_up(np.float64(extent[child]) * margin)
        above_radius[node] = max(above_radius[node], reach)
        above_extent[node] = max(above_extent[node], side)
