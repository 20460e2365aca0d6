"""Merges any number of Gaussians at once, and the children of a node once more: what a client does
when they give way to their parent.

The formula is that of `lod_cloud.merge` and `lod_cloud.harmonics`, from float32 values; a node's
value differs from the builder's by rounding. R and e are what the builder takes: around the node's
own box and its children's spheres.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.parallel import run_chunks
from gaussians.scene import FIELDS, Scene
from lod_cloud.lod_tree import Float32, Int32, LodTree
from lod_cloud.moments import (
    LANES,
    NEST_MARGIN,
    ROWS,
    around,
    box,
    covariance,
    find_axes,
    own_box,
    rounded_up,
    store_axes,
    surface,
)
from lod_cloud.node_records import NodeRecords

MEAN_ERROR = 2.0**-11  # of a faithful merge per axis, in largest standard deviations
MASS_ERROR = 1e-5  # of a faithful merge
_FLOAT32_STEP = 2.0**-24


def merge_siblings(ids: Int32, parents: Int32, children: NodeRecords, bounds: Int32) -> NodeRecords:
    """The nodes ``ids`` [G] with these parents: node g is the merge of the records
    ``children[bounds[g]:bounds[g + 1]]``, at least one. Does not depend on threads.
    """
    ranges = np.stack([bounds[:-1], bounds[1:]], axis=1)
    below = np.stack([children.radius, children.extent])
    spheres = np.empty((2, len(ids)), np.float32)
    merged = _merged(children.gaussians, ranges, below, spheres)
    return NodeRecords(ids, parents, np.diff(bounds), spheres[0], spheres[1], merged)


def merge_ranges(scene: Scene, ranges: Int32) -> Scene:
    """[G] merges of the Gaussians ``ranges[g, 0]`` .. ``ranges[g, 1]`` of a scene, at least one in
    each [G, 2]; ranges may overlap. Does not depend on threads.
    """
    nothing = np.empty((2, 0), np.float32)
    return _merged(scene, ranges, nothing, nothing)


def _merged(source: Scene, ranges: Int32, below: Float32, spheres: Float32) -> Scene:
    """Merges; with ``spheres`` [2, G] R and e too, from those of the source."""
    arrays = tuple(np.ascontiguousarray(getattr(source, name)) for name in FIELDS)
    merged = tuple(np.empty((len(ranges), *array.shape[1:]), np.float32) for array in arrays)
    run_chunks(_merge, len(ranges), ranges, arrays, below, merged, spheres)
    return Scene(*merged)


def faithful(tree: LodTree, nodes: Int32) -> NDArray[np.bool_]:
    """Which interior nodes (ascending) are what merging their children gives: the mean but for
    ``MEAN_ERROR``, which float32 has to be able to express there, the mass but for ``MASS_ERROR``.
    """
    counts = tree.child_count[nodes]
    bounds = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    offsets = np.arange(bounds[-1]) - np.repeat(bounds[:-1], counts)
    children = (np.repeat(tree.first_child[nodes], counts) + offsets).astype(np.int32)
    below = _without_harmonics(tree, children)
    merged = merge_siblings(nodes, tree.parent[nodes], below, bounds).gaussians
    own = _without_harmonics(tree, nodes).gaussians
    sigmas = own.scales.max(axis=1, initial=0).astype(np.float64)
    error = MEAN_ERROR * sigmas[:, None]
    mass = _masses(own)
    total = np.add.reduceat(_masses(below.gaussians), bounds[:-1]) if len(nodes) else mass
    same = (np.abs(merged.means.astype(np.float64) - own.means) <= error).all(axis=1)
    fine = (np.abs(own.means) * _FLOAT32_STEP <= error).all(axis=1)
    kept = np.abs(total - mass) <= MASS_ERROR * mass
    kept &= np.abs(_masses(merged) - mass) <= MASS_ERROR * mass
    return np.asarray(same & fine & kept & (mass > 0))


def _without_harmonics(tree: LodTree, nodes: Int32) -> NodeRecords:
    scene = tree.gaussians
    bare = Scene(
        scene.means[nodes],
        scene.quaternions[nodes],
        scene.scales[nodes],
        scene.opacities[nodes],
        np.empty((len(nodes), 0, 3), np.float32),
    )
    counts = tree.child_count[nodes]
    radius, extent = tree.radius[nodes], tree.extent[nodes]
    return NodeRecords(nodes, tree.parent[nodes], counts, radius, extent, bare)


def _masses(scene: Scene) -> NDArray[np.float64]:
    a, b, c = scene.scales.astype(np.float64).T
    return np.asarray(scene.opacities * (a * b + a * c + b * c))


@njit(cache=True, error_model="numpy", nogil=True)
def _merge(begin, end, ranges, source, below, merged, spheres):  # type: ignore[no-untyped-def]
    """Groups begin..end, so many at a time as `find_axes` takes."""
    lanes, masses = np.zeros(ROWS * LANES), np.empty((2, LANES))
    colours = np.empty(source[4].shape[1:])
    for base in range(begin, end, LANES):
        count = min(LANES, end - base)
        for lane in range(count):
            group = base + lane
            low, high = ranges[group, 0], ranges[group, 1]
            _sum_up(group, low, high, source, merged, colours, lane, lanes, masses)
            if spheres.shape[1]:
                _wrap(group, low, high, lanes, lane, source, below, merged[0], spheres)
        find_axes(lanes, count)
        for lane in range(count):
            area = store_axes(lanes, lane, base + lane, merged[1], merged[2])
            whole = masses[0, lane] > 0.0 and area > 0.0
            opacity = masses[0, lane] / area if whole else masses[1, lane]
            merged[3][base + lane] = np.float32(opacity)


@njit
def _sum_up(group, low, high, source, merged, colours, lane, lanes, masses):  # type: ignore[no-untyped-def]
    """Mean and harmonics of a group; its covariance and masses stay in its lane."""
    means, quaternions, scales, opacities, sh = source
    total = 0.0
    for child in range(low, high):
        total += np.float64(opacities[child]) * surface(scales, child)
    x = y = z = opacity = 0.0
    colours[:] = 0.0
    for child in range(low, high):
        share = _share(child, total, high - low, opacities, scales)
        x += share * means[child, 0]
        y += share * means[child, 1]
        z += share * means[child, 2]
        opacity += share * opacities[child]
        for k in range(sh.shape[1]):
            for channel in range(3):
                colours[k, channel] += share * sh[child, k, channel]
    for k in range(6):
        lanes[k * LANES + lane] = 0.0
    for child in range(low, high):
        share = _share(child, total, high - low, opacities, scales)
        xx, xy, xz, yy, yz, zz = covariance(quaternions, scales, child)
        dx, dy, dz = means[child, 0] - x, means[child, 1] - y, means[child, 2] - z
        lanes[lane] += share * (xx + dx * dx)
        lanes[LANES + lane] += share * (xy + dx * dy)
        lanes[2 * LANES + lane] += share * (xz + dx * dz)
        lanes[3 * LANES + lane] += share * (yy + dy * dy)
        lanes[4 * LANES + lane] += share * (yz + dy * dz)
        lanes[5 * LANES + lane] += share * (zz + dz * dz)
    masses[0, lane], masses[1, lane] = total, opacity
    merged[0][group, 0], merged[0][group, 1] = np.float32(x), np.float32(y)
    merged[0][group, 2] = np.float32(z)
    for k in range(sh.shape[1]):
        for channel in range(3):
            merged[4][group, k, channel] = np.float32(colours[k, channel])


@njit
def _share(child, total, count, opacities, scales):  # type: ignore[no-untyped-def]
    if total > 0.0:
        return np.float64(opacities[child]) * surface(scales, child) / total
    return 1.0 / count


@njit
def _wrap(group, low, high, lanes, lane, source, below, means, spheres):  # type: ignore[no-untyped-def]
    """R and e. A leaf's are those of its own box; a client does not know them."""
    half, side = box(lanes[lane], lanes[3 * LANES + lane], lanes[5 * LANES + lane])
    for child in range(low, high):
        radius, extent = own_box(source[1], source[2], child)
        radius, extent = max(radius, below[0, child]), max(extent, below[1, child])
        reach, length = around(radius, extent, source[0], child, means, group, NEST_MARGIN)
        half, side = max(half, reach), max(side, length)
    spheres[0, group], spheres[1, group] = rounded_up(half), rounded_up(side)
