"""What the cloud side is held to, and whether a measurement passes.

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
# At 6 px the smaller sparse city ends before detail does; at this tau most of what changes lies
# inside it. Both are judged.
GROWTH_TAU_PX = 15.0
WORST_OF_STREAMING = 1.5
FULL_SIZE = 20_000_000  # leaves of the trees the rates are meant for
RATES_MBPS = {"city, walk": 1.3, "dense_city, walk": 12.0, "dense_city, head": 0.5}
HELD_TO_IT = "compact-512x2"  # the compact codec's default; others stand beside it
DECODED_DB = 44.0  # 0.1 dB at 27.7 dB against the ground truth
PICTURES_MS = {120.0: 60.0, 60.0: 200.0}  # by tau in px, at 100 Mbps

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

    @classmethod
    def from_row(cls, row: Row) -> Verdict:
        """Inverse of `as_row`."""
        return cls(row["what"], row["value"], row["target"], row["at_least"])


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
    for what, key in (
        ("worst search after teleports", "cpu_max_ms"),
        ("first search", "cpu_first_ms"),
    ):
        value = auto[key] / streaming[key]
        text = f"{place.name}: {what} of auto, times streaming's"
        yield Verdict(text, value, WORST_OF_STREAMING)


def growth_verdicts(place: Place, last: str, row: Row) -> Iterator[Verdict]:
    """Of the wheel from a tree to a larger one at the same views, as it is and per change."""
    if place.leaves_m > 4:
        what = f"{place.name} to {last}, w = {row['every']}, tau {row['tau_px']:g} px"
        yield Verdict(f"growth of wheel, {what}", row["time"], GROWTH)
        yield Verdict(f"growth of wheel per change, {what}", row["time per change"], GROWTH)


def build_verdicts(name: str, built: Row) -> Iterator[Verdict]:
    """Of a report of ``nebula build-tree``; the seconds are meant for two free cores."""
    directional = built["sh_degree"] > 1
    per_million = built["build_s"] / (built["leaves"] / 1e6)
    yield Verdict(f"{name}: building, s per M leaves", per_million, 0.8 if directional else 0.5)
    yield Verdict(f"{name}: peak of the build, GiB", built["peak_rss_bytes"] / 2**30, 6.0)


def memory_verdicts(name: str, rows: list[Row]) -> Iterator[Verdict]:
    """Of `benchmarks.search_memory`."""
    for row in rows:
        limit = row["limit_bytes"] / 2**30
        yield Verdict(f"{name}: peak of {row['method']}, GiB", row["peak_bytes"] / 2**30, limit)


def rate_verdicts(what: str, leaves: int, rows: dict[str, Row]) -> Iterator[Verdict]:
    """Of `benchmarks.stream rate`, at full size."""
    target = next(mbps for start, mbps in RATES_MBPS.items() if what.startswith(start))
    if leaves >= FULL_SIZE:
        yield Verdict(f"{what}: {HELD_TO_IT}, Mbps", rows[HELD_TO_IT]["mbps"], target)


def loss_verdicts(scene: str, rows: dict[str, Row]) -> Iterator[Verdict]:
    """Of `benchmarks.stream loss`."""
    found = rows[HELD_TO_IT]["decoded_vs_cut_db"]
    yield Verdict(f"{scene}: {HELD_TO_IT} against the cut, dB", found, DECODED_DB, True)


def picture_verdicts(name: str, results: dict[str, Row]) -> Iterator[Verdict]:
    """Of the compact codec in `benchmarks.first_picture`, by the line alone."""
    for occasion in ("connect", "teleport"):
        for picture in results["compact"][occasion]["pictures"]:
            goal = PICTURES_MS.get(picture["tau_px"])
            if goal is not None and picture["line_s"] is not None:
                what = f"{name}: {occasion}, {picture['tau_px']:g} px complete, ms"
                yield Verdict(what, 1e3 * picture["line_s"], goal)
