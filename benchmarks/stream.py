"""``python -m benchmarks.stream``: what a Δcut stream costs, and what it loses.

    python -m benchmarks.stream rate --tree DIR --trace walk --every 4 --hysteresis 0
    python -m benchmarks.stream loss --scene FILE --up=-y --units-per-metre 1 --tau 6
    python -m benchmarks.stream loss --city 200000
    python -m benchmarks.stream loss --tree DIR --codec compact-2048x1

``rate`` follows a trace through a tree, which may be mapped, after the first cut is there: Mbps at
90 Hz, bytes by kind of field, escapes, share merged by the client, message sizes, coding time. The
first cut is not coded and every message counts as acknowledged. ``loss`` renders the cut of three
views, decoded and not, field by field, and (but in a ``--tree``, which may be large) what a client
holds after a walk from view to view.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import describe, in_words
from benchmarks.searches import Subject
from gaussians import parallel
from gaussians.cameras import Display, Pose, StereoRig, look_at
from gaussians.formats import load_scene
from gaussians.placement import parse_view
from gaussians.poses import GENERATED_RATE_HZ
from gaussians.quality import psnr_db
from gaussians.render import render_mono
from gaussians.scene import Scene
from gaussians.synthetic import generate_city
from lod_cloud import (
    Client,
    Cloud,
    Codec,
    CompactCodec,
    LodTree,
    PaperCodec,
    SearchRequest,
    SearchTree,
    TreeEncoder,
    build_tree,
    flat_search,
    load_tree,
    make_search,
)
from lod_cloud.codec import NOTHING_CODED, Encoded
from lod_cloud.codec.axes import sorted_axes
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


# ---------------------------------------------------------------- loss


@dataclasses.dataclass(frozen=True)
class Pictures:
    """Views of one scene, and all leaves rendered from them."""

    tree: LodTree
    rigs: list[StereoRig]
    tau_px: float
    full: list[Any]
    hot: SearchTree

    @classmethod
    def of(cls, tree: LodTree, rigs: list[StereoRig], tau_px: float) -> Pictures:
        leaves = np.sort(tree.leaf_nodes())
        full = [
            render_mono(tree.gaussians.take(leaves[_in_sight(tree, leaves, rig)]), rig)[0]
            for rig in rigs
        ]
        return cls(tree, rigs, tau_px, full, SearchTree.of(tree))

    def request(self, rig: StereoRig) -> SearchRequest:
        """Focal length as on the display of 2064 pixels, of which this is a smaller picture."""
        x, y, z = (float(v) for v in rig.pose.position)
        return SearchRequest((x, y, z), rig.display.fx * 2064 / rig.display.width, self.tau_px)

    def psnr_db(self, scenes: Sequence[Scene], against: Sequence[Any]) -> list[float]:
        """Of every view."""
        return [
            psnr_db(render_mono(scene, rig)[0], image) or float("inf")
            for scene, rig, image in zip(scenes, self.rigs, against, strict=True)
        ]

    def score(self, scenes: Sequence[Scene], against: Sequence[Any]) -> str:
        """In words."""
        return _in_words(self.psnr_db(scenes, against))


def _in_sight(tree: LodTree, nodes: Int32, rig: StereoRig) -> Int32:
    """Places of the nodes that may show: spheres twice as large as 3 sigma reach into the view."""
    x, y, z = ((tree.gaussians.means[nodes] - rig.pose.position) @ rig.pose.rotation).T
    reach = 2.0 * tree.radius[nodes]
    display = rig.display
    seen = z > -reach
    for aside, side in ((x, display.width / display.fx), (y, display.height / display.fy)):
        seen &= np.abs(aside) - 0.5 * side * z <= np.hypot(1.0, 0.5 * side) * reach
    return np.flatnonzero(seen).astype(np.int32)


def _in_words(values: Sequence[float]) -> str:
    return f"{np.mean(values):6.2f} ({' '.join(f'{v:.1f}' for v in values)})"


def loss(
    pictures: Pictures, codecs: dict[str, Codec], *, fields: bool, walk: bool
) -> dict[str, dict[str, float]]:
    """Prints PSNR in dB; with ``fields`` of every field alone, too, with ``walk`` after one.
    Returns means by codec.
    """
    tree = pictures.tree
    rows: dict[str, dict[str, float]] = {}
    cuts = [flat_search(tree, pictures.request(rig)).node_ids for rig in pictures.rigs]
    seen = [_in_sight(tree, cut, rig) for cut, rig in zip(cuts, pictures.rigs, strict=True)]
    originals = [tree.gaussians.take(cut[places]) for cut, places in zip(cuts, seen, strict=True)]
    images = [
        render_mono(scene, rig)[0] for scene, rig in zip(originals, pictures.rigs, strict=True)
    ]
    print(f"cuts of {', '.join(str(len(cut)) for cut in cuts)} nodes of {len(tree)}")
    whole = pictures.psnr_db(originals, pictures.full)
    print(f"cut against all leaves          {_in_words(whole)}")
    for name, codec in codecs.items():
        encoder = TreeEncoder(tree, codec)
        decoded, escapes = [], 0
        for cut, places in zip(cuts, seen, strict=True):
            coded = encoder.encode(cut)
            escapes += coded.escapes
            decoded.append(codec.decode(coded.payload).gaussians.take(places))
        print(f"{name}: escapes {escapes / sum(len(cut) for cut in cuts):.2%}")
        cut_db = pictures.psnr_db(decoded, images)
        leaves_db = pictures.psnr_db(decoded, pictures.full)
        print(f"  decoded against the cut       {_in_words(cut_db)}")
        print(f"  decoded against all leaves    {_in_words(leaves_db)}")
        if codec.apart:
            bare = [_plain(scene) for scene in decoded]
            print(f"  the same without harmonics    {pictures.score(bare, images)}")
            print(f"    against all leaves          {pictures.score(bare, pictures.full)}")
        rows[name] = {
            "decoded_vs_cut_db": float(np.mean(cut_db)),
            "worst_view_db": float(np.min(cut_db)),
            "decoded_vs_leaves_db": float(np.mean(leaves_db)),
            "lost_vs_leaves_db": float(np.mean(whole) - np.mean(leaves_db)),
        }
        sorted_first = name != "paper"
        for label, some in FIELDS.items() if fields else ():
            mixed = [
                _mixed(one, other, some, sorted_first=sorted_first)
                for one, other in zip(originals, decoded, strict=True)
            ]
            if some != ("above",) or tree.sh_degree:
                print(f"    {label:12} alone          {pictures.score(mixed, images)}", flush=True)
        if not walk:
            continue
        walked, stats = _walked(pictures, encoder)
        print(
            f"  after a walk, {stats['merged']:.1%} of the cut merged by the client:"
            f" against the cut {pictures.score(walked, images)},"
            f" all leaves {pictures.score(walked, pictures.full)}",
            flush=True,
        )
    return rows


FIELDS = {
    "position": ("means",),
    "scale": ("scales",),
    "rotation": ("quaternions",),
    "opacity": ("opacities",),
    "colour": ("dc",),
    "harmonics": ("above",),
    "all but harmonics": ("means", "scales", "quaternions", "opacities", "dc"),
}


def _plain(scene: Scene) -> Scene:
    """As nodes come while tau is raised."""
    sh = scene.sh.copy()
    sh[:, 1:] = 0
    return dataclasses.replace(scene, sh=sh)


def _mixed(original: Scene, decoded: Scene, fields: Sequence[str], *, sorted_first: bool) -> Scene:
    """The original with some fields as decoded."""
    if sorted_first:  # the same Gaussians, with the axes in the order of the decoded ones
        scales, quaternions = sorted_axes(original.scales, original.quaternions)
        original = dataclasses.replace(
            original,
            scales=scales.astype(np.float32),
            quaternions=quaternions.astype(np.float32),
        )
    parts = {name: getattr(decoded, name) for name in fields if name not in ("dc", "above")}
    sh = original.sh.copy()
    if "dc" in fields:
        sh[:, 0] = decoded.sh[:, 0]
    if "above" in fields:
        sh[:, 1:] = decoded.sh[:, 1:]
    return dataclasses.replace(original, sh=sh, **parts)


def _walked(pictures: Pictures, encoder: TreeEncoder) -> tuple[list[Scene], dict[str, float]]:
    """What a client has at each view, having walked there from the one before and stepped back."""
    tree = pictures.tree
    cloud = Cloud(tree, encoder, search=make_search("wheel", pictures.hot))
    client = Client()
    client.receive(cloud.session_start())
    scenes, merged, frame = [], [], 0
    here = np.array(pictures.request(pictures.rigs[-1]).position)
    for rig in pictures.rigs:
        target = pictures.request(rig)
        there = np.array(target.position)
        for share in (0.0, 0.25, 0.5, 0.75, 0.9, 1.1, 1.3, 1.1, 1.0):
            x, y, z = here + share * (there - here)
            request = dataclasses.replace(target, position=(float(x), float(y), float(z)))
            client.receive(cloud.search(target if share == 1.0 else request, frame))
            cloud.receive(client.report())
            frame += 40
        assert client.table is not None
        cut = client.table.cut_ids
        scene = client._subgraph.records(cut).gaussians
        sent = encoder.codec.decode(encoder.encode(cut).payload).gaussians
        merged.append(float((scene.means != sent.means).any(axis=1).mean()))
        scenes.append(scene.take(_in_sight(tree, cut, rig)))
        here = there
    return scenes, {"merged": float(np.mean(merged))}


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
    if arguments.city:
        city = generate_city(arguments.city, 0, sh_degree=3)
        tree = build_tree(city.scene, up=(0.0, 0.0, 1.0))
        views = _along([np.array(point) for point in city.path])
    elif arguments.tree:
        tree = load_tree(arguments.tree)
        views = _along([np.array(point) for point in tree.metadata.path])
    else:
        scene, _ = load_scene(arguments.scene, arguments.level)
        tree = build_tree(scene.scaled(1 / arguments.units_per_metre))
        views = [
            (np.array(eye), np.array(target)) for eye, target in map(parse_view, arguments.view)
        ]
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
