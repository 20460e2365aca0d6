"""``python -m benchmarks.lod``: everything the cloud side is held to, in one run.

    python -m benchmarks.lod --folder out/lod
    python -m benchmarks.lod --folder out/lod --leaves 200000

Builds the sparse and the dense city, at ``--leaves`` and at a quarter of them, where the folder
does not hold them yet; searches all four, measures the memory a search takes, streams walks and a
recorded head, compares what is decoded with what was coded, and waits for first pictures. Each
part is a program of its own (`benchmarks.tree`, `searches`, `search_memory`, `stream`,
`first_picture`) and prints its own tables; at the end every number with a target, PASSED or FAILED.
Full size takes about half an hour on two free cores, 30 GB of disk and 6 GiB of memory. What needs
real data is left out, and said so, without ``$NEBULA_DATA``.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks import lod_targets, machine
from benchmarks.lod_targets import Verdict
from benchmarks.tree import build, line, warm_up
from nebula.config import data_root

HEAD = "traces/eyenavgs/user113_alameda.csv"
PLAYBOT, ST_PETER = "scenes/playbot_lod/lod-meta.json", "scenes/st_peter/st-peter.sog"
HYSTERESIS = "0.02"
PARTS = ("build", "search", "memory", "stream", "loss", "picture", "quality")


def run(name: str, *arguments: str, report: Path | None = None) -> Any:
    """Another benchmark, its output passed on; what it wrote to ``report``."""
    print(f"\n## {name} {' '.join(arguments)}\n", flush=True)
    target = []
    if report:
        report.unlink(missing_ok=True)
        target = ["--json", str(report)]
    done = subprocess.run([sys.executable, "-m", f"benchmarks.{name}", *arguments, *target])
    if done.returncode and not (report and report.exists()):  # else: a target was missed
        raise SystemExit(f"benchmarks.{name} ended with status {done.returncode}")
    return json.loads(report.read_text()) if report else None


def build_trees(folder: Path, leaves: int) -> Iterator[Verdict]:
    """What is not there yet: the small trees without directional colour, the large ones with it."""
    print("\n## building\n", flush=True)
    warm_up()
    for kind in ("city", "dense_city"):
        for part, degree in ((4, "0"), (1, "3")):
            out = folder / _name(kind, leaves // part)
            if not out.exists():
                size = "--city-leaves", str(leaves // part)
                found = build(out, "--tiled", kind, *size, "--sh-degree", degree)
                print(line(out.name, found), flush=True)
            report = out.with_suffix(".json")
            if report.exists():  # built by this program, now or before
                yield from lod_targets.build_verdicts(out.name, json.loads(report.read_text()))


def _name(kind: str, leaves: int) -> str:
    return f"{kind}-{leaves}"


def search(folder: Path, leaves: int, heads: Sequence[str]) -> Iterator[Verdict]:
    """The searches, in both cities."""
    for kind in ("city", "dense_city"):
        trees = [str(folder / _name(kind, leaves // part)) for part in (4, 1)]
        given = [word for tree in trees for word in ("--tree", tree)]
        given += [word for head in heads for word in ("--head", head)]
        found = run("searches", *given, report=folder / f"searches-{kind}.json")
        yield from (Verdict.from_row(row) for row in found["verdicts"])


def memory(tree: Path) -> Iterator[Verdict]:
    """Peak memory of the searches of a stored tree."""
    found = run("search_memory", "--tree", str(tree), report=tree.parent / "memory.json")
    yield from lod_targets.memory_verdicts(tree.name, found["rows"])


def stream(folder: Path, leaves: int, heads: Sequence[str]) -> Iterator[Verdict]:
    """Rates of walks, and of a recorded head with hysteresis."""
    for kind in ("city", "dense_city"):
        tree = folder / _name(kind, leaves)
        found = run("stream", "rate", "--tree", str(tree), report=folder / f"stream-{kind}.json")
        yield from lod_targets.rate_verdicts(f"{kind}, walk", leaves, found)
    for head in heads:
        given = "rate", "--tree", str(tree), "--trace", head, "--hysteresis", HYSTERESIS
        found = run("stream", *given, report=folder / "stream-head.json")
        yield from lod_targets.rate_verdicts("dense_city, head", leaves, found)


def loss(folder: Path, leaves: int, real: bool) -> Iterator[Verdict]:
    """What decoding loses: generated cities, and real scenes where they are."""
    scenes: dict[str, tuple[str, ...]] = {"city of 60000": ("--city", "60000")}
    for kind in ("city", "dense_city"):
        tree = str(folder / _name(kind, leaves))
        scenes[kind] = ("--tree", tree, "--codec", lod_targets.HELD_TO_IT)
    if real:
        scenes["PLAYBOT"] = (
            *("--scene", str(data_root() / PLAYBOT), "--level", "1"),
            *("--up=-y", "--size", "512"),
            *("--view", "1.5,-1,1.5:0,-0.3,0", "--view", "0,-0.6,1.2:0,-0.4,0"),
            *("--view=-0.4,-0.25,0.8:0,-0.15,0",),
        )
        scenes["St Peter"] = (
            *("--scene", str(data_root() / ST_PETER), "--up=-y"),
            *("--size", "512", "--view", "0,-0.3,3.2:0,0.1,0", "--view", "3.2,-0.3,0:0,0.1,0"),
            *("--view", "2,-0.3,2:0,0.1,0"),
        )
    for name, given in scenes.items():
        found = run("stream", "loss", *given, report=folder / "loss.json")
        yield from lod_targets.loss_verdicts(name, found)


def picture(tree: Path) -> Iterator[Verdict]:
    """First pictures after connecting and after a teleport."""
    given = "--tree", str(tree), "--every", "1"
    found = run("first_picture", *given, report=tree.parent / "first_picture.json")
    yield from lod_targets.picture_verdicts(tree.name, found["results"])


def quality(folder: Path) -> Iterator[Verdict]:
    """Merged levels against separately trained ones."""
    found = run("tree", "quality", report=folder / "quality.json")
    yield from (Verdict.from_row(row) for row in found)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is asked for, then list the verdicts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--folder", type=Path, default=Path("out/lod"))
    parser.add_argument("--leaves", type=int, default=20_000_000, help="of the larger trees")
    parser.add_argument("--part", action="append", choices=PARTS, help="only this; may be repeated")
    given = parser.parse_args(arguments)
    given.folder.mkdir(parents=True, exist_ok=True)
    parts = given.part or PARTS
    real = data_root().is_dir()
    if not real:
        print(f"{data_root()} is not there: no recorded heads, no real scenes")
    where = machine.describe()
    print(machine.in_words(where))
    heads = [str(data_root() / HEAD)] if real else []
    dense = given.folder / _name("dense_city", given.leaves)
    makers = {
        "build": lambda: build_trees(given.folder, given.leaves),
        "search": lambda: search(given.folder, given.leaves, heads),
        "memory": lambda: memory(dense),
        "stream": lambda: stream(given.folder, given.leaves, heads),
        "loss": lambda: loss(given.folder, given.leaves, real),
        "picture": lambda: picture(dense),
    }
    if real:
        makers["quality"] = lambda: quality(given.folder)
    verdicts = [verdict for part in parts if part in makers for verdict in makers[part]()]
    print("\n## Targets\n")
    print("\n".join(verdict.line() for verdict in verdicts))
    print(f"{sum(verdict.passed for verdict in verdicts)} of {len(verdicts)} passed")
    report = {"machine": where, "verdicts": [verdict.as_row() for verdict in verdicts]}
    (given.folder / "lod.json").write_text(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
