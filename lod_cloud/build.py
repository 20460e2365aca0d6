"""Builds the LoD tree of a scene, in memory or straight into a directory.

*Structure*: the Gaussians are split at the median of the longest axis of their means' box, as in
HierGS (doi:10.1145/3658160); on the way back up, the cheapest pair of ``pair_within`` neighbours
merges first (`lod_cloud.merge`; 1 makes the nodes those of the split). Small steps can be left
out (``fan_out_ratio``, `lod_cloud.numbering`). *Interior nodes*: the merge of their children. *Node
spheres*, float64 rounded up to float32, from the node's own 3-sigma box (axis-aligned, centred at
its mean) and its children's spheres:

    R = max(half diagonal of the box, max over children (R_ch + |m_ch - m|) (1 + 2^-19))
    e = max(longest side of the box,  max over children e_ch (1 + 2^-19))

The same scene gives the same bits on any number of threads, in memory and on disk. Memory: about
120 B per leaf beside scene and result; harmonics pass through in blocks. Memory that is touched for
the first time costs a build more than filling it, so arrays are few and small.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from gaussians.parallel import run_chunks
from gaussians.scene import FIELDS, Scene
from lod_cloud.criterion import LENGTH_LIMIT_M, prove_nesting
from lod_cloud.harmonics import MemoryRows, merge_harmonics
from lod_cloud.lod_tree import Int32, LodTree, Point, TreeMetadata
from lod_cloud.merge import merge_leaves
from lod_cloud.nodes import FINISHED, Nodes
from lod_cloud.numbering import Numbering, number_nodes
from lod_cloud.pairing import MOST_SLOTS
from lod_cloud.spheres import tighten_spheres
from lod_cloud.split import split_order
from lod_cloud.tree_files import TreeWriter

Float64 = NDArray[np.float64]

PAIR_WITHIN = 16
_CHECKED_ROWS = 1 << 16
_WRITTEN_ROWS = 1 << 16
_MAPPED_BYTES = 1 << 29  # of leaves, about, that may stay mapped


@dataclass(frozen=True)
class BuildOptions:
    """How leaves become a tree. Raises InputError for values out of range."""

    pair_within: int = PAIR_WITHIN  # neighbours whose cheapest pairs merge first; 1: none
    fan_out_ratio: float = 1.0  # nodes larger than this share of their parent are left out

    def __post_init__(self) -> None:
        if not 1 <= self.pair_within <= MOST_SLOTS:
            raise InputError(f"pair_within must lie in 1..{MOST_SLOTS}, not {self.pair_within}")
        if not 0 < self.fan_out_ratio <= 1:
            raise InputError(f"fan_out_ratio must lie in 0..1, not {self.fan_out_ratio}")


_DEFAULT = BuildOptions()


@dataclass(frozen=True)
class BuildTimes:
    """Seconds of a build into a directory: on the wall, unless said otherwise."""

    build: float  # everything but the two below
    user_cpu: float  # of all threads in that, outside the kernel: does not depend on other load
    proof: float  # nesting
    disk: float  # writing, reading back, checksums


def build_tree(
    scene: Scene,
    *,
    up: Point = (0.0, -1.0, 0.0),
    units_per_metre: float = 1.0,
    start: Point | None = None,
    path: tuple[Point, ...] = (),
    options: BuildOptions = BuildOptions(),  # frozen
) -> LodTree:
    """LoD tree whose leaves are the scene's Gaussians; up, units, start, path are only recorded.

    Raises InputError for an empty or invalid scene, for coordinates or sizes beyond 1e12 m, and
    where merged opacities exceed 1e6.
    """
    numbering, nodes = _without_harmonics(scene, options, _Mapped(scene))
    count = len(numbering)
    arrays = {name: np.empty((count, *shape), np.float32) for name, shape in FINISHED.items()}
    leaf_id, masses = np.empty(count, np.int32), np.empty(count)

    def finish(begin: int, end: int) -> None:
        out = tuple(array[begin:end] for array in arrays.values())
        nodes.finish(begin, end, numbering.nodes, leaf_id, masses, out)

    run_chunks(finish, count)
    sh = np.empty((count, *scene.sh.shape[1:]), np.float32)
    merge_harmonics(numbering, masses, leaf_id, _flat(scene), MemoryRows(sh.reshape(count, -1)))
    gaussians = Scene(**{name: arrays[name] for name in FIELDS[:-1]}, sh=sh)
    metadata = TreeMetadata(_bounds(scene), up, units_per_metre, start, path, _record(options))
    return LodTree(
        numbering.parent,
        numbering.first_child,
        numbering.child_count,
        numbering.level_offsets,
        gaussians,
        arrays["radius"],
        arrays["extent"],
        leaf_id,
        metadata,
    )


def build_tree_files(
    scene: Scene,
    directory: str | os.PathLike[str],
    *,
    up: Point = (0.0, -1.0, 0.0),
    units_per_metre: float = 1.0,
    start: Point | None = None,
    path: tuple[Point, ...] = (),
    options: BuildOptions = _DEFAULT,
    release: Callable[[], None] = lambda: None,
) -> BuildTimes:
    """The tree of `build_tree` as a directory, without ever holding its harmonics in memory.

    The scene may be memory-mapped (`lod_cloud.leaf_spool`); ``release`` is called now and then
    to let go of what was read of it. Nesting is proved on every edge before the directory takes
    its name. Raises as `build_tree` and `save_tree` do, and RuntimeError if the proof failed.
    """
    begin, cpu = time.perf_counter(), os.times().user
    mapped = _Mapped(scene, release)
    numbering, nodes = _without_harmonics(scene, options, mapped)
    metadata = TreeMetadata(_bounds(scene), up, units_per_metre, start, path, _record(options))
    counts = {
        "nodes": len(numbering),
        "leaves": len(scene),
        "levels": len(numbering.level_offsets) - 1,
        "sh_degree": scene.sh_degree,
    }
    with TreeWriter(directory, counts, metadata) as writer:
        leaf_id, masses = _write_nodes(writer, numbering, nodes, mapped)
        del nodes
        sh = writer.array("sh", (len(numbering), *scene.sh.shape[1:]), np.float32)
        merge_harmonics(numbering, masses, leaf_id, _flat(scene), sh, mapped.was_read)
        release()
        cpu_s = os.times().user - cpu
        proof = time.perf_counter()
        violations = prove_nesting(writer.tree())
        if violations:
            raise RuntimeError(f"the tree is not nested: {violations} violations; nothing is kept")
        proof_s = time.perf_counter() - proof
        disk_s = writer.finish()
    return BuildTimes(time.perf_counter() - begin - disk_s - proof_s, cpu_s, proof_s, disk_s)


def _write_nodes(
    writer: TreeWriter, numbering: Numbering, nodes: Nodes, mapped: _Mapped
) -> tuple[Int32, Float64]:
    """All arrays of the finished tree but harmonics; returns ids of leaves, and masses."""
    for name in ("parent", "first_child", "child_count", "level_offsets"):
        writer.put(name, getattr(numbering, name))
    count = len(numbering)
    leaf_id, masses = np.empty(count, np.int32), np.empty(count)
    files = [writer.array(name, (count, *shape), np.float32) for name, shape in FINISHED.items()]

    def finish(begin: int, end: int) -> None:
        for low in range(begin, end, _WRITTEN_ROWS):
            high = min(low + _WRITTEN_ROWS, end)
            out = tuple(file.target(low, high) for file in files)
            nodes.finish(low, high, numbering.nodes, leaf_id, masses, out)
            mapped.was_read((high - low) // 2)
            for file, rows in zip(files, out, strict=True):
                file.write(low, rows)

    run_chunks(finish, count)
    writer.put("leaf_id", leaf_id)
    return leaf_id, masses


class _Mapped:
    """Leaves that may be memory-mapped: has them let go of when enough of them were read."""

    def __init__(self, scene: Scene, release: Callable[[], None] = lambda: None) -> None:
        self._release, self._since, self._lock = release, 0, threading.Lock()
        widths = (math.prod(getattr(scene, name).shape[1:]) for name in FIELDS)
        self._most = _MAPPED_BYTES // (4 * sum(widths))

    def was_read(self, leaves: int) -> None:
        """So many more, by this thread; others may still read theirs."""
        with self._lock:
            self._since += leaves
            if self._since < self._most:
                return
            self._since = 0
        self._release()


def _without_harmonics(
    scene: Scene, options: BuildOptions, mapped: _Mapped
) -> tuple[Numbering, Nodes]:
    """The nodes of the unfinished tree and their places in the finished one."""
    _check(scene, mapped)
    ids = split_order(scene.means, options.pair_within)
    nodes, children = merge_leaves(scene, ids, options.pair_within, was_read=mapped.was_read)
    numbering = number_nodes(children, 2 * len(scene) - 2, nodes.extent, options.fan_out_ratio)
    if options.fan_out_ratio < 1:
        tighten_spheres(numbering, nodes)
    return numbering, nodes


def _check(scene: Scene, mapped: _Mapped) -> None:
    """In blocks, which needs little memory; the whole scene only to word the error."""
    if len(scene) == 0:
        raise InputError("a tree needs at least one Gaussian; the scene is empty")

    def block(begin: int, end: int) -> float:
        largest = 0.0
        for low in range(begin, end, _CHECKED_ROWS):
            rows = slice(low, min(low + _CHECKED_ROWS, end))
            part = Scene(*(getattr(scene, f)[rows] for f in FIELDS)).validate()
            largest = max(largest, float(np.abs(part.means).max()), float(part.scales.max()))
            mapped.was_read(len(part))
        return largest

    try:
        largest = max(run_chunks(block, len(scene)))
    except InputError:
        scene.validate()
        raise
    if largest > LENGTH_LIMIT_M:
        raise InputError(
            f"coordinates and scales must lie within {LENGTH_LIMIT_M:g} m, not {largest:g}"
        )


def _bounds(scene: Scene) -> tuple[Point, Point]:
    axes = scene.means.T  # one at a time: along the first axis of three numbers numpy is slow
    low, high = (tuple(float(f(axis)) for axis in axes) for f in (np.min, np.max))
    return low, high  # type: ignore[return-value]  # two tuples of three by construction


def _record(options: BuildOptions) -> dict[str, object]:
    return {
        "split": "median of the longest axis",
        "merge": "opacity x surface",
        "interior": "merged",  # of their children; nothing was trained afterwards
        "margin": "2^-19",
        "pair_within": options.pair_within,
        "fan_out_ratio": options.fan_out_ratio,
    }


def _flat(scene: Scene) -> np.ndarray:
    return scene.sh.reshape(len(scene), -1)
