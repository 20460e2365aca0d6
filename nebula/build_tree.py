"""``nebula build-tree``: the level-of-detail tree of a scene, as a directory."""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gaussians.errors import InputError
from gaussians.parallel import threads
from gaussians.placement import point
from gaussians.rotations import up_vector
from gaussians.synthetic import TiledCity
from lod_cloud import (
    BuildOptions,
    BuildTimes,
    LeafSpool,
    LodTree,
    build_tree,
    build_tree_files,
    load_tree,
)
from nebula.imported_tree import build_imported
from nebula.options import BuildTreeOptions, TiledTree
from nebula.output import CommandResult
from nebula.progress import progress
from nebula.scene_input import SceneInput, load


def tree_of(place: SceneInput) -> LodTree:
    """The tree of a scene that has been read, in metres, with its start and walkable path."""
    return build_tree(place.scene, **_position(place))


@dataclass(frozen=True)
class _Built:
    """How long it took to get the leaves and to build their tree, seconds."""

    scene: str
    generate: float  # or read
    spool: float  # leaves to disk, where they do not fit in memory
    times: BuildTimes


def run(options: BuildTreeOptions) -> CommandResult:
    """Build, prove nesting on every edge, and save; nothing is kept when a step fails."""
    rules = BuildOptions(options.pair_within, options.fan_out_ratio)
    if options.tiled is not None:
        built = _of_tiles(options.tiled, options, rules)
    elif options.structure != "merged":
        name, read_s, times = build_imported(options, rules)
        built = _Built(name, read_s, 0.0, times)
    else:
        built = _of_scene(options, rules)
    tree = load_tree(options.out)
    leaves = int(np.count_nonzero(tree.leaf_id >= 0))
    times = built.times
    data: dict[str, Any] = {
        "scene": built.scene,
        "out": str(options.out),
        "leaves": leaves,
        "nodes": len(tree),
        "levels": tree.levels,
        "sh_degree": tree.sh_degree,
        "build": tree.metadata.build,
        "nesting_violations": 0,
        "generate_s": built.generate,
        "spool_s": built.spool,
        "build_s": times.build,
        "build_user_cpu_s": times.user_cpu,
        "proof_s": times.proof,
        "disk_s": times.disk,
        "threads": threads(),
        "peak_rss_bytes": peak_rss_bytes(),
    }
    text = (
        f"{built.scene}: {leaves} leaves, {len(tree)} nodes, {tree.levels} levels\n"
        f"built in {times.build:.2f} s ({1e6 * times.build / leaves:.2f} s per million leaves, "
        f"{threads()} threads, {1e6 * times.user_cpu / leaves:.2f} CPU-s per million); "
        f"nesting proved on {len(tree) - 1} edges in {times.proof:.2f} s\n"
        f"not counted: {built.generate:.2f} s to get the leaves, "
        f"{built.spool + times.disk:.2f} s of disk\n"
        f"peak memory {data['peak_rss_bytes'] / 2**30:.2f} GiB\n{options.out}"
    )
    return CommandResult(data, text)


def peak_rss_bytes() -> int:
    """Most memory this process has held."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def _of_scene(options: BuildTreeOptions, rules: BuildOptions) -> _Built:
    begin = time.perf_counter()
    place = load(options.scene, options.seed)
    generate_s = time.perf_counter() - begin
    with progress(f"building {options.out}"):
        times = build_tree_files(place.scene, options.out, options=rules, **_position(place))
    return _Built(place.name, generate_s, 0.0, times)


def _of_tiles(tiled: TiledTree, options: BuildTreeOptions, rules: BuildOptions) -> _Built:
    """The leaves pass through a spool beside the tree, so that they need not fit in memory."""
    city = TiledCity(tiled.leaves, tiled.density, options.seed, tiled.sh_degree)
    name = f"{tiled.density} of {city.leaves} leaves, seed {city.seed}"
    path = [point(p) for p in city.path]
    folder = _existing_parent(options.out)
    begin = time.perf_counter()
    with (
        tempfile.TemporaryDirectory(prefix=".leaves.", dir=folder) as scratch,
        LeafSpool(Path(scratch), city.leaves, city.sh_degree) as spool,
    ):
        done = 0
        with progress(f"generating {name}", 100) as step:
            for tile in city.tiles():
                spool.append(tile)
                before, done = 100 * done // city.leaves, done + len(tile)
                for _ in range(before, 100 * done // city.leaves):
                    step()
        generate_s = time.perf_counter() - begin - spool.seconds
        with progress(f"building {options.out}"):
            times = build_tree_files(
                spool.scene(),
                options.out,
                up=(0.0, 0.0, 1.0),
                start=path[0],
                path=tuple(path),
                options=rules,
                release=spool.release,
            )
        return _Built(name, generate_s, spool.seconds, times)


def _existing_parent(target: Path) -> Path:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror}") from error
    return target.parent


def _position(place: SceneInput) -> dict[str, Any]:
    """What a tree records about where it stands."""
    return {
        "up": point(up_vector(place.placement.up)),
        "units_per_metre": place.placement.units_per_metre,
        "start": point(place.view.position),
        "path": place.walkable_path,
    }
