"""``python -m benchmarks.searches``: the LoD searches, each against the others in the same run.

    python -m benchmarks.searches --leaves 200000
    python -m benchmarks.searches --tree city5 --tree city20 --head alameda.csv --json lod.json

Prints Markdown: per tree the walk at w = 4 by all methods on one thread, with ratios to the flat
scan and to the Octree-GS rule; the walk at w = 1 and a recorded head by the wheel; teleports by
`auto` and `streaming`; `streaming` on two threads; the wheel's growth from the first tree to the
last, on a walk from the middle of the first, beside that of the changes it finds. Then every number
that has a target, PASSED or FAILED. Methods that take longer than a streamed search make 110
searches, of which 100 count, the others 460. Run it on a quiet machine: the load average stands in
the first line.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import lod_targets, machine
from benchmarks.lod_targets import Place, Verdict
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
SLOW_SEARCHES = DROPPED + 100
WALK, TELEPORT = "walk", "teleport"
HEADS = (
    *("method", "p50 ms", "p99 ms", "max ms", "first ms", "tests", "bytes", "added", "removed"),
    *(
        "set",
        "ns/node",
        "us/change",
        "CPU p50 ms",
        "x flat",
        "x octree_gs",
        "same as flat",
        "state MB",
    ),
)


@dataclass(frozen=True)
class Subject:
    """A tree to search, and how to walk through it."""

    name: str
    tree: SearchTree
    up: str
    view: Pose
    middle: Pose  # of the path

    @classmethod
    def of(cls, name: str, tree: LodTree) -> Subject:
        """Starts where the tree says, looking along its path."""
        metadata = tree.metadata
        axis = int(np.argmax(np.abs(metadata.up)))
        up = ("-" if metadata.up[axis] < 0 else "+") + "xyz"[axis]
        path = np.array(metadata.path)
        ahead = level_rotation(up, path[1] - path[0])
        view, middle = Pose(np.array(metadata.start), ahead), Pose(path[len(path) // 2], ahead)
        return cls(name, SearchTree.of(tree), up, view, middle)

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


def compare(
    subject: Subject, requests: Sequence[SearchRequest], every: int, methods: Sequence[str]
) -> dict[str, Measured]:
    """`flat`, `streaming` and other methods on one thread; all of a trace by those that are fast.

    Slow ones are compared with `flat`, the others with `streaming`, which is compared with `flat`.
    """
    parallel.set_threads(1)
    few = requests[:SLOW_SEARCHES]
    flat = measure_search(make_search("flat", subject.tree), few, every)
    streaming = measure_search(make_search("streaming", subject.tree), requests, every)
    if streaming.signatures[: len(few)] != flat.signatures:
        raise RuntimeError(f"{subject.name}: streaming and flat must find the same cuts")
    found = {"flat": flat, "streaming": streaming}
    for method in methods:
        if method in found:
            continue
        fast = method in ("wheel", "auto")
        search = make_search(method, subject.tree)
        asked, reference = (requests, streaming) if fast else (few, flat)
        found[method] = measure_search(search, asked, every, reference.signatures)
        same = found[method].row["identical_to_flat"]
        if same != found[method].row["searches"]:
            raise RuntimeError(f"{subject.name}: {method} and flat must find the same cuts")
    return found


def rules(subject: Subject, requests: Sequence[SearchRequest], every: int) -> dict[str, Measured]:
    """The baseline rules on one thread."""
    vertical = tuple(float(c == subject.up[1]) for c in "xyz")
    blocks = CityGaussianSearch(subject.tree, up=vertical)  # type: ignore[arg-type] # three numbers
    few = requests[:SLOW_SEARCHES]
    return {
        rule.name: measure_rule(rule, few, every) for rule in (OctreeGsSearch(subject.tree), blocks)
    }


def table(subject: Subject, found: dict[str, Measured]) -> list[str]:
    """Lines of Markdown."""
    octree = found["octree_gs"].row["cpu_p50_ms"] if "octree_gs" in found else None
    flat = found["flat"].row["cpu_p50_ms"]
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
            f"{1e6 * row['cpu_p50_ms'] / len(subject.tree):.3f}",
            f"{1e3 * row['cpu_p50_ms'] / changes:.3f}" if changes else "",
            f"{row['cpu_p50_ms']:.3f}",
            f"{flat / row['cpu_p50_ms']:.1f}",
            f"{octree / row['cpu_p50_ms']:.1f}" if octree else "",
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


def _growth(small: dict[str, Any], large: dict[str, Any]) -> dict[str, float]:
    """From row to row: CPU milliseconds, and what they are spent on."""
    times = [row["cpu_p50_ms"] for row in (small, large)]
    changes = [row["adds_mean"] + row["removes_mean"] for row in (small, large)]
    return {
        "ms, small": times[0],
        "ms, large": times[1],
        "time": times[1] / times[0],
        "changes": changes[1] / changes[0],
        "cut": large["cut_size_mean"] / small["cut_size_mean"],
        "time per change": times[1] / times[0] * changes[0] / changes[1],
    }


class Report:
    """Lines, rows and verdicts of a run."""

    def __init__(self, tau_px: float, searches: int) -> None:
        self.lines: list[str] = []
        self.rows: list[dict[str, Any]] = []
        self.verdicts: list[Verdict] = []
        self._tau_px, self._searches = tau_px, searches

    def tree(self, subject: Subject, heads: Sequence[str], intervals: Sequence[int]) -> None:
        """Everything about one tree."""
        street = False
        for every in intervals:
            everything = every == max(intervals)
            methods = list(SEARCHES) if everything else []
            found = self._section(subject, WALK, every, methods, everything)
            rows = {name: measured.row for name, measured in found.items()}
            street = lod_targets.is_street(rows["flat"], every)
            place = Place(subject.name, len(subject.tree), street)
            self.verdicts += lod_targets.walk_verdicts(place, every, rows)
        every = max(intervals)
        place = Place(subject.name, len(subject.tree), street)
        for head in heads:
            found = self._section(subject, head, every, ["wheel"], False)
            self.verdicts += lod_targets.head_verdicts(
                place, Path(head).stem, every, found["wheel"].row
            )
        found = self._section(subject, TELEPORT, every, ["auto"], False)
        self.verdicts += lod_targets.teleport_verdicts(
            place, found["streaming"].row, found["auto"].row
        )
        requests = subject.requests(WALK, every, self._tau_px, SLOW_SEARCHES)
        two = on_two_threads(subject, requests, every)
        self._keep(subject, WALK, every, self._tau_px, {"streaming": two})
        self.verdicts += lod_targets.two_thread_verdicts(place, two.row)

    def growth(self, first: Subject, last: Subject, intervals: Sequence[int]) -> None:
        """How the wheel grows from a tree to a larger one that contains it, at the same views: at
        the tau of the report, and at one whose detail ends nearer.
        """
        inside = replace(first, view=first.middle)  # as far from its edge as can be
        name = f"{WALK} in the middle of {first.name}"
        rows = []
        for tau_px in sorted({self._tau_px, lod_targets.GROWTH_TAU_PX}):
            for every in intervals:
                requests = inside.requests(WALK, every, tau_px, self._searches)
                small, large = (
                    self._compared(subject, name, requests, every, ["wheel"], False)["wheel"].row
                    for subject in (first, last)
                )
                row = {"tau_px": tau_px, "every": every} | _growth(small, large)
                place = Place(first.name, len(first.tree), lod_targets.is_street(small, every))
                self.verdicts += lod_targets.growth_verdicts(place, last.name, row)
                rows.append(row)
        self.lines += [f"### Wheel, from {first.name} to {last.name}, {name}", ""]
        self.lines += [f"| {' | '.join(rows[0])} |", f"|---|{'---:|' * (len(rows[0]) - 1)}"]
        self.lines += [f"| {' | '.join(f'{v:.3g}' for v in row.values())} |" for row in rows]
        self.lines.append("")

    def _section(
        self, subject: Subject, trace: str, every: int, methods: Sequence[str], everything: bool
    ) -> dict[str, Measured]:
        requests = subject.requests(trace, every, self._tau_px, self._searches)
        name = Path(trace).stem
        return self._compared(subject, name, requests, every, [*methods, "wheel"], everything)

    def _compared(
        self,
        subject: Subject,
        name: str,
        requests: Sequence[SearchRequest],
        every: int,
        methods: Sequence[str],
        everything: bool,
    ) -> dict[str, Measured]:
        found = compare(subject, requests, every, methods)
        if everything:
            found |= rules(subject, requests, every)
        self.lines += [
            f"### {subject.name}, {name}, w = {every}, tau {requests[0].tau_px:g} px, one thread",
            "",
            *table(subject, found),
        ]
        self._keep(subject, name, every, requests[0].tau_px, found)
        return found

    def _keep(
        self, subject: Subject, trace: str, every: int, tau_px: float, found: dict[str, Measured]
    ) -> None:
        setting = {"tree": subject.name, "trace": trace, "every": every, "tau_px": tau_px}
        self.rows += [setting | measured.row for measured in found.values()]


# ---------------------------------------------------------------- command line


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--tree", action="append", type=Path, default=[], metavar="DIR")
    parser.add_argument("--leaves", action="append", type=int, default=[], metavar="N")
    parser.add_argument("--head", action="append", default=[], metavar="CSV", help="recorded")
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
    report = Report(given.tau, DROPPED + given.searches)
    intervals = given.every or [4, 1]
    for subject in subjects:
        report.tree(subject, given.head, intervals)
    if len(subjects) > 1:
        report.growth(subjects[0], subjects[-1], intervals)
    print("\n".join([*report.lines, *(verdict.line() for verdict in report.verdicts)]))
    if given.json:
        verdicts = [verdict.as_row() for verdict in report.verdicts]
        found = {"machine": where, "searches": report.rows, "verdicts": verdicts}
        given.json.write_text(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
