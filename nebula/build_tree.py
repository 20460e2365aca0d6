"""``nebula build-tree``: the level-of-detail tree of a scene, as a directory."""

from __future__ import annotations

import time
from typing import Any

from gaussians.rotations import up_vector
from lod_cloud import LodTree, build_tree, prove_nesting, save_tree
from nebula.options import BuildTreeOptions
from nebula.output import CommandResult
from nebula.progress import progress
from nebula.scene_input import SceneInput, load


def tree_of(place: SceneInput) -> LodTree:
    """The tree of a scene that has been read, in metres, with its start and walkable path."""
    x, y, z = (float(c) for c in place.view.position)
    ux, uy, uz = (float(c) for c in up_vector(place.placement.up))
    return build_tree(
        place.scene,
        up=(ux, uy, uz),
        units_per_metre=place.placement.units_per_metre,
        start=(x, y, z),
        path=place.walkable_path,
    )


def run(options: BuildTreeOptions) -> CommandResult:
    """Build, prove nesting on every edge, and save."""
    place = load(options.scene, options.seed)
    begin = time.perf_counter()
    with progress("building the tree"):
        tree = tree_of(place)
    build_s = time.perf_counter() - begin
    with progress("proving nesting"):
        violations = prove_nesting(tree)
    if violations:
        raise RuntimeError(f"the tree is not nested: {violations} violations; nothing was written")
    with progress(f"writing {options.out}"):
        save_tree(tree, options.out)
    data: dict[str, Any] = {
        "scene": place.name,
        "out": str(options.out),
        "leaves": tree.leaves,
        "nodes": len(tree),
        "levels": tree.levels,
        "sh_degree": tree.sh_degree,
        "nesting_violations": violations,
        "build_s": build_s,
    }
    text = (
        f"{place.name}: {tree.leaves} leaves, {len(tree)} nodes, {tree.levels} levels, "
        f"built in {build_s:.2f} s\n"
        f"nesting proved on {len(tree) - 1} edges\n{options.out}"
    )
    return CommandResult(data, text)
