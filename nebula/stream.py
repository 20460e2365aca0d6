"""``nebula stream``: a head trace through cloud, link and client, without rendering."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gaussians.cameras import Pose
from lod_cloud import Cloud, Link, LodTree, SearchRequest, SearchTree, load_tree, make_search
from lod_cloud.codec import Codec, CompactCodec, PaperCodec
from nebula.build_tree import tree_of
from nebula.options import StreamOptions
from nebula.output import CommandResult, text_table
from nebula.progress import progress
from nebula.scene_input import head_trace, load
from nebula.search import start_pose
from nebula.session_config import SessionConfig, load_session_config
from nebula.stream_measurement import Faults, Player, first_pictures

SEARCHES = 450
_TOTALS = ("payloads", "plain", "completed", "reactivated", "merged", "escapes")
_PERCENTILES = (50, 99, 100)


def run(options: StreamOptions) -> CommandResult:
    """One search and one message every ``search_every`` frames; a row for each, and a summary.

    Raises InputError for a tree without a start where no view is given.
    """
    config = load_session_config()
    tree, view, up, name = _tree(options)
    frames = options.frames or SEARCHES * options.search_every
    rate_hz = config.display_rate.hz
    trace = head_trace(options.scene.trace, view, up, frames, rate_hz, options.seed)
    focal_px = options.scene.display.fx
    requests = [
        SearchRequest((float(x), float(y), float(z)), focal_px, options.tau_px)
        for x, y, z in trace.positions[:: options.search_every]
    ]
    link = Link(options.rate_mbps, options.latency_ms)
    with progress("training the codebook"):
        codec = make_codec(options.codec, tree, options.seed, config)
    player = _player(options, tree, codec, link, config)
    with progress(f"playing {options.scene.trace}", len(requests)) as step:
        for request in requests:
            player.play(request)
            step()
    player.finish()
    interval_s = options.search_every / rate_hz
    summary = summarise(player.rows, interval_s, options.tau_px) | {
        "codebook_bytes": player.codebook_bytes,
        "refused": player.refused,
        "reports_lost": player.reports_lost,
        "state_bytes": player.cloud.state_bytes,
        "first_pictures": first_pictures(
            player.rows, link, options.tau_px, before_bytes=player.codebook_bytes
        ),
    }
    data = {
        "tree": name,
        "nodes": len(tree),
        "trace": options.scene.trace,
        "search_every": options.search_every,
        "tau_px": options.tau_px,
        "focal_px": focal_px,
        "method": options.method,
        "hysteresis": options.hysteresis,
        "codec": options.codec,
        "rate_mbps": options.rate_mbps,
        "latency_ms": options.latency_ms,
        "budget_bytes": link.bytes_in(interval_s) if options.paced else None,
        "summary": summary,
        "rows": player.rows,
    }
    return CommandResult(data, _text(data))


def make_codec(name: str, tree: LodTree, seed: int, config: SessionConfig) -> Codec:
    """The codec of that name, with its codebook size of configs/session."""
    if name == "paper":
        book = config.codebook
        return PaperCodec.train(tree, seed, words=book.words, stages=book.stages)
    book = config.compact_codebook
    return CompactCodec.train(tree, seed, words=book.words, stages=book.stages)


def _tree(options: StreamOptions) -> tuple[LodTree, Pose, str, str]:
    """The tree, where its viewer starts, its up axis, and its name."""
    if options.tree is None:
        with progress("building the tree"):
            place = load(options.scene, options.seed)
            return tree_of(place), place.view, place.placement.up, place.name
    with progress(f"reading {options.tree}"):
        tree = load_tree(options.tree)
    return tree, *start_pose(tree, options.scene.view, str(options.tree)), str(options.tree)


def _player(
    options: StreamOptions, tree: LodTree, codec: Codec, link: Link, config: SessionConfig
) -> Player:
    interval_s = options.search_every / config.display_rate.hz
    hot = SearchTree.of(tree)
    cloud = Cloud(
        tree,
        codec,
        search=make_search(options.method, hot, hysteresis=options.hysteresis),
        frames_per_search=options.search_every,
        reuse_window_frames=config.reuse_window.frames,
        budget_bytes=link.bytes_in(interval_s) if options.paced else None,
    )
    faults = Faults(options.loss, options.reorder, options.corruption)
    compute_s = config.cloud.compute_ms * 1e-3
    return Player(cloud, link, interval_s, compute_s, faults=faults, seed=options.seed)


def summarise(rows: Sequence[dict[str, Any]], interval_s: float, tau_px: float) -> dict[str, Any]:
    """Of all searches after the first that left nothing pending at the tau asked for: rate, sizes
    and totals; of all but the first where none did.
    """
    settled = [i for i, row in enumerate(rows) if row["pending"] == 0 and row["tau_px"] <= tau_px]
    begin = settled[0] + 1 if settled else 1
    counted = rows[begin:]
    sizes = [row["message_bytes"] for row in counted]
    times = [row["cloud_cpu_ms"] for row in counted]
    summary: dict[str, Any] = {
        "searches": len(counted),
        "settled_after": begin if settled else None,
        "mbps": sum(sizes) * 8e-6 / (len(counted) * interval_s) if counted else None,
        "pending_max": max(row["pending"] for row in rows),
        "pending_searches": sum(row["pending"] > 0 for row in rows),
        "pending_harmonics": rows[-1]["pending_harmonics"],
        "held_max": max(row["held"] for row in rows),
        "behind_max": max(row["behind"] for row in rows),
        "messages_lost": sum(row["lost"] for row in rows),
        "kinds": {
            kind: sum(row["kind"] == kind for row in rows)
            for kind in ("start", "step", "repair", "probe")
        },
    }
    for key, values in (("message_bytes", sizes), ("cloud_cpu_ms", times)):
        summary[key] = {
            f"p{p}": float(np.percentile(values, p)) if counted else None for p in _PERCENTILES
        }
    return summary | {key: sum(row[key] for row in counted) for key in _TOTALS}


def _text(data: dict[str, Any]) -> str:
    s = data["summary"]
    sizes = s["message_bytes"]
    lines = [
        f"{data['tree']}: {data['nodes']} nodes, {data['trace']}, a search every "
        f"{data['search_every']} frames, tau {data['tau_px']:g} px, {data['codec']} codec"
    ]
    if s["searches"]:
        lines.append(
            f"{s['mbps']:.2f} Mbps over {s['searches']} searches after the start; messages "
            f"p50 {sizes['p50']:.0f} B, p99 {sizes['p99']:.0f} B"
        )
        lines.append(", ".join(f"{s[key]} {key}" for key in _TOTALS))
    if data["budget_bytes"] is not None:
        lines.append(
            f"at most {data['budget_bytes']} B per message: {s['pending_searches']} messages left "
            f"something pending, at most {s['pending_max']} nodes; {s['pending_harmonics']} nodes "
            "of the last cut without harmonics above degree 0"
        )
    kinds = ", ".join(f"{count} {kind}" for kind, count in s["kinds"].items() if count)
    lines.append(
        f"messages: {kinds}; {s['messages_lost']} lost, {s['refused']} refused, client at most "
        f"{s['behind_max']} behind"
    )
    heads = ["complete at tau, px", "messages", "bytes", "nodes", "line ms", "ms"]
    table = [
        [f"{p['tau_px']:g}", *_shown(p, "messages", "bytes", "nodes"), *_ms(p)]
        for p in s["first_pictures"]
    ]
    return "\n".join(lines) + "\n\n" + text_table(heads, table, numbers=range(6))


def _shown(picture: dict[str, Any], *keys: str) -> list[str]:
    return ["-" if picture[key] is None else str(picture[key]) for key in keys]


def _ms(picture: dict[str, Any]) -> list[str]:
    seconds = (picture["line_s"], picture["complete_s"])
    return ["-" if value is None else f"{1e3 * value:.1f}" for value in seconds]
