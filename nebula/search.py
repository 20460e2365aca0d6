"""``nebula search``: LoD searches along a head trace in a stored tree."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from gaussians.cameras import Pose, look_at
from gaussians.errors import InputError
from gaussians.placement import parse_view
from gaussians.rotations import level_rotation
from lod_cloud import Cut, LodTree, SearchRequest, difference, flat_search, load_tree, overlap
from nebula.options import SearchOptions
from nebula.output import CommandResult, text_table
from nebula.progress import progress
from nebula.scene_input import head_trace
from nebula.session_config import load_session_config


def run(options: SearchOptions) -> CommandResult:
    """One flat search every ``search_every`` frames; size, changes and cost of each."""
    with progress(f"reading {options.tree}"):
        tree = load_tree(options.tree)
    view, up = _start(tree, options)
    rate_hz = load_session_config().display_rate.hz
    trace = head_trace(options.scene.trace, view, up, options.frames, rate_hz, options.seed)
    focal_px = options.scene.display.fx
    rows: list[dict[str, Any]] = []
    before: Cut | None = None
    frames = range(0, options.frames, options.search_every)
    with progress("searching", len(frames)) as step:
        for frame in frames:
            x, y, z = (float(c) for c in trace.positions[frame])
            begin = time.perf_counter()
            cut = flat_search(tree, SearchRequest((x, y, z), focal_px, options.tau_px))
            rows.append(_row(frame, cut, before, 1e3 * (time.perf_counter() - begin)))
            before = cut
            step()
    data = {
        "tree": str(options.tree),
        "nodes": len(tree),
        "method": "flat",
        "tau_px": options.tau_px,
        "focal_px": focal_px,
        "rows": rows,
    }
    heads = ["frame", "cut", "added", "removed", "overlap", "tested", "ms"]
    lines = [
        [
            str(r["frame"]),
            str(r["cut_size"]),
            str(r["added"]),
            str(r["removed"]),
            "" if r["overlap"] is None else f"{r['overlap']:.4%}",
            str(r["nodes_tested"]),
            f"{r['search_ms']:.2f}",
        ]
        for r in rows
    ]
    text = f"{options.tree}: {len(tree)} nodes, flat search, tau {options.tau_px:g} px\n\n"
    return CommandResult(data, text + text_table(heads, lines, numbers=range(7)))


def _row(frame: int, cut: Cut, before: Cut | None, search_ms: float) -> dict[str, Any]:
    nothing = np.empty(0, np.int32)
    earlier = nothing if before is None else before.node_ids
    return {
        "frame": frame,
        "cut_size": len(cut),
        "added": len(difference(cut.node_ids, earlier)),
        "removed": len(difference(earlier, cut.node_ids)),
        "overlap": None if before is None else overlap(before, cut),
        "nodes_tested": cut.nodes_tested,
        "bytes_touched": cut.bytes_touched,
        "search_ms": search_ms,
    }


def _start(tree: LodTree, options: SearchOptions) -> tuple[Pose, str]:
    """First pose and up axis: the given view, else the tree's own start along its path."""
    metadata = tree.metadata
    axis = int(np.argmax(np.abs(metadata.up)))
    up = ("-" if metadata.up[axis] < 0 else "+") + "xyz"[axis]
    vertical = np.array(metadata.up)
    if options.scene.view is not None:
        eye, target = np.array(parse_view(options.scene.view)) / metadata.units_per_metre
        return look_at(eye, target, vertical), up
    if metadata.start is None:
        raise InputError(f"{options.tree}: the tree names no start; --view must be given")
    start = np.array(metadata.start)
    if len(metadata.path) < 2:
        return Pose(start, level_rotation(up)), up
    ahead = np.array(metadata.path[1]) - np.array(metadata.path[0])
    return Pose(start, level_rotation(up, ahead)), up
