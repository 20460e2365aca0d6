"""An octree of voxels over a scene's Gaussians: the structure of Octree-GS (arXiv:2403.17898).

There, level l has one anchor per occupied voxel of edge E / 2^l, and anchors are trained. Here E is
the edge of the cube around all means, and a voxel's node is the merge of the Gaussians in it (the
formulas of `lod_cloud.merge`, as `lod_cloud.siblings` has them). Levels end where voxels are as
small as the median Gaussian is long; a voxel with a single Gaussian is that Gaussian. So a node's
depth is its level, and the tree is one like any other: `lod_cloud.search.octree_gs` applies
the original's rule to it, all other searches theirs.
"""

from __future__ import annotations

import math

import numpy as np

from gaussians.constants import OPACITY_LIMIT
from gaussians.errors import InputError
from gaussians.placement import point
from gaussians.scene import Scene, concatenate
from lod_cloud.imports.numbering import tree_from_parents
from lod_cloud.lod_tree import Int32, LodTree, Point, TreeMetadata
from lod_cloud.siblings import merge_ranges
from lod_cloud.spheres import enclose_levels, own_spheres

LEVEL_LIMIT = 20  # three coordinates of so many bits fit in 64
STRUCTURE = "octree"  # metadata.build["structure"]
MERGE = "opacity x surface"  # metadata.build["merge"], as of any tree that is merged so


def build_octree(
    scene: Scene,
    *,
    up: Point = (0.0, -1.0, 0.0),
    units_per_metre: float = 1.0,
    start: Point | None = None,
) -> LodTree:
    """Octree over all Gaussians of a scene in metres; the rest is only recorded.

    Raises InputError for an empty or invalid scene, and where merged opacities exceed 1e6.
    """
    if len(scene) == 0:
        raise InputError("an octree needs at least one Gaussian; the scene is empty")
    scene.validate()
    means = scene.means.astype(np.float64)
    low, edge = means.min(axis=0), float(np.ptp(means, axis=0).max())
    longest = own_spheres(scene)[1]
    levels = _levels(edge, float(np.median(longest)))
    codes = _morton(means, low, edge, levels)
    ids = np.argsort(codes, kind="stable").astype(np.int32)
    bounds, parent = _voxels(codes[ids], levels)
    leaves = scene.take(ids)
    merged = merge_ranges(leaves, bounds)
    densest = float(merged.opacities.max(initial=0.0))
    if not densest <= OPACITY_LIMIT:
        raise InputError(f"merged opacities must not exceed {OPACITY_LIMIT:g}, not {densest:g}")
    gaussians = concatenate([merged, leaves])
    radius, extent = own_spheres(gaussians)
    build = {
        "structure": STRUCTURE,
        "merge": MERGE,
        "levels": levels,
        "edge_m": edge,
    }
    bounds_m = point(low), point(means.max(axis=0))
    leaf_id = np.concatenate([np.full(len(merged), -1, np.int32), ids])
    metadata = TreeMetadata(bounds_m, up, units_per_metre, start, build=build)
    tree = tree_from_parents(parent, gaussians, radius, extent, leaf_id, metadata)
    enclose_levels(tree.parent, tree.level_offsets, tree.gaussians.means, tree.radius, tree.extent)
    return tree


def _levels(edge: float, finest: float) -> int:
    """Levels of voxels, the first of which has one; at most ``LEVEL_LIMIT``."""
    if not edge > 0:
        return 1
    if not finest > 0:
        return LEVEL_LIMIT
    return min(LEVEL_LIMIT, 1 + max(0, math.floor(math.log2(edge / finest))))


def _morton(means: np.ndarray, low: np.ndarray, edge: float, levels: int) -> np.ndarray:
    """[N] voxel of the finest level, coordinates bit by bit: a prefix is a voxel further up."""
    cells = 1 << (levels - 1)
    scaled = (means - low) * (cells / edge if edge > 0 else 0.0)
    places = np.minimum(scaled.astype(np.int64), cells - 1)
    codes = np.zeros(len(means), np.int64)
    for bit in range(levels - 1):
        for axis in range(3):
            codes |= (places[:, axis] >> bit & 1) << (3 * bit + axis)
    return codes


def _voxels(codes: np.ndarray, levels: int) -> tuple[Int32, Int32]:
    """Voxels with several Gaussians, level by level: their ranges [V, 2] of the sorted codes, and
    the parent of every voxel and then every Gaussian [V + N]; -1 for the root.
    """
    count = len(codes)
    home = np.full(count, -1, np.int64)  # deepest voxel of each Gaussian so far
    ranges, parents, known = [np.empty((0, 2), np.int64)], [np.empty(0, np.int64)], 0
    for level in range(levels):
        prefix = codes >> 3 * (levels - 1 - level)
        begins = np.flatnonzero(np.r_[True, prefix[1:] != prefix[:-1]])
        ends = np.r_[begins[1:], count]
        several = ends - begins > 1
        begins, ends = begins[several], ends[several]
        ranges.append(np.stack([begins, ends], axis=1))
        parents.append(home[begins])
        inside = np.repeat(np.arange(len(begins)), ends - begins)
        home[np.repeat(begins, ends - begins) + _within(ends - begins)] = known + inside
        known += len(begins)
    bounds = np.concatenate(ranges).astype(np.int32)
    return bounds, np.concatenate([*parents, home]).astype(np.int32)


def _within(sizes: np.ndarray) -> np.ndarray:
    """0 .. size - 1 for each size, one after another."""
    return np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
