"""Real scenes as trees: pictures of trained levels used as ancestors, and the stream of a tree.

    python -m benchmarks.real_scenes quality                     # playbot: levels, merged, octree
    python -m benchmarks.real_scenes stream TREE --eye X,Y,Z     # along a recorded head trace

``quality`` compares at equal counts, mean of three views against the finest level. ``stream``
checks after every message that both ends hold the same; times are CPU seconds of the process.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import numpy as np

from benchmarks.machine import describe, in_words
from benchmarks.tree import GREY, VIEWS
from gaussians.cameras import Display, StereoRig, look_at
from gaussians.formats import load_lod_set
from gaussians.quality import psnr_db
from gaussians.render import render_mono
from gaussians.scene import Scene
from lod_cloud import (
    Client,
    Cloud,
    LodTree,
    PaperCodec,
    SearchRequest,
    build_tree,
    flat_search,
    load_tree,
)
from lod_cloud.codec import CompactCodec
from lod_cloud.imports import build_block_tree, build_octree
from lod_cloud.search import SearchTree, make_search
from nebula.scene_input import head_trace

DATA = Path(os.environ.get("NEBULA_DATA", "data"))
FOCAL_PX = 929.2
RATE_HZ = 90.0
TRACE = "traces/eyenavgs/user113_alameda.csv"


def adaptive_cut(tree: LodTree, position: np.ndarray, most: int) -> np.ndarray:
    """The largest cut of at most ``most`` nodes that the node test gives at a position."""
    x, y, z = (float(c) for c in position)

    def cut(factor: float) -> np.ndarray:
        return flat_search(tree, SearchRequest((x, y, z), factor, 0.0)).node_ids

    low, high = 0.0, 12.0  # logarithms of k
    for _ in range(25):
        middle = (low + high) / 2
        low, high = (middle, high) if len(cut(np.exp(middle))) <= most else (low, middle)
    return cut(np.exp(low))


def quality() -> None:
    given = load_lod_set(DATA / "scenes/playbot_lod/lod-meta.json")
    display, up = Display.from_fov(512, 512, 70.0), np.array([0.0, -1.0, 0.0])
    rigs = [
        StereoRig(display, look_at(np.array(eye), np.array(target), up), 0.0, 0.05)
        for eye, target in VIEWS
    ]
    wanted = [np.clip(render_mono(given.levels[0], rig, GREY)[0], 0, 1) for rig in rigs]

    def score(scenes: list[Scene]) -> str:
        found = [
            psnr_db(np.clip(render_mono(scene, rig, GREY)[0], 0, 1), image) or 0.0
            for scene, rig, image in zip(scenes, rigs, wanted, strict=True)
        ]
        counts = f"{np.mean([len(scene) for scene in scenes]):9.0f}"
        return f"{counts} splats {np.mean(found):6.2f} dB ({', '.join(f'{v:.2f}' for v in found)})"

    trees = {
        "blocks": build_block_tree(given),
        "merged": build_tree(given.levels[0]),
        "octree": build_octree(given.levels[0]),
    }
    for level in (1, 2, 3):
        shipped = given.levels[level]
        print(f"level {level}: shipped {score([shipped] * len(rigs))}", flush=True)
        for name, tree in trees.items():
            cuts = [adaptive_cut(tree, rig.left_position, len(shipped)) for rig in rigs]
            print(f"  {name:8} {score([tree.gaussians.take(c) for c in cuts])}", flush=True)


def stream(options: argparse.Namespace) -> None:
    tree = load_tree(options.tree)
    begin = time.process_time()
    paper = options.codec == "paper"
    codec = PaperCodec.train(tree, 0) if paper else CompactCodec.train(tree, 0)
    print(f"codec {options.codec}: {time.process_time() - begin:.1f} CPU-s; {memory()}", flush=True)
    search = make_search(options.method, SearchTree.of(tree), hysteresis=options.hysteresis)
    cloud, client = Cloud(tree, codec, search=search), Client()
    client.receive(cloud.session_start())
    up = int(np.argmax(np.abs(tree.metadata.up)))
    axis = ("-" if tree.metadata.up[up] < 0 else "+") + "xyz"[up]
    eye = np.array([float(c) for c in options.eye.split(",")])
    view = look_at(eye, np.mean(tree.metadata.bounds, axis=0), np.array(tree.metadata.up))
    frames = options.every * options.searches
    trace = head_trace(str(DATA / TRACE), view, axis, frames, RATE_HZ, 0)
    sent, cpu = [], []
    for index in range(0, frames, options.every):
        x, y, z = (float(c) for c in trace.positions[index])
        begin = time.process_time()
        message = cloud.search(SearchRequest((x, y, z), FOCAL_PX, options.tau), index)
        middle = time.process_time()
        client.receive(message)
        cpu.append((middle - begin, time.process_time() - middle))
        cloud.receive(client.report())
        if client.table is None or client.table.state_hash != cloud.table.state_hash:
            raise SystemExit("the ends differ")
        assert cloud.stats is not None
        sent.append(cloud.stats)
        if index == 0:
            print(f"first message: {sent[0].payloads} nodes, {sent[0].message_bytes} B", flush=True)
    later, seconds = sent[1:], options.every * (options.searches - 1) / RATE_HZ
    size = sum(s.message_bytes for s in later)
    medians = 1e3 * np.median(cpu[1:], axis=0)
    print(
        f"{options.searches} searches, tau {options.tau:g} px, cut {sent[-1].cut_size}, "
        f"{np.mean([s.added for s in later]):.0f} added per search: {8e-6 * size / seconds:.2f} "
        f"Mbps, {size / max(1, sum(s.payloads for s in later)):.1f} B per node sent, "
        f"{sum(s.escapes for s in sent)} escapes; first {cpu[0][0]:.1f} + {cpu[0][1]:.1f} CPU-s, "
        f"then {medians[0]:.1f} ms cloud, {medians[1]:.1f} ms client; {memory()}"
    )


def memory() -> str:
    """What this process holds, and what of it no file backs."""
    lines = Path("/proc/self/status").read_text().splitlines()
    held = {line.split(":")[0]: int(line.split()[1]) for line in lines if line.endswith(" kB")}
    names = ("VmHWM", "RssAnon")
    return ", ".join(f"{name} {held[name] / 2**20:.2f} GiB" for name in names)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(dest="what", required=True)
    commands.add_parser("quality")
    of_stream = commands.add_parser("stream")
    of_stream.add_argument("tree", type=Path)
    of_stream.add_argument("--eye", required=True, help="metres")
    of_stream.add_argument("--tau", type=float, default=6.0)
    of_stream.add_argument("--every", type=int, default=4)
    of_stream.add_argument("--searches", type=int, default=120)
    of_stream.add_argument("--method", default="wheel")
    of_stream.add_argument("--hysteresis", type=float, default=0.02)
    of_stream.add_argument("--codec", choices=["paper", "compact"], default="paper")
    options = parser.parse_args()
    print(in_words(describe()))
    if options.what == "quality":
        quality()
    else:
        stream(options)


if __name__ == "__main__":
    main()
