"""What the LoD searches are held to (DESIGN, section 11), and whether a measurement passes.

Times on one thread are CPU times, so that another process does not change the verdict; what is
measured on two threads is wall time. A tree has targets by its size and by how many nodes a metre
of walk adds to the cut: streets change ten times as much as a sparse city.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

STREET_ADDS_PER_M = 30_000
METRES_PER_FRAME = 1.4 / 90  # walking
FLAT_NS_PER_NODE = 3.5  # slower than this the baseline would flatter everything else
GROWTH = 1.3
WORST_OF_STREAMING = 1.5

Row = dict[str, Any]


@dataclass(frozen=True)
class Verdict:
    """One number and its target."""

    what: str
    value: float
    target: float
    at_least: bool = False

    @property
    def passed(self) -> bool:
        return self.value >= self.target if self.at_least else self.value <= self.target

    def line(self) -> str:
        """As a line of text."""
        sign = ">=" if self.at_least else "<="
        word = "PASSED" if self.passed else "FAILED"
        return f"{word}: {self.what}: {self.value:.3g} (target {sign} {self.target:g})"

    def as_row(self) -> Row:
        """For JSON."""
        return asdict(self) | {"passed": self.passed}


@dataclass(frozen=True)
class Place:
    """What decides which targets hold for a tree."""

    name: str
    nodes: int
    street: bool  # dense, as scanned streets are

    @property
    def leaves_m(self) -> float:
        """About so many million leaves."""
        return self.nodes / 2e6


def is_street(row: Row, every: int) -> bool:
    """Whether a walk, searched every so many frames, changes as much as a scanned street."""
    return bool(row["adds_mean"] / (every * METRES_PER_FRAME) > STREET_ADDS_PER_M)


def walk_verdicts(place: Place, every: int, rows: dict[str, Row]) -> Iterator[Verdict]:
    """Of rows by method, measured along a walk on one thread."""
    where = f"{place.name}, walk, w = {every}"
    cpu = {method: row["cpu_p50_ms"] for method, row in rows.items()}
    yield Verdict(f"{where}: flat, ns/node", 1e6 * cpu["flat"] / place.nodes, FLAT_NS_PER_NODE)
    wheel = rows["wheel"]
    per_flat = Verdict(f"{where}: wheel, times flat", cpu["flat"] / cpu["wheel"], 100, True)
    if place.street and place.leaves_m > 15:
        yield Verdict(f"{where}: wheel p50, ms", cpu["wheel"], 1.5 if every >= 4 else 0.4)
        changes = wheel["adds_mean"] + wheel["removes_mean"]
        yield Verdict(f"{where}: wheel, us per change", 1e3 * cpu["wheel"] / changes, 0.2)
    elif place.leaves_m > 15:
        yield Verdict(f"{where}: wheel p50, ms", cpu["wheel"], 0.5)
        yield Verdict(f"{where}: wheel p99 (wall), ms", wheel["p99_ms"], 1.2)
        yield per_flat
    elif place.leaves_m > 4 and not place.street:
        yield Verdict(per_flat.what, per_flat.value, 40, True)
    if "octree_gs" in rows and not place.street and place.leaves_m > 4:
        value = cpu["octree_gs"] / cpu["wheel"]
        target = 300 if place.leaves_m > 15 else 100
        yield Verdict(f"{where}: wheel, times octree_gs", value, target, True)


def head_verdicts(place: Place, trace: str, every: int, wheel: Row) -> Iterator[Verdict]:
    """Of a recorded head."""
    if place.street and place.leaves_m > 15 and every >= 4:
        what = f"{place.name}, {trace}, w = {every}: wheel p50, ms"
        yield Verdict(what, wheel["cpu_p50_ms"], 0.3)


def two_thread_verdicts(place: Place, streaming: Row) -> Iterator[Verdict]:
    """Of `streaming` on two threads."""
    if place.leaves_m > 15:
        what = f"{place.name}: streaming on two threads p50 (wall), ms"
        yield Verdict(what, streaming["p50_ms"], 30)


def teleport_verdicts(place: Place, streaming: Row, auto: Row) -> Iterator[Verdict]:
    """Of a trace with teleports: the worst search, and the first. A small tree has no worst case
    to speak of.
    """
    if place.leaves_m <= 4:
        return
    for what, key in (("worst search after teleports", "max_ms"), ("first search", "first_ms")):
        value = auto[key] / streaming[key]
        text = f"{place.name}: {what} of auto, times streaming's (wall)"
        yield Verdict(text, value, WORST_OF_STREAMING)


def growth_verdict(first: str, last: str, times: list[float]) -> Verdict:
    """Of the wheel from a tree to a larger one at the same view."""
    return Verdict(f"growth of wheel from {first} to {last}", times[-1] / times[0], GROWTH)
