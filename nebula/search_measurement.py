"""LoD searches along a trace: timed one method at a time, and compared with the flat search.

Every method has the machine to itself, as it would have in a server; what the flat search found is
remembered as checksums. Equal events at every search mean equal cuts at every search.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.parallel import threads
from lod_cloud.criterion import SearchRequest
from lod_cloud.lod_tree import Int32
from lod_cloud.search import RuleSearch, Search, SearchResult

DROPPED = 10  # searches at the start of a trace that are not counted: first fill, cold caches
MEASURED = 450
LONGEST_GAP_FRAMES = 128
_RULE_SAMPLES = 40  # changes of a rule's set are counted at so many searches

Signature = tuple[int, int, int]  # checksums of both lists of events, size of the cut


@dataclass(frozen=True)
class Measured:
    """One method along one trace."""

    row: dict[str, Any]  # for people and JSON
    signatures: list[Signature]  # of every search, the dropped ones included; none for a rule
    times_ms: NDArray[np.float64]  # [searches] of those counted


def measure_search(
    search: Search,
    requests: Sequence[SearchRequest],
    frames_per_search: int,
    reference: Sequence[Signature] | None = None,
) -> Measured:
    """Let a fresh search answer every request. Without a reference it is its own, and the overlap
    of its cuts is measured too.
    """
    signatures, times_ms, cpu_ms, counts = [], [], [], []
    overlap = _Overlap(len(search.tree), frames_per_search)
    for index, request in enumerate(requests):
        begin, cpu_begin = time.perf_counter(), time.process_time()
        result = search.search(request)
        cpu_ms.append(1e3 * (time.process_time() - cpu_begin))
        times_ms.append(1e3 * (time.perf_counter() - begin))
        signatures.append(_signature(result))
        counts.append(_counts(result))
        if reference is None and overlap.wanted(index):
            overlap.note(index, result.cut)
    counted = np.array(times_ms[DROPPED:])
    compared = zip(signatures, reference or signatures, strict=True)
    identical = sum(own == other for own, other in list(compared)[DROPPED:])
    tested, touched, adds, removes, sizes = np.mean(counts[DROPPED:], axis=0)
    row = _row(search.name, counted, cpu_ms, times_ms[0]) | {
        "nodes_tested_mean": float(tested),
        "bytes_touched_mean": float(touched),
        "adds_mean": float(adds),
        "removes_mean": float(removes),
        "cut_size_mean": float(sizes),
        "overlap": overlap.shares(),
        "identical_to_flat": identical,
        "state_bytes": search.state_bytes,
    }
    return Measured(row, signatures, counted)


def measure_rule(
    rule: RuleSearch, requests: Sequence[SearchRequest], frames_per_search: int
) -> Measured:
    """Let a baseline rule answer every request. Its set is another one by construction:
    ``identical_to_flat`` is None.
    """
    times_ms, cpu_ms, counts, changes = [], [], [], []
    overlap = _Overlap(len(rule.tree), frames_per_search)
    stride = max(1, (len(requests) - DROPPED) // _RULE_SAMPLES)
    before: Int32 | None = None
    for index, request in enumerate(requests):
        begin, cpu_begin = time.perf_counter(), time.process_time()
        selection = rule.select(request)
        cpu_ms.append(1e3 * (time.process_time() - cpu_begin))
        times_ms.append(1e3 * (time.perf_counter() - begin))
        ids = selection.node_ids
        counts.append((selection.nodes_tested, selection.bytes_touched, len(ids)))
        if before is not None:
            both = len(np.intersect1d(before, ids, assume_unique=True))
            changes.append((len(ids) - both, len(before) - both))
        before = ids if index >= DROPPED - 1 and index % stride == 0 else None
        if overlap.wanted(index):
            overlap.note(index, ids)
    counted = np.array(times_ms[DROPPED:])
    tested, touched, sizes = np.mean(counts[DROPPED:], axis=0)
    adds, removes = np.mean(changes, axis=0)
    row = _row(rule.name, counted, cpu_ms, times_ms[0]) | {
        "nodes_tested_mean": float(tested),
        "bytes_touched_mean": float(touched),
        "adds_mean": float(adds),
        "removes_mean": float(removes),
        "cut_size_mean": float(sizes),
        "overlap": overlap.shares(),
        "identical_to_flat": None,
        "state_bytes": 0,
    }
    return Measured(row, [], counted)


def _row(
    method: str, counted: NDArray[np.float64], cpu_ms: Sequence[float], first_ms: float
) -> dict[str, Any]:
    return {
        "method": method,
        "searches": len(counted),
        "p50_ms": float(np.percentile(counted, 50)),
        "p99_ms": float(np.percentile(counted, 99)),
        "max_ms": float(counted.max()),
        "cpu_p50_ms": float(np.percentile(cpu_ms[DROPPED:], 50)),  # of all threads together
        "cpu_max_ms": float(max(cpu_ms[DROPPED:])),
        "first_ms": first_ms,
        "cpu_first_ms": cpu_ms[0],
        "threads": threads(),
    }


def _signature(result: SearchResult) -> Signature:
    checksums = (zlib.crc32(e.tobytes()) for e in (result.expanded, result.collapsed))
    return (*checksums, result.cut_size)  # type: ignore[return-value] # three by construction


def _counts(result: SearchResult) -> tuple[int, int, int, int, int]:
    changes = (0, 0) if result.first else (len(result.added), len(result.removed))
    return (result.nodes_tested, result.bytes_touched, *changes, result.cut_size)


class _Overlap:
    """Share of a set that was selected some frames before (Fig. 7), from sets now and then."""

    def __init__(self, nodes: int, frames_per_search: int) -> None:
        gaps = 2 ** np.arange(LONGEST_GAP_FRAMES.bit_length())
        self._gaps = {
            int(g) // frames_per_search: int(g) for g in gaps if g % frames_per_search == 0
        }
        self._period = max(self._gaps, default=0) + 1
        self._member = np.zeros(nodes, np.bool_)
        self._shares: dict[int, list[float]] = {gap: [] for gap in self._gaps}

    def wanted(self, index: int) -> bool:
        """Whether the set of this search is of use."""
        since = (index - DROPPED) % self._period
        return index >= DROPPED and (since == 0 or since in self._gaps)

    def note(self, index: int, ids: Int32) -> None:
        since = (index - DROPPED) % self._period
        if since == 0:
            self._member[:] = False
            self._member[ids] = True
        else:
            self._shares[since].append(float(self._member[ids].mean()))

    def shares(self) -> dict[str, float]:
        """Mean share by gap in frames."""
        return {
            str(self._gaps[gap]): float(np.mean(values))
            for gap, values in self._shares.items()
            if values
        }
