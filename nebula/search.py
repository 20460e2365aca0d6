"""``nebula search``: LoD searches along a head trace in a stored tree, timed and compared."""

from __future__ import annotations

from typing import Any

import numpy as np

from gaussians.cameras import Pose, look_at
from gaussians.errors import InputError
from gaussians.placement import parse_view
from gaussians.rotations import level_rotation
from lod_cloud import LodTree, SearchRequest, load_tree
from lod_cloud.imports.octree import STRUCTURE
from lod_cloud.search import (
    SEARCHES,
    CityGaussianSearch,
    OctreeGsSearch,
    RuleSearch,
    SearchTree,
    make_search,
)
from nebula.options import SearchOptions
from nebula.output import CommandResult, text_table
from nebula.progress import progress
from nebula.scene_input import head_trace
from nebula.search_measurement import DROPPED, MEASURED, Measured, measure_rule, measure_search
from nebula.session_config import load_session_config

METHODS = (*SEARCHES, OctreeGsSearch.name, CityGaussianSearch.name)
_REFERENCE = "flat"


def run(options: SearchOptions) -> CommandResult:
    """One search every ``search_every`` frames by each method asked for; time, work, changes.

    The first 10 searches are not counted. Raises InputError when ``frames`` leaves none.
    """
    with progress(f"reading {options.tree}"):
        tree = load_tree(options.tree)
    requests = _requests(tree, options)
    methods = METHODS if options.compare else (options.method,)
    rows = measure_methods(methods, tree, requests, options.search_every, options.hysteresis)
    data: dict[str, Any] = {
        "tree": str(options.tree),
        "nodes": len(tree),
        "trace": options.scene.trace,
        "search_every": options.search_every,
        "tau_px": options.tau_px,
        "focal_px": options.scene.display.fx,
        "hysteresis": options.hysteresis,
        "rows": rows,
    }
    heads = ["method", "p50 ms", "p99 ms", "max ms", "tested", "bytes", "added", "removed", "set"]
    lines = [
        [
            row["method"],
            *(f"{row[key]:.3f}" for key in ("p50_ms", "p99_ms", "max_ms")),
            *(
                f"{row[f'{key}_mean']:.0f}"
                for key in ("nodes_tested", "bytes_touched", "adds", "removes", "cut_size")
            ),
            _verdict(row),
        ]
        for row in rows
    ]
    text = (
        f"{options.tree}: {len(tree)} nodes, {options.scene.trace}, a search every "
        f"{options.search_every} frames, tau {options.tau_px:g} px, {rows[0]['searches']} searches "
        f"counted, {rows[0]['threads']} threads\n\n"
    )
    table = text_table([*heads, "same cut as flat"], lines, numbers=range(1, 9))
    shares = ", ".join(f"{gap}: {share:.3%}" for gap, share in rows[0]["overlap"].items())
    return CommandResult(
        data, f"{text}{table}\n\noverlap with the cut so many frames ago: {shares}"
    )


def measure_methods(
    methods: tuple[str, ...],
    tree: LodTree,
    requests: list[SearchRequest],
    search_every: int,
    hysteresis: float,
) -> list[dict[str, Any]]:
    """A row for each method, in this order; the flat search is made first in any case."""
    hot = SearchTree.of(tree)
    made: dict[str, Measured] = {}
    with progress("searching", 1 + len(set(methods) - {_REFERENCE})) as step:
        reference = measure_search(
            make_search(_REFERENCE, hot, hysteresis=hysteresis), requests, search_every
        )
        made[_REFERENCE] = reference
        step()
        for method in methods:
            if method == _REFERENCE:
                continue
            rule = _rule(method, hot, tree)
            if rule is not None:
                made[method] = measure_rule(rule, requests, search_every)
            else:
                search = make_search(method, hot, hysteresis=hysteresis)
                made[method] = measure_search(search, requests, search_every, reference.signatures)
                made[method].row["overlap"] = reference.row["overlap"]  # of the same cuts
            step()
    return [made[method].row for method in methods]


def _rule(method: str, hot: SearchTree, tree: LodTree) -> RuleSearch | None:
    if method == OctreeGsSearch.name:
        return OctreeGsSearch(hot, octree=tree.metadata.build.get("structure") == STRUCTURE)
    if method == CityGaussianSearch.name:
        return CityGaussianSearch(hot, up=tree.metadata.up)
    return None


def _verdict(row: dict[str, Any]) -> str:
    if row["identical_to_flat"] is None:
        return "another set"
    return f"{row['identical_to_flat']} of {row['searches']}"


def _requests(tree: LodTree, options: SearchOptions) -> list[SearchRequest]:
    """What the viewer asks along the trace."""
    least = DROPPED * options.search_every + 1
    frames = options.frames or (MEASURED + DROPPED) * options.search_every
    if frames < least:
        raise InputError(
            f"--frames must be at least {least}: the first {DROPPED} searches are not counted"
        )
    view, up = start_pose(tree, options.scene.view, str(options.tree))
    rate_hz = load_session_config().display_rate.hz
    trace = head_trace(options.scene.trace, view, up, frames, rate_hz, options.seed)
    focal_px = options.scene.display.fx
    return [
        SearchRequest((float(x), float(y), float(z)), focal_px, options.tau_px)
        for x, y, z in trace.positions[:: options.search_every]
    ]


def start_pose(tree: LodTree, view: str | None, name: str) -> tuple[Pose, str]:
    """First pose and up axis: the given view (EX,EY,EZ:LX,LY,LZ), else the tree's own start along
    its path. Raises InputError naming the tree where there is neither.
    """
    metadata = tree.metadata
    axis = int(np.argmax(np.abs(metadata.up)))
    up = ("-" if metadata.up[axis] < 0 else "+") + "xyz"[axis]
    vertical = np.array(metadata.up)
    if view is not None:
        eye, target = np.array(parse_view(view)) / metadata.units_per_metre
        return look_at(eye, target, vertical), up
    if metadata.start is None:
        raise InputError(f"{name}: the tree names no start; --view must be given")
    start = np.array(metadata.start)
    if len(metadata.path) < 2:
        return Pose(start, level_rotation(up)), up
    ahead = np.array(metadata.path[1]) - np.array(metadata.path[0])
    return Pose(start, level_rotation(up, ahead)), up
