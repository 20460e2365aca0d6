"""``python -m benchmarks.stream``: what a Δcut stream costs, and what it loses.

    python -m benchmarks.stream rate --tree DIR --trace walk --every 4 --hysteresis 0
    python -m benchmarks.stream loss --scene FILE --up=-y --units-per-metre 1 --tau 6
    python -m benchmarks.stream loss --city 200000
    python -m benchmarks.stream loss --tree DIR --codec compact-512x2

``rate`` follows a trace through a tree, which may be mapped, after the first cut is there: Mbps at
90 Hz, bytes by kind of field, escapes, share merged by the client, message sizes, coding time. The
first cut is not coded and every message counts as acknowledged. ``loss`` renders the cut of three
views, decoded and not, field by field, and (but in a ``--tree``, which may be large) what a client
holds after a walk from view to view.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import describe, in_words
from benchmarks.searches import Subject
from benchmarks.stream_loss import Pictures, loss
from gaussians import parallel
from gaussians.cameras import Display, Pose, StereoRig, look_at
from gaussians.formats import load_scene
from gaussians.placement import parse_view
from gaussians.poses import GENERATED_RATE_HZ
from gaussians.synthetic import generate_city
from lod_cloud import (
    Cloud,
    Codec,
    CompactCodec,
    LodTree,
    PaperCodec,
    SearchRequest,
    TreeEncoder,
    build_tree,
    load_tree,
    make_search,
)
from lod_cloud.codec import NOTHING_CODED, Encoded
from lod_cloud.delta_cut import Report
from lod_cloud.events import Events
from lod_cloud.lod_tree import Int32
from lod_cloud.management_table import ManagementTable
from lod_cloud.protocol import REPORT, seal

DROPPED = 10  # searches after the first cut that are not counted


class CountingEncoder(TreeEncoder):
    """Adds up what it codes, once it is told to begin."""

    def __init__(self, tree: LodTree, codec: Codec) -> None:
        super().__init__(tree, codec)
        self.counting = False
        self.columns: Counter[str] = Counter()
        self.event_bytes, self.cpu_s = 0, 0.0

    def encode_step(
        self, events: Events, sent: Int32, table: ManagementTable, *, plain: bool = False
    ) -> Encoded:
        if not self.counting:
            return NOTHING_CODED
        begin = time.process_time()
        coded = super().encode_step(events, sent, table, plain=plain)
        self.cpu_s += time.process_time() - begin
        self.columns.update(coded.columns)
        self.event_bytes += len(events.to_bytes(self.child_numbers))
        return coded


def rate(
    subject: Subject, tree: LodTree, codec: Codec, requests: Sequence[SearchRequest],
    every: int, hysteresis: float, window: int,
) -> dict[str, Any]:  # fmt: skip
    """A trace, one search every so many frames."""
    encoder = CountingEncoder(tree, codec)
    search = make_search("wheel", subject.tree, hysteresis=hysteresis)
    cloud = Cloud(tree, encoder, search=search, frames_per_search=every, reuse_window_frames=window)
    sizes: list[int] = []
    sums: Counter[str] = Counter()
    for index, request in enumerate(requests):
        encoder.counting = index > DROPPED
        message = cloud.search(request, index * every)
        table = cloud.table
        report = Report(0, 0, cloud.sequence, table.state_hash, cloud.sequence, False, False)
        cloud.receive(seal(REPORT, report.to_bytes()))
        if not encoder.counting:
            continue
        assert cloud.stats is not None
        sizes.append(len(message))
        for name in ("added", "removed", "payloads", "merged", "reactivated", "escapes"):
            sums[name] += getattr(cloud.stats, name)
    seconds = len(sizes) * every / GENERATED_RATE_HZ
    payloads = max(1, sums["payloads"])
    coded = sum(encoder.columns.values())
    return {
        "mbps": 8e-6 * sum(sizes) / seconds,
        "bytes_per_payload": sum(sizes) / payloads,
        "message_p50": float(np.quantile(sizes, 0.5)),
        "message_p99": float(np.quantile(sizes, 0.99)),
        "searches": len(sizes),
        **{f"{name}_per_search": value / len(sizes) for name, value in sums.items()},
        "escape_share": sums["escapes"] / payloads,
        "merged_share": sums["merged"] / max(1, sums["merged"] + payloads),
        "columns": {name: size / payloads for name, size in encoder.columns.items()},
        "events_per_payload": encoder.event_bytes / payloads,
        "before_zstd": (coded + encoder.event_bytes) / payloads,
        "encode_us_per_payload": 1e6 * encoder.cpu_s / payloads,
    }


def print_rate(name: str, row: dict[str, Any]) -> None:
    columns = ", ".join(f"{key} {value:.2f}" for key, value in row["columns"].items())
    print(
        f"{name:14} {row['mbps']:.3f} Mbps; {row['bytes_per_payload']:.2f} B per payload "
        f"({row['before_zstd']:.2f} without envelope and zstd); "
        f"per search +{row['added_per_search']:.0f} -{row['removed_per_search']:.0f}: "
        f"{row['payloads_per_search']:.0f} sent, {row['merged_per_search']:.0f} merged "
        f"({row['merged_share']:.1%}), {row['reactivated_per_search']:.0f} held; "
        f"escapes {row['escape_share']:.2%}; message p50 {row['message_p50']:.0f} "
        f"p99 {row['message_p99']:.0f} B; {row['encode_us_per_payload']:.2f} us per payload\n"
        f"         {columns}, events {row['events_per_payload']:.2f}",
        flush=True,
    )


# ---------------------------------------------------------------- command line


def _codec(name: str, tree: LodTree, options: argparse.Namespace) -> Codec:
    """``paper`` or, for example, ``compact-256x2``."""
    if name == "paper":
        return PaperCodec.train(tree, 0)
    words, stages = (int(number) for number in name.removeprefix("compact-").split("x"))
    return CompactCodec.train(
        tree,
        0,
        words=words,
        stages=stages,
        position_bits=options.position_bits,
        colour_bits=options.colour_bits,
    )


def _poses(arguments: argparse.Namespace) -> tuple[LodTree, list[Pose]]:
    """The scene's tree, and where to look from."""
    path: Any = []
    if arguments.city:
        city = generate_city(arguments.city, 0, sh_degree=3)
        tree, path = build_tree(city.scene, up=(0.0, 0.0, 1.0)), city.path
    elif arguments.tree:
        tree = load_tree(arguments.tree)
        path = tree.metadata.path
    else:
        scene, _ = load_scene(arguments.scene, arguments.level)
        tree = build_tree(scene.scaled(1 / arguments.units_per_metre))
    given = [(np.array(eye), np.array(target)) for eye, target in map(parse_view, arguments.view)]
    views = given or _along([np.array(point) for point in path])
    up = {"+z": (0.0, 0.0, 1.0), "-y": (0.0, -1.0, 0.0)}[arguments.up]
    return tree, [look_at(eye, target, np.array(up)) for eye, target in views]


def _along(path: list[Any]) -> list[tuple[Any, Any]]:
    """Three views on a path, each to its next point."""
    return [(path[place], path[place + 1]) for place in (0, len(path) // 4, len(path) // 2)]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["rate", "loss"])
    parser.add_argument("--tree", type=Path)
    parser.add_argument("--trace", default="walk")
    parser.add_argument("--every", type=int, default=4)
    parser.add_argument("--hysteresis", type=float, default=0.0)
    parser.add_argument("--window", type=int, default=32)
    parser.add_argument("--searches", type=int, default=200)
    parser.add_argument("--tau", type=float, default=6.0)
    parser.add_argument("--position-bits", type=int, default=6)
    parser.add_argument("--colour-bits", type=int, default=7)
    parser.add_argument("--codec", action="append", help="paper, or compact-WORDSxSTAGES")
    parser.add_argument("--city", type=int)
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--up", default="+z", choices=["+z", "-y"])
    parser.add_argument("--units-per-metre", type=float, default=1.0)
    parser.add_argument("--near", type=float, default=0.05)
    parser.add_argument("--view", action="append", default=[], metavar="EX,EY,EZ:LX,LY,LZ")
    parser.add_argument("--size", type=int, default=768, help="pixels along an edge of a picture")
    parser.add_argument("--level", type=int, help="of a lod-meta set")
    parser.add_argument("--fields", action="store_true", help="each field alone, too")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    if options.scene and not options.view:
        parser.error("--scene needs at least one --view")
    parallel.set_threads(1)
    print(in_words(describe()))
    names = options.codec or ["paper", "compact-256x1", "compact-2048x1", "compact-512x2"]
    if options.what == "loss":
        tree, poses = _poses(options)
        display = Display.from_fov(options.size, options.size, 90.0)
        rigs = [StereoRig(display, pose, 0.0, options.near) for pose in poses]
        pictures = Pictures.of(tree, rigs, options.tau)
        codecs = {name: _codec(name, tree, options) for name in names}
        rows = loss(pictures, codecs, fields=options.fields, walk=not options.tree)
        if options.json:
            options.json.write_text(json.dumps(rows, indent=1))
        return
    tree = load_tree(options.tree)
    subject = Subject.of(str(options.tree), tree)
    requests = subject.requests(
        options.trace, options.every, options.tau, options.searches + 1 + DROPPED
    )
    rates: dict[str, Any] = {}
    for name in names:
        codec = _codec(name, tree, options)
        rates[name] = rate(
            subject, tree, codec, requests, options.every, options.hysteresis, options.window
        )
        print_rate(name, rates[name])
    if options.json:
        options.json.write_text(json.dumps(rates, indent=1))


if __name__ == "__main__":
    main()
