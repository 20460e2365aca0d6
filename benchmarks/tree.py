"""LoD trees: seconds and memory of building them, statistics of the cities, merge quality.

    python -m benchmarks.tree speed                 # 1 M leaves, SH 0, 1, 3, pairs and medians
    python -m benchmarks.tree cities --out DIR      # both cities of configs/trees, 20 M leaves
    python -m benchmarks.tree quality               # against the shipped levels of playbot

``cities`` writes 15 GB; an existing tree in DIR is measured, not built anew.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.lod_targets import Verdict
from benchmarks.machine import describe, in_words
from gaussians.cameras import Display, StereoRig, look_at
from gaussians.formats import load_scene
from gaussians.quality import psnr_db
from gaussians.render import render_mono
from gaussians.scene import Scene
from lod_cloud import BuildOptions, LodTree, build_tree, load_tree
from lod_cloud.walk_statistics import walk_statistics
from nebula.options import tiled_tree

VIEWS = (
    ((1.5, -1.0, 1.5), (0.0, -0.3, 0.0)),
    ((0.0, -0.6, 1.2), (0.0, -0.4, 0.0)),
    ((-0.4, -0.25, 0.8), (0.0, -0.15, 0.0)),
)
GREY = (0.5, 0.5, 0.5)
MOST_BEHIND_DB = 1.0


def build(out: Path, *arguments: str) -> dict[str, float]:
    """Run ``nebula build-tree`` in a process of its own; its report."""
    report = out.with_suffix(".json")
    command = [sys.executable, "-m", "nebula", "build-tree", "--out", str(out)]
    subprocess.run([*command, *arguments, "--json", str(report)], check=True, capture_output=True)
    result: dict[str, float] = json.loads(report.read_text())
    return result


def line(name: str, r: dict[str, float]) -> str:
    million = r["leaves"] / 1e6
    return (
        f"{name:34} build {r['build_s'] / million:5.2f} s/M, "
        f"{r['build_user_cpu_s'] / million:5.2f} CPU-s/M, proof {r['proof_s'] / million:5.2f}, "
        f"leaves {r['generate_s'] / million:5.2f}, disk "
        f"{(r['spool_s'] + r['disk_s']) / million:5.2f}; {r['threads']} threads, "
        f"peak {r['peak_rss_bytes'] / 2**30:.2f} GiB; "
        f"{r['nodes']} nodes, {r['levels']} levels, load {os.getloadavg()[0]:.1f}"
    )


def warm_up() -> None:
    """Have the kernels of a build compiled."""
    with tempfile.TemporaryDirectory() as folder:
        build(Path(folder) / "warm", "--tiled", "dense_city", "--city-leaves", "20000")


def speed() -> None:
    warm_up()
    with tempfile.TemporaryDirectory() as folder:
        for degree in ("0", "1", "3"):
            for extra in ((), ("--pair-within", "1"), ("--fan-out-ratio", "0.7")):
                arguments = ("--tiled", "dense_city", "--city-leaves", "1000000")
                name = " ".join(("1 M, SH", degree, *extra))
                out = Path(folder) / "tree"
                print(line(name, build(out, *arguments, "--sh-degree", degree, *extra)), flush=True)


def cities(folder: Path) -> int:
    """Build where nothing is there; number of statistics outside their band."""
    missed = 0
    for name in ("city", "dense_city"):
        out = folder / name
        if not out.exists():
            print(line(name, build(out, "--tiled", name)), flush=True)
        found = walk_statistics(load_tree(out))
        for key, (low, high) in tiled_tree(name, None, None).expected.items():
            within = low <= found[key] <= high
            missed += not within
            print(f"  {key:18} {found[key]:12.4g}  {low:g} .. {high:g}  {'ok' if within else 'NO'}")
    return missed


def uniform_cut(tree: LodTree, count: int) -> np.ndarray:
    """The nodes not larger than some size whose parent is: at most ``count`` of them."""
    own = np.where(tree.child_count > 0, tree.extent, -1.0)
    above = np.append(tree.extent, np.inf)[tree.parent]
    low, high = 0.0, float(tree.extent[0])
    for _ in range(60):
        middle = (low + high) / 2
        if np.count_nonzero((own <= middle) & (above > middle)) > count:
            low = middle
        else:
            high = middle
    return np.flatnonzero((own <= high) & (above > high))


def quality() -> list[Verdict]:
    """How far the default is behind the shipped levels."""
    source = Path(os.environ["NEBULA_DATA"]) / "scenes/playbot_lod/lod-meta.json"
    levels = [load_scene(source, level)[0] for level in range(4)]
    display, up = Display.from_fov(512, 512, 70.0), np.array([0.0, -1.0, 0.0])
    rigs = [
        StereoRig(display, look_at(np.array(eye), np.array(target), up), 0.0, 0.05)
        for eye, target in VIEWS
    ]
    wanted = [render_mono(levels[0], rig, GREY)[0] for rig in rigs]

    def score(scene: Scene) -> float:
        images = (np.clip(render_mono(scene, rig, GREY)[0], 0, 1) for rig in rigs)
        found = [psnr_db(a, np.clip(b, 0, 1)) or 0.0 for a, b in zip(images, wanted, strict=True)]
        return float(np.mean(found))

    shipped = [score(level) for level in levels[1:]]
    for level, value in zip(levels[1:], shipped, strict=True):
        print(f"{len(level)} splats, shipped level: {value:.2f} dB")
    verdicts = []
    for options in (BuildOptions(), BuildOptions(1), BuildOptions(64), BuildOptions(16, 0.7)):
        tree = build_tree(levels[0], options=options)
        for level, value in zip(levels[1:], shipped, strict=True):
            cut = uniform_cut(tree, len(level))
            behind = value - score(tree.gaussians.take(cut))
            print(f"  {options}, {len(cut)}: {behind:.2f} dB behind", flush=True)
            if options == BuildOptions():
                what = f"merged, {len(level)} splats: behind the trained level, dB"
                verdicts.append(Verdict(what, behind, MOST_BEHIND_DB))
    return verdicts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["speed", "cities", "quality"])
    parser.add_argument("--out", type=Path, default=Path("out/trees"))
    parser.add_argument("--json", type=Path, metavar="FILE", help="verdicts of quality")
    arguments = parser.parse_args()
    print(in_words(describe()))
    if arguments.what == "cities":
        arguments.out.mkdir(parents=True, exist_ok=True)
        sys.exit(1 if cities(arguments.out) else 0)
    if arguments.what == "quality":
        verdicts = quality()
        if arguments.json:
            arguments.json.write_text(json.dumps([verdict.as_row() for verdict in verdicts]))
        sys.exit(0 if all(verdict.passed for verdict in verdicts) else 1)
    speed()


if __name__ == "__main__":
    main()
