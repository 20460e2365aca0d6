"""Node spheres (R, e) of nodes whose Gaussians are there: trained, placed copies, or merged with
other children than they have now. The rule is that of `lod_cloud.moments`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gaussians.parallel import run_chunks
from gaussians.scene import Scene
from lod_cloud.lod_tree import Float32, Int32
from lod_cloud.moments import NEST_MARGIN, around, own_box, rounded_up
from lod_cloud.nodes import OPACITY, QUATERNION, SCALES, SPHERE, Nodes
from lod_cloud.numbering import Numbering


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
    _enclose(parents, below, above)


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


def tighten_spheres(numbering: Numbering, nodes: Nodes) -> None:
    """Give the numbered interior nodes R and e over the children they have after others were left
    out.

    The binary tree's spheres hold these children too, but more loosely: a path over nodes that
    were left out is no shorter than the direct one, and each of its steps has a margin.
    """
    offsets = numbering.level_offsets
    links = numbering.first_child, numbering.child_count, numbering.nodes
    scene = nodes.scene
    leaves = nodes.ids, scene.means, scene.quaternions, scene.scales
    for level in range(len(offsets) - 2, -1, -1):
        begin, end = int(offsets[level]), int(offsets[level + 1])
        run_chunks(_tighten, end - begin, begin, *links, *leaves, nodes.rows)


@njit(cache=True, error_model="numpy", nogil=True)
def _own(quaternions, scales, radius, extent):  # type: ignore[no-untyped-def]
    for node in range(len(radius)):
        half, side = own_box(quaternions, scales, node)
        radius[node], extent[node] = rounded_up(half), rounded_up(side)


@njit(cache=True, error_model="numpy", nogil=True)
def _enclose(parents, below, above):  # type: ignore[no-untyped-def]
    means, radius, extent = below
    above_means, above_radius, above_extent = above
    for child in range(len(parents)):
        node = parents[child]
        reach, side = around(
            radius[child], extent[child], means, child, above_means, node, NEST_MARGIN
        )
        above_radius[node] = max(above_radius[node], rounded_up(reach))
        above_extent[node] = max(above_extent[node], rounded_up(side))


@njit(cache=True, error_model="numpy", nogil=True)
def _tighten(  # type: ignore[no-untyped-def]
    begin, end, offset, first_child, child_count, numbers, ids, means, quaternions, scales, rows
):
    for place in range(offset + begin, offset + end):
        if child_count[place] == 0:
            continue
        node = numbers[place] - len(ids)
        half, side = own_box(rows[:, QUATERNION:SCALES], rows[:, SCALES:OPACITY], node)
        for k in range(first_child[place], first_child[place] + child_count[place]):
            child = numbers[k]
            if child < len(ids):
                leaf = ids[child]
                radius, extent = own_box(quaternions, scales, leaf)
                radius, extent = rounded_up(radius), rounded_up(extent)
                reach, length = around(radius, extent, means, leaf, rows, node, NEST_MARGIN)
            else:
                child -= len(ids)
                radius, extent = rows[child, SPHERE], rows[child, SPHERE + 1]
                reach, length = around(radius, extent, rows, child, rows, node, NEST_MARGIN)
            half, side = max(half, reach), max(side, length)
        rows[node, SPHERE], rows[node, SPHERE + 1] = rounded_up(half), rounded_up(side)
