"""``python -m benchmarks.lod``: the LoD searches, each against the others in the same run.

    python -m benchmarks.lod --leaves 200000
    python -m benchmarks.lod --tree city5 --tree city20 --trace walk --trace teleport --every 1

Prints Markdown: per tree, trace and search interval one table of all methods on one thread, with
ratios to the flat scan and to the Octree-GS rule; then `streaming` on two threads, the worst case
of `auto` after teleports, and how the wheel grows from the first tree to the last. Run it on a
quiet machine: the load average stands in the first line.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import machine
from gaussians import parallel
from gaussians.cameras import DISPLAYS, Pose
from gaussians.poses import GENERATED_RATE_HZ
from gaussians.rotations import level_rotation
from gaussians.synthetic import generate_city
from lod_cloud import LodTree, SearchRequest, build_tree, load_tree
from lod_cloud.search import (
    SEARCHES,
    CityGaussianSearch,
    OctreeGsSearch,
    SearchTree,
    make_search,
)
from nebula.scene_input import head_trace
from nebula.search_measurement import DROPPED, MEASURED, Measured, measure_rule, measure_search

FOCAL_PX = DISPLAYS["prototype"].fx
FLAT_NS_PER_NODE = 3.5  # slower than this the baseline would flatter everything else
HEADS = (
    *("method", "p50 ms", "p99 ms", "max ms", "first ms", "tests", "bytes", "added", "removed"),
    *("set", "ns/node", "us/change", "x flat", "x octree_gs", "same as flat", "state MB"),
)


@dataclass(frozen=True)
class Subject:
    """A tree to search, and how to walk through it."""

    name: str
    tree: SearchTree
    up: str
    view: Pose

    @classmethod
    def of(cls, name: str, tree: LodTree) -> Subject:
        """Starts where the tree says, looking along its path."""
        metadata = tree.metadata
        axis = int(np.argmax(np.abs(metadata.up)))
        up = ("-" if metadata.up[axis] < 0 else "+") + "xyz"[axis]
        path = np.array(metadata.path)
        view = Pose(np.array(metadata.start), level_rotation(up, path[1] - path[0]))
        return cls(name, SearchTree.of(tree), up, view)

    def requests(self, trace: str, every: int, tau_px: float, searches: int) -> list[SearchRequest]:
        """One request every so many frames of a trace that begins at the subject's view."""
        poses = head_trace(trace, self.view, self.up, searches * every, GENERATED_RATE_HZ, 0)
        return [
            SearchRequest((float(x), float(y), float(z)), FOCAL_PX, tau_px)
            for x, y, z in poses.positions[::every]
        ]


def generated(leaves: int) -> Subject:
    """A city without directional colour, which no search looks at."""
    city = generate_city(leaves, 0, sh_degree=0)
    points = [(float(x), float(y), float(z)) for x, y, z in city.path]
    tree = build_tree(city.scene, up=(0.0, 0.0, 1.0), start=points[0], path=tuple(points))
    return Subject.of(f"city of {leaves} leaves", tree)


# ---------------------------------------------------------------- searches


def compare(subject: Subject, requests: Sequence[SearchRequest], every: int) -> dict[str, Measured]:
    """All methods and rules on one thread."""
    parallel.set_threads(1)
    flat = measure_search(make_search("flat", subject.tree), requests, every)
    found = {"flat": flat}
    for method in SEARCHES:
        if method != "flat":
            search = make_search(method, subject.tree)
            found[method] = measure_search(search, requests, every, flat.signatures)
    found["octree_gs"] = measure_rule(OctreeGsSearch(subject.tree), requests, every)
    vertical = tuple(float(c == subject.up[1]) for c in "xyz")
    found["city_gaussian"] = measure_rule(
        CityGaussianSearch(subject.tree, up=vertical),  # type: ignore[arg-type] # three numbers
        requests,
        every,
    )
    return found


def table(subject: Subject, found: dict[str, Measured]) -> list[str]:
    """Lines of Markdown."""
    flat, octree = found["flat"].row["p50_ms"], found["octree_gs"].row["p50_ms"]
    lines = [f"| {' | '.join(HEADS)} |", f"|---|{'---:|' * (len(HEADS) - 1)}"]
    for name, measured in found.items():
        row = measured.row
        changes = row["adds_mean"] + row["removes_mean"]
        same = row["identical_to_flat"]
        cells = [
            name,
            *(f"{row[key]:.3f}" for key in ("p50_ms", "p99_ms", "max_ms", "first_ms")),
            f"{row['nodes_tested_mean']:.0f}",
            f"{row['bytes_touched_mean']:.0f}",
            f"{row['adds_mean']:.0f}",
            f"{row['removes_mean']:.0f}",
            f"{row['cut_size_mean']:.0f}",
            f"{1e6 * row['p50_ms'] / len(subject.tree):.3f}",
            f"{1e3 * measured.times_ms.mean() / changes:.3f}" if changes else "",
            f"{flat / row['p50_ms']:.1f}",
            f"{octree / row['p50_ms']:.1f}",
            "another set" if same is None else f"{same} of {row['searches']}",
            f"{row['state_bytes'] / 1e6:.1f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    shares = ", ".join(f"{gap}: {share:.3%}" for gap, share in found["flat"].row["overlap"].items())
    return [*lines, "", f"Overlap with the cut so many frames ago: {shares}", ""]


def on_two_threads(subject: Subject, requests: Sequence[SearchRequest], every: int) -> Measured:
    """`streaming` with both cores."""
    parallel.set_threads(2)
    measured = measure_search(make_search("streaming", subject.tree), requests, every)
    parallel.set_threads(1)
    return measured


def worst_after_teleports(found: dict[str, Measured]) -> tuple[float, float]:
    """Longest search of `auto`, and of `streaming`, on a trace with teleports, ms."""
    return found["auto"].row["max_ms"], found["streaming"].row["max_ms"]


def search_section(
    subjects: Sequence[Subject],
    traces: Sequence[str],
    intervals: Sequence[int],
    tau_px: float,
    searches: int,
) -> tuple[list[str], list[dict[str, Any]]]:
    """Tables and their rows. Raises RuntimeError when the flat baseline is too slow to be fair."""
    lines: list[str] = []
    rows: list[dict[str, Any]] = []
    wheel: dict[tuple[str, int], list[float]] = {}
    for subject in subjects:
        for trace in traces:
            for every in intervals:
                requests = subject.requests(trace, every, tau_px, searches)
                found = compare(subject, requests, every)
                flat_ns = 1e6 * found["flat"].row["p50_ms"] / len(subject.tree)
                lines += [
                    f"### {subject.name}, {trace}, w = {every}, tau {tau_px:g} px, one thread",
                    "",
                    *table(subject, found),
                ]
                if flat_ns > FLAT_NS_PER_NODE:
                    lines += [f"FAILED: flat takes {flat_ns:.2f} ns per node", ""]
                if trace == "teleport":
                    auto, streaming = worst_after_teleports(found)
                    lines += [
                        f"Worst search of auto {auto:.2f} ms, of streaming {streaming:.2f} ms: "
                        f"{auto / streaming:.2f} times",
                        "",
                    ]
                two = on_two_threads(subject, requests[: DROPPED + 100], every)
                lines += [f"streaming on two threads: p50 {two.row['p50_ms']:.2f} ms", ""]
                wheel.setdefault((trace, every), []).append(found["wheel"].row["p50_ms"])
                rows += [
                    {"tree": subject.name, "trace": trace, "every": every, "tau_px": tau_px}
                    | measured.row
                    for measured in (*found.values(), two)
                ]
    if len(subjects) > 1:
        for (trace, every), times in wheel.items():
            lines.append(
                f"Growth of wheel from {subjects[0].name} to {subjects[-1].name}, {trace}, "
                f"w = {every}: {times[-1] / times[0]:.2f} times"
            )
    return lines, rows


# ---------------------------------------------------------------- command line


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--tree", action="append", type=Path, default=[], metavar="DIR")
    parser.add_argument("--leaves", action="append", type=int, default=[], metavar="N")
    parser.add_argument("--trace", action="append", default=[], metavar="NAME|CSV")
    parser.add_argument("--every", action="append", type=int, default=[], metavar="W")
    parser.add_argument("--tau", type=float, default=6.0, metavar="PX")
    parser.add_argument("--searches", type=int, default=MEASURED, help="counted ones")
    parser.add_argument("--json", type=Path, metavar="FILE")
    given = parser.parse_args(arguments)
    where = machine.describe()
    print(machine.in_words(where) + "\n")
    subjects = [Subject.of(str(path), load_tree(path)) for path in given.tree]
    subjects += [generated(leaves) for leaves in given.leaves]
    if not subjects:
        subjects = [generated(200_000)]
    lines, rows = search_section(
        subjects,
        given.trace or ["walk", "teleport"],
        given.every or [4],
        given.tau,
        DROPPED + given.searches,
    )
    print("\n".join(lines))
    if given.json:
        given.json.write_text(json.dumps({"machine": where, "searches": rows}, indent=2))


if __name__ == "__main__":
    main()
