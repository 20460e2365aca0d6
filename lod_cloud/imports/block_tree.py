"""Levels of detail that were trained one by one (`gaussians.formats.LodSet`) as one tree.

Such a set has boxes, and in each box a complete set of Gaussians per level; level 0 is the finest.
A viewer draws one level per box: a level switch replaces all of a box's Gaussians. A tree has one
Gaussian per node, so the Gaussians of a level become the parents of those of the next finer one:

* Every Gaussian of a finer level hangs below the nearest of the next coarser one *in its box* (by
  distance of means). No coarser Gaussian stays without children: one that is nobody's nearest takes
  the nearest finer Gaussian whose parent has others. So leaves are exactly the finest level, and
  the nodes of any one level are exactly that level: a cut that is one level *is* the shipped one.
* The nodes of a box and level are a group: they share R and e. e is the median longest side of the
  group's 3-sigma boxes; R the longest way, from mean to mean, from one of them down to a leaf. (In
  other trees R holds the boxes too: here a few large Gaussians would decide for all.) The node
  test measures from each Gaussian's own mean, so a group does not switch at one instant but as the
  camera's sphere of radius T passes through the box; outside that, the box is drawn at one level.
* Above the coarsest level of every box stands an ordinary tree of merged Gaussians.

A level that has more Gaussians in a box than the next finer one is of no use there and could not
get a child each; one without Gaussians has nothing to draw. Both are left out of that box, and
``metadata.build["left_out"]`` names them. A box without Gaussians at the finest level is left out
whole for the same reason. Interior Gaussians are *given*, not merged: a receiver cannot compute
them from their children (``metadata.build["interior"]``; no ``"merge"`` rule is recorded).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from gaussians.errors import InputError
from gaussians.formats.lod_meta import LodSet
from gaussians.placement import point
from gaussians.scene import Scene, concatenate
from lod_cloud.build import BuildOptions, build_tree
from lod_cloud.imports.numbering import tree_from_parents
from lod_cloud.lod_tree import Float32, Int32, LodTree, Point, TreeMetadata
from lod_cloud.spheres import enclose, enclose_levels, own_spheres

_NEIGHBOURS = 8
_DEFAULT = BuildOptions()


def build_block_tree(
    levels: LodSet,
    *,
    up: Point = (0.0, -1.0, 0.0),
    units_per_metre: float = 1.0,
    start: Point | None = None,
    options: BuildOptions = _DEFAULT,
) -> LodTree:
    """The tree of all levels at hand; leaf ids are the rows of the finest one.

    Lengths are divided by ``units_per_metre``. ``options`` concern the merged nodes above the
    coarsest levels. Raises InputError where `build_tree` does, and unless there are two levels.
    """
    if len(levels.levels) < 2:
        raise InputError(f"a block tree needs at least two levels, not {len(levels.levels)}")
    kept, left_out = _kept_levels(levels)
    scaled = {n: scene.scaled(1.0 / units_per_metre) for n, scene in levels.levels.items()}
    given = _given_nodes(levels, scaled, kept)
    top = build_tree(given.gaussians.take(given.roots), options=options)
    inner = np.flatnonzero(top.child_count)
    joints = top.leaf_nodes()
    rows = np.empty(len(top), np.int32)  # of the upper tree's nodes among all
    rows[inner] = len(given.parent) + np.arange(len(inner))
    rows[joints] = given.roots
    radius, extent = own_spheres(top.gaussians)
    radius[joints], extent[joints] = given.radius[given.roots], given.extent[given.roots]
    enclose_levels(top.parent, top.level_offsets, top.gaussians.means, radius, extent)
    parent = np.concatenate([given.parent, np.empty(len(inner), np.int32)])
    parent[rows] = np.where(top.parent >= 0, rows[top.parent], -1)
    ids = np.arange(len(parent), dtype=np.int32)
    build = {
        "structure": "blocks",
        "interior": "given",
        "above": top.metadata.build,
        "levels": sorted(scaled),
        "left_out": [list(pair) for pair in left_out],
    }
    finest = scaled[min(scaled)].means
    bounds = point(finest.min(axis=0)), point(finest.max(axis=0))
    return tree_from_parents(
        parent,
        concatenate([given.gaussians, top.gaussians.take(inner)]),
        np.concatenate([given.radius, radius[inner]]),
        np.concatenate([given.extent, extent[inner]]),
        np.where(ids < len(finest), ids, np.int32(-1)),
        TreeMetadata(bounds, up, units_per_metre, start, build=build),
    )


@dataclass(frozen=True)
class _Given:
    """Nodes that were trained: all kept groups, level after level from the finest."""

    gaussians: Scene  # [G]
    radius: Float32  # [G]
    extent: Float32  # [G]
    parent: Int32  # [G]; any value for ``roots``
    roots: Int32  # nodes of the coarsest level of each box


def _kept_levels(levels: LodSet) -> tuple[list[list[int]], list[tuple[int, int]]]:
    """Per box the levels that are drawn there, finest first; (box, level) of the others."""
    kept: list[list[int]] = []
    left_out: list[tuple[int, int]] = []
    names = sorted(levels.levels)
    for box in range(len(levels.leaf_boxes)):
        counts = {name: int(levels.leaf_ranges[name][box, 1]) for name in names}
        chosen: list[int] = []
        least = counts[names[0]]
        for name in names:
            if 0 < counts[name] <= least:
                chosen.append(name)
                least = counts[name]
            else:
                left_out.append((box, name))
        kept.append(chosen)
    return kept, left_out


def _given_nodes(levels: LodSet, scenes: dict[int, Scene], kept: list[list[int]]) -> _Given:
    """Groups, their spheres, and who hangs below whom."""
    groups: dict[tuple[int, int], slice] = {}
    parts, begin = [], 0
    for name in sorted(scenes):
        for box, chosen in enumerate(kept):
            if name in chosen:
                offset, count = (int(v) for v in levels.leaf_ranges[name][box])
                parts.append(scenes[name].take(np.arange(offset, offset + count)))
                groups[box, name] = slice(begin, begin + count)
                begin += count
    gaussians = concatenate(parts)
    radius, extent = np.zeros(begin, np.float32), own_spheres(gaussians)[1]
    for rows in groups.values():
        extent[rows] = np.float32(np.median(extent[rows]))
    parent = np.full(begin, -1, np.int32)
    roots = []
    for box, chosen in enumerate(kept):
        for fine, coarse in pairwise(chosen):
            lower, upper = groups[box, fine], groups[box, coarse]
            below, above = _rows(gaussians, lower), _rows(gaussians, upper)
            nearest = nearest_parents(below.means, above.means)
            parent[lower] = nearest + upper.start
            enclose(
                nearest,
                (below.means, radius[lower], extent[lower]),
                (above.means, radius[upper], extent[upper]),
            )
            radius[upper] = radius[upper].max()
        if chosen:
            group = groups[box, chosen[-1]]
            roots.append(np.arange(group.start, group.stop, dtype=np.int32))
    return _Given(gaussians, radius, extent, parent, np.concatenate(roots))


def _rows(scene: Scene, rows: slice) -> Scene:
    """Views of some rows."""
    return Scene(
        scene.means[rows],
        scene.quaternions[rows],
        scene.scales[rows],
        scene.opacities[rows],
        scene.sh[rows],
    )


def nearest_parents(fine: Float32, coarse: Float32) -> Int32:
    """[fine] which coarse Gaussian each finer one hangs below; every coarse one gets at least one.

    ``fine`` [F, 3] and ``coarse`` [C, 3] are means; InputError unless F >= C.
    """
    if len(fine) < len(coarse):
        raise InputError(f"{len(coarse)} parents need as many children, not {len(fine)}")
    from sklearn.neighbors import KDTree

    nearest = KDTree(coarse).query(fine, return_distance=False)[:, 0].astype(np.int32)
    counts = np.bincount(nearest, minlength=len(coarse))
    childless = np.flatnonzero(counts == 0)
    index, wanted = KDTree(fine), _NEIGHBOURS
    while len(childless):
        candidates = index.query(coarse[childless], min(wanted, len(fine)), return_distance=False)
        left = []
        for node, row in zip(childless.tolist(), candidates.tolist(), strict=True):
            child = next((c for c in row if counts[nearest[c]] > 1), None)
            if child is None:
                left.append(node)
                continue
            counts[nearest[child]] -= 1
            nearest[child], counts[node] = node, 1
        childless, wanted = np.array(left, np.int64), 4 * wanted
    return nearest
