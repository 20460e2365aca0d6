"""What every unit has: count and fill, and a report of cycles, activity and DRAM traffic."""

from __future__ import annotations

import heapq
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from arch.provenance import Provenance

Int64 = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class Units(Provenance):
    """How many instances of a unit there are."""

    count: int

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(1, "count")


@dataclass(frozen=True, kw_only=True)
class Fill(Provenance):
    """Cycles from the first input of a unit to its first output."""

    latency_cycles: int

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(0, "latency_cycles")


@dataclass(frozen=True)
class Stream:
    """One kind of DRAM traffic in a frame."""

    name: str
    sentence: str
    read_bytes: int = 0
    write_bytes: int = 0
    granule_bytes: int = 0  # contiguous bytes per random request; 0: sequential


@dataclass(frozen=True)
class UnitReport:
    """One kind of unit in one frame.

    ``cycles``: until the slowest instance has finished; ``busy_cycles``: cycles in use, summed
    over the instances. Utilisation is busy / (instances * frame cycles).
    """

    name: str
    instances: int
    cycles: int
    busy_cycles: int
    latency_cycles: int = 0  # pipeline fill, counted once per frame
    counts: Mapping[str, int] = field(default_factory=dict)
    streams: tuple[Stream, ...] = ()


def ceil_div(numerator: int, denominator: int) -> int:
    """Integer division, rounded up."""
    return -(-numerator // denominator)


def schedule_rows(row_cycles: Int64, instances: int) -> NDArray[np.intp]:
    """Which instance takes each tile row: rows in order, each to the instance that is free first.

    Ties go to the lowest number, so with equal rows this is round robin. ``row_cycles`` [rows].
    """
    owners = np.empty(len(row_cycles), np.intp)
    free = [(0, instance) for instance in range(instances)]
    for row, cycles in enumerate(row_cycles.tolist()):
        at, instance = heapq.heappop(free)
        owners[row] = instance
        heapq.heappush(free, (at + cycles, instance))
    return owners


def slowest(row_cycles: Int64, owners: NDArray[np.intp]) -> int:
    """Cycles of the instance that finishes last, each row running on its owner."""
    if len(row_cycles) == 0:
        return 0
    totals = np.zeros(int(owners.max()) + 1, np.int64)
    np.add.at(totals, owners, row_cycles)
    return int(totals.max())
