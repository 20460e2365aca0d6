"""Hierarchical sorting units: depth order of every tile's list (GSCore: pivots, then bitonic).

Lists are sorted per tile and pair, as in GSCore: they are made per tile, and one depth sort of all
splats before binning would have to finish before the first tile could start, with several passes
through DRAM. Right tiles fed by the stereo buffer are not sorted: their lists are merged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arch.component import Int64, Stream, UnitReport, schedule_rows, slowest
from arch.config import AcceleratorConfig, SortingTiming
from arch.memory.global_buffer import WORD_BYTES, bytes_per_core
from arch.units.binning_unit import own_right_lists
from gaussians.work import FrameWork, Int32


@dataclass(frozen=True)
class SortCost:
    """Cost of sorting a list, indexed by its length; every array is [longest + 1] int64."""

    cycles: Int64
    comparisons: Int64
    partition_passes: Int64
    passes: Int64  # times the list is read and written: partitions, network, merges


def sort_cost(timing: SortingTiming, longest: int) -> SortCost:
    """Cost of every list length from 0 to ``longest``.

    p partition passes, the fewest with ceil(n / subsets**p) <= chunk; each ceil(n / q) cycles and
    n * pivots comparisons. Then the width-w network, ceil(n / w) cycles, and ceil(log2(m / w))
    merge levels for chunks of m = ceil(n / subsets**p), each ceil(n / (w/2)) cycles: a w-wide
    bitonic merger puts out w/2 a cycle.
    """
    n = np.arange(longest + 1, dtype=np.int64)
    subsets, width = timing.pivots + 1, timing.network_width
    partitions = np.zeros_like(n)
    chunk = n
    while (large := chunk > timing.chunk_entries).any():
        partitions = partitions + large
        chunk = np.where(large, -(-n // subsets ** (partitions)), chunk)
    runs = -(-chunk // width)
    levels = np.where(n > 0, np.ceil(np.log2(np.maximum(runs, 1))), 0).astype(np.int64)
    depth = width.bit_length() - 1
    network, merge_steps = -(-n // width), -(-n // (width // 2))
    cycles = (
        partitions * -(-n // timing.partition_entries_per_cycle) + network + levels * merge_steps
    )
    exchanges = width // 2
    comparisons = partitions * n * timing.pivots + exchanges * (
        network * (depth * (depth + 1) // 2) + levels * merge_steps * depth
    )
    return SortCost(cycles, comparisons, partitions, partitions + (n > 0) + levels)


def sorting_unit(config: AcceleratorConfig, work: FrameWork) -> UnitReport:
    """Slowest unit, each tile row's lists going to the unit that is free first.

    A list longer than its share of the global buffer (half the buffer over the cores) spills what
    does not fit in every partition pass: written once and read once per pass.
    """
    unit = config.sorting_unit
    lists = [*_left_lists(work), own_right_lists(work)]
    cost = sort_cost(unit.timing, max((int(n.max()) for n in lists if n.size), default=0))
    row_cycles = np.concatenate([cost.cycles[n].sum(axis=1) for n in lists])
    owners = schedule_rows(row_cycles, unit.units.count)
    lengths = np.arange(len(cost.cycles), dtype=np.int64)
    histogram = np.zeros(len(lengths), np.int64)
    for n in lists:
        histogram += np.bincount(n.ravel(), minlength=len(lengths))
    entry = config.binning_unit.timing.pair_bytes
    over = np.maximum(0, lengths - bytes_per_core(config) // entry)
    spilled = int((histogram * cost.partition_passes * over).sum()) * entry
    moved = int((histogram * cost.passes * (-(-lengths * entry // WORD_BYTES))).sum())
    sentence = "parts of long lists that do not fit the global buffer while they are partitioned"
    return UnitReport(
        "sorting_unit",
        unit.units.count,
        slowest(row_cycles, owners),
        int(row_cycles.sum()),
        unit.fill.latency_cycles,
        {
            "sort_comparisons": int((histogram * cost.comparisons).sum()),
            "global_buffer_reads": moved,
            "global_buffer_writes": moved,
        },
        (Stream("sort_spill", sentence, spilled, spilled),),
    )


def _left_lists(work: FrameWork) -> list[Int32]:
    """List lengths of the left tiles, forward-only entries included.

    On off-axis displays the plane of left tiles is wider than the window; forward-only entries are
    then counted as lists of their own, which is slightly less than sorting them into the tile's
    list.
    """
    entries, forward_only = work.left.entries, work.stereo.forward_only
    if entries.shape == forward_only.shape:
        return [entries + forward_only]
    return [entries, forward_only]
