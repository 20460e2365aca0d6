"""Layouts as trees: one subtree per placed copy (instance), joined by a small tree on top.

Every base scene becomes a tree once. An instance is that tree, turned, scaled and moved; its node
spheres are wrapped anew around the placed nodes, because rounding to float32 far from the origin
would break nesting otherwise. The roots of all instances are the leaves of an ordinary tree
(`lod_cloud.build`). No node mixes two instances below their roots.

*Order.* Breadth-first numbering with siblings together keeps the order from left to right at every
level. So each level of an instance is one block of a level of the whole tree, and where it starts
follows from counting: instances are placed one after another and go straight to their rows in the
files. Memory: the base trees and a copy per thread, whatever the number of instances.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gaussians.composition import Composition
from gaussians.errors import InputError
from gaussians.parallel import run_chunks
from gaussians.placement import point
from gaussians.rotations import rotations_from_quaternions
from gaussians.scene import FIELDS, Scene
from gaussians.transforms import transformed
from lod_cloud.array_file import ArrayFile
from lod_cloud.build import BuildOptions, BuildTimes, build_tree
from lod_cloud.criterion import prove_nesting
from lod_cloud.lod_tree import ARRAYS, Float32, Int32, LodTree, Point, TreeMetadata
from lod_cloud.spheres import enclose_levels, own_spheres
from lod_cloud.tree_files import TreeWriter

Int64 = NDArray[np.int64]
_NODE_LIMIT = 2**31 - 1  # node ids are int32
_DEFAULT = BuildOptions()


def build_instanced_files(
    composition: Composition,
    directory: str | os.PathLike[str],
    *,
    up: Point = (0.0, -1.0, 0.0),
    units_per_metre: float = 1.0,
    start: Point | None = None,
    options: BuildOptions = _DEFAULT,
) -> BuildTimes:
    """The tree of a whole composition as a directory, however many Gaussians it composes to.

    Lengths of the composition are divided by ``units_per_metre``. Leaf ids are those of
    ``composition.compose()``, whose Gaussians the leaves equal but for the rounding of the scale.
    Nesting is proved on every edge before the directory takes its name. Raises InputError as
    `build_tree` and `save_tree` do and for more than 2^31 - 1 nodes, RuntimeError if the proof
    failed.
    """
    begin, cpu = time.perf_counter(), os.times().user
    copies = _Copies.of(composition, units_per_metre, options)
    top = build_tree(copies.roots())
    places = _Places.of(top, copies)
    metadata = TreeMetadata(
        copies.bounds(), up, units_per_metre, start, build=top.metadata.build | _RECORD
    )
    counts = {
        "nodes": int(places.level_offsets[-1]),
        "leaves": composition.count(),
        "levels": len(places.level_offsets) - 1,
        "sh_degree": copies.trees[0].sh_degree,
    }
    with TreeWriter(directory, counts, metadata) as writer:
        files = _open(writer, places.level_offsets, copies.trees[0].gaussians.sh.shape[1])
        spheres = np.empty((len(copies), 2), np.float32)
        run_chunks(_write_copies, len(copies), copies, places, files, spheres)
        _write_top(top, places, spheres, files)
        cpu_s = os.times().user - cpu
        proof = time.perf_counter()
        violations = prove_nesting(writer.tree())
        if violations:
            raise RuntimeError(f"the tree is not nested: {violations} violations; nothing is kept")
        proof_s = time.perf_counter() - proof
        disk_s = writer.finish()
    return BuildTimes(time.perf_counter() - begin - disk_s - proof_s, cpu_s, proof_s, disk_s)


_RECORD = {"structure": "instances"}


@dataclass(frozen=True)
class _Copies:
    """The base trees, all of one SH degree, and where their I copies go; metres."""

    trees: list[LodTree]
    bases: Int64  # [I]
    rotations: NDArray[np.float64]  # [I, 3, 3]
    scales: NDArray[np.float64]  # [I]
    positions: NDArray[np.float64]  # [I, 3]

    def __len__(self) -> int:
        return len(self.bases)

    @classmethod
    def of(cls, composition: Composition, units: float, options: BuildOptions) -> _Copies:
        if not (np.isfinite(units) and units > 0):
            raise InputError(f"units per metre must be a positive number, not {units}")
        width = max(base.sh.shape[1] for base in composition.bases)
        trees = [build_tree(_widened(base, width), options=options) for base in composition.bases]
        instances = composition.instances
        rotations = rotations_from_quaternions(instances.quaternions)
        scales, positions = instances.scales / units, instances.positions / units
        return cls(trees, instances.bases, rotations, scales, positions)

    def tree(self, index: int) -> LodTree:
        return self.trees[self.bases[index]]

    def place(self, index: int, scene: Scene) -> Scene:
        """Gaussians of a base where one of its copies has them."""
        x, y, z = (float(c) for c in self.positions[index])
        scale = float(self.scales[index])
        return transformed(scene, self.rotations[index], scale, (x, y, z))

    def roots(self) -> Scene:
        """[I] the root of every copy."""
        root = np.zeros(1, np.int64)
        placed = [
            self.place(index, self.tree(index).gaussians.take(root)) for index in range(len(self))
        ]
        return Scene(*(np.concatenate([getattr(s, f) for s in placed]) for f in FIELDS))

    def bounds(self) -> tuple[Point, Point]:
        """Of boxes around the placed boxes of the bases' leaves."""
        corners = np.array([t.metadata.bounds for t in self.trees])[self.bases]  # [I, 2, 3]
        middle, half = corners.mean(axis=1), np.abs(corners[:, 1] - corners[:, 0]) / 2
        centre = np.einsum("i,ijk,ik->ij", self.scales, self.rotations, middle) + self.positions
        reach = np.einsum("i,ijk,ik->ij", self.scales, np.abs(self.rotations), half)
        low, high = (centre - reach).min(axis=0), (centre + reach).max(axis=0)
        return point(low), point(high)

    def first_leaf_ids(self) -> Int64:
        """[I] id of a copy's first Gaussian in the composition."""
        sizes = np.array([tree.leaves for tree in self.trees])[self.bases]
        return np.cumsum(sizes) - sizes


def _widened(scene: Scene, coefficients: int) -> Scene:
    missing = coefficients - scene.sh.shape[1]
    sh = np.pad(scene.sh, ((0, 0), (0, missing), (0, 0)))
    return replace(scene, sh=sh)


@dataclass(frozen=True)
class _Places:
    """Where the nodes of the top tree and the levels of every copy stand in the whole tree."""

    level_offsets: Int32  # [levels + 1]
    top: Int32  # [nodes of the top tree]; of a leaf: the root of its copy
    parents: Int32  # [I] of the copies' roots
    blocks: list[list[int]]  # [I][levels of the copy] where each of its levels begins

    @classmethod
    def of(cls, top: LodTree, copies: _Copies) -> _Places:
        """Counts level by level, from left to right."""
        depth = np.repeat(np.arange(top.levels), np.diff(top.level_offsets))
        ranks = _ranks(top)
        sizes = [np.diff(tree.level_offsets) for tree in copies.trees]
        copy_of = top.leaf_id
        starts = np.empty(len(top), np.int64)
        blocks: list[list[int]] = [[] for _ in range(len(copies))]
        offsets = [0]
        waiting = np.zeros(0, np.int64)  # top leaves whose copies reach into the level
        level = 0
        while level < top.levels or len(waiting):
            fresh = np.flatnonzero(depth == level)
            here = np.concatenate([fresh, waiting])
            here = here[np.argsort(ranks[here], kind="stable")]
            begin = offsets[-1]
            for node in here.tolist():
                if depth[node] == level:
                    starts[node] = begin
                if copy_of[node] < 0:
                    begin += 1
                    continue
                copy = int(copy_of[node])
                blocks[copy].append(begin)
                begin += int(sizes[copies.bases[copy]][level - depth[node]])
            offsets.append(begin)
            lasting = here[copy_of[here] >= 0]
            tallest = np.array([len(s) for s in sizes])[copies.bases[copy_of[lasting]]]
            level += 1
            waiting = lasting[level - depth[lasting] < tallest]
        if offsets[-1] > _NODE_LIMIT:
            raise InputError(f"a tree must have at most {_NODE_LIMIT} nodes, not {offsets[-1]}")
        parents = np.where(top.parent >= 0, starts[top.parent], -1).astype(np.int32)
        return cls(
            np.array(offsets, np.int32),
            starts.astype(np.int32),
            parents[top.leaf_nodes()],
            blocks,
        )


def _ranks(top: LodTree) -> Int64:
    """Place of every node's first leaf, counted from left to right."""
    leaves = (top.child_count == 0).astype(np.int64)
    for node in range(len(top) - 1, 0, -1):
        leaves[top.parent[node]] += leaves[node]
    ranks = np.zeros(len(top), np.int64)
    for node in np.flatnonzero(top.child_count).tolist():
        next_rank = ranks[node]
        for child in range(top.first_child[node], top.first_child[node] + top.child_count[node]):
            ranks[child] = next_rank
            next_rank += leaves[child]
    return ranks


# ---------------------------------------------------------------- to the files

_Files = dict[str, ArrayFile]


def _open(writer: TreeWriter, level_offsets: Int32, coefficients: int) -> _Files:
    writer.put("level_offsets", level_offsets)
    count = int(level_offsets[-1])
    shapes: dict[str, tuple[int, ...]] = {
        "means": (3,),
        "quaternions": (4,),
        "scales": (3,),
        "opacities": (),
        "sh": (coefficients, 3),
    }
    kinds = {n: kind for n, kind in ARRAYS.items() if n != "level_offsets"}
    kinds |= dict.fromkeys(FIELDS, np.float32)
    return {n: writer.array(n, (count, *shapes.get(n, ())), kind) for n, kind in kinds.items()}


def _write_copies(
    begin: int, end: int, copies: _Copies, places: _Places, files: _Files, spheres: Float32
) -> None:
    """Copies ``begin`` .. ``end``; leaves R and e of their roots in ``spheres`` [I, 2]."""
    first_ids = copies.first_leaf_ids()
    for index in range(begin, end):
        tree = copies.tree(index)
        gaussians = copies.place(index, tree.gaussians)
        radius, extent = own_spheres(gaussians)
        enclose_levels(tree.parent, tree.level_offsets, gaussians.means, radius, extent)
        spheres[index] = radius[0], extent[0]
        leaf = tree.leaf_id >= 0
        columns = {field: getattr(gaussians, field) for field in FIELDS}
        columns |= {"radius": radius, "extent": extent, "child_count": tree.child_count}
        columns["leaf_id"] = np.where(leaf, tree.leaf_id + first_ids[index], -1).astype(np.int32)
        columns |= _links(tree, places.blocks[index], int(places.parents[index]))
        for block, (low, high) in zip(
            places.blocks[index], pairwise(tree.level_offsets.tolist()), strict=True
        ):
            for name, column in columns.items():
                files[name].write(block, column[low:high])


def _links(tree: LodTree, blocks: list[int], above: int) -> dict[str, Int32]:
    """Parents and first children of one copy's nodes, by their numbers in the whole tree."""
    shifts = np.array(blocks) - tree.level_offsets[:-1]
    level = np.repeat(np.arange(tree.levels), np.diff(tree.level_offsets))
    parent = tree.parent + shifts[np.maximum(level - 1, 0)]
    parent[0] = above
    first = tree.first_child + shifts[np.minimum(level + 1, tree.levels - 1)]
    first[tree.child_count == 0] = -1
    return {"parent": parent.astype(np.int32), "first_child": first.astype(np.int32)}


def _write_top(top: LodTree, places: _Places, spheres: Float32, files: _Files) -> None:
    """Everything above the copies' roots, around the spheres these have."""
    radius, extent = own_spheres(top.gaussians)
    radius[top.leaf_nodes()], extent[top.leaf_nodes()] = spheres.T
    enclose_levels(top.parent, top.level_offsets, top.gaussians.means, radius, extent)
    inner = np.flatnonzero(top.child_count)
    columns = {field: getattr(top.gaussians, field)[inner] for field in FIELDS}
    columns |= {
        "radius": radius[inner],
        "extent": extent[inner],
        "child_count": top.child_count[inner],
        "leaf_id": np.full(len(inner), -1, np.int32),
        "parent": np.where(inner > 0, places.top[top.parent[inner]], -1).astype(np.int32),
        "first_child": places.top[top.first_child[inner]],
    }
    for row, number in enumerate(places.top[inner].tolist()):
        for name, column in columns.items():
            files[name].write(number, column[row : row + 1])
