"""Trees other than merged pairs: of trained levels in boxes, of copies in a layout, of voxels."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from gaussians.errors import InputError
from gaussians.formats import load_lod_set
from gaussians.formats.layout import read_composition
from gaussians.placement import Point, parse_view, point
from gaussians.rotations import up_vector
from lod_cloud import BuildOptions, BuildTimes, LodTree, prove_nesting, save_tree
from lod_cloud.imports import build_block_tree, build_instanced_files, build_octree
from nebula.options import BuildTreeOptions
from nebula.progress import progress
from nebula.scene_input import SceneInput, load

_Result = tuple[str, float, BuildTimes]  # name of the scene, seconds of reading it, of the build


def build_imported(options: BuildTreeOptions, rules: BuildOptions) -> _Result:
    """Build ``options.structure`` (not "merged") into ``options.out``.

    Raises InputError where the scene has no such structure.
    """
    source, level = options.scene.scene, options.scene.level
    if options.structure == "octree":
        if rules != BuildOptions():
            raise InputError(
                "--structure octree merges voxels; --pair-within and --fan-out-ratio: not of use"
            )
        return _octree(options)
    if not isinstance(source, Path):
        raise InputError(f"--structure {options.structure} needs a file: --scene must be given")
    if level is not None:
        raise InputError(f"--structure {options.structure} takes every level; --level: not of use")
    if options.structure == "blocks":
        return _blocks(source, options, rules)
    return _instances(source, options, rules)


def _blocks(path: Path, options: BuildTreeOptions, rules: BuildOptions) -> _Result:
    begin = time.perf_counter()
    with progress(f"reading {path}"):
        levels = load_lod_set(path / "lod-meta.json" if path.is_dir() else path)
    place = load(options.scene, options.seed)
    read_s = time.perf_counter() - begin
    make = partial(build_block_tree, levels, options=rules)
    return place.name, read_s, _in_memory(make, place, options)


def _octree(options: BuildTreeOptions) -> _Result:
    begin = time.perf_counter()
    place = load(options.scene, options.seed)
    read_s = time.perf_counter() - begin
    return place.name, read_s, _in_memory(partial(build_octree, place.scene), place, options)


def _in_memory(
    make: Callable[..., LodTree], place: SceneInput, options: BuildTreeOptions
) -> BuildTimes:
    """Build, prove and save a tree that stands where its scene does."""
    with progress(f"building {options.out}"):
        begin, cpu = time.perf_counter(), os.times().user
        tree = make(
            up=point(up_vector(place.placement.up)),
            units_per_metre=place.placement.units_per_metre,
            start=point(place.view.position),
        )
        build_s, cpu_s = time.perf_counter() - begin, os.times().user - cpu
        begin = time.perf_counter()
        violations = prove_nesting(tree)
        if violations:
            raise RuntimeError(f"the tree is not nested: {violations} violations; nothing is kept")
        proved = time.perf_counter()
        save_tree(tree, options.out)
    return BuildTimes(build_s, cpu_s, proved - begin, time.perf_counter() - proved)


def _instances(path: Path, options: BuildTreeOptions, rules: BuildOptions) -> _Result:
    """Starts at the given view, else at the layout's first camera, if it has one."""
    begin = time.perf_counter()
    with progress(f"reading {path}"):
        composition, layout, _ = read_composition(path)
    read_s = time.perf_counter() - begin
    scene = options.scene
    eyes = [camera.pose.position.tolist() for camera in layout.cameras[:1]]
    if scene.view is not None:
        eyes = [parse_view(scene.view)[0]]
    start: Point | None = None
    for x, y, z in eyes:
        start = x / scene.units_per_metre, y / scene.units_per_metre, z / scene.units_per_metre
    with progress(f"building {options.out}"):
        times = build_instanced_files(
            composition,
            options.out,
            up=point(up_vector(scene.up or "-y")),
            units_per_metre=scene.units_per_metre,
            start=start,
            options=rules,
        )
    return path.name, read_s, times
