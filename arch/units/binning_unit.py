"""Binning units: which tiles a splat touches, and the lists that wait for the sorting units."""

from __future__ import annotations

import numpy as np

from arch.component import Int64, Stream, UnitReport, ceil_div
from arch.config import AcceleratorConfig
from arch.memory.global_buffer import half_bytes, staging
from gaussians.work import FrameWork, Int32


def own_right_lists(work: FrameWork) -> Int32:
    """[tiles_y, columns] list lengths of right tiles that are binned and sorted on their own.

    All of them for independent eyes; the last columns for a method with independent edge tiles.
    """
    entries = work.right.entries
    if not work.shared_front_end:
        return entries
    columns = work.independent_right_tiles // max(1, entries.shape[0])
    return entries[:, entries.shape[1] - columns :]


def row_sums(array: Int32) -> Int64:
    """[tiles_y] int64 sums over the tiles of a row."""
    return np.asarray(array.sum(axis=1, dtype=np.int64))


def binning_unit(config: AcceleratorConfig, work: FrameWork) -> UnitReport:
    """Cycles = max(spans / (units * spans per cycle), pairs / (units * pairs per cycle)).

    A span is one (splat, tile row) entry of one eye; both eyes share the rows. Solver and emitter
    are pipelined. The whole frame is binned before its first tile can be sorted, so all lists wait
    in DRAM, less what half the global buffer holds: as spans per tile row (expanded when the row
    is rendered) or as pairs.
    """
    unit, timing = config.binning_unit, config.binning_unit.timing
    own_right = work.right_projected or not work.shared_front_end
    spans = work.front_end.row_entries * (2 if own_right else 1)
    pairs = _total(work.left.entries) + _total(work.stereo.forward_only)
    pairs += _total(own_right_lists(work))
    busy_spans = ceil_div(spans, timing.spans_per_cycle)
    busy_pairs = ceil_div(pairs, timing.pairs_per_cycle)
    list_bytes = _waiting_bytes(config, work, pairs, own_right)
    off_chip = max(0, list_bytes - half_bytes(config))
    stream = Stream(
        "tile_lists",
        f"lists between binning and sorting, as {timing.list_layout}",
        off_chip,
        off_chip,
        timing.burst_bytes,
    )
    busy = max(busy_spans, busy_pairs)
    return UnitReport(
        "binning_unit",
        unit.units.count,
        ceil_div(busy, unit.units.count),
        busy,
        unit.fill.latency_cycles,
        {"row_spans_solved": spans, "pairs_emitted": pairs, **staging(list_bytes)},
        (stream,),
    )


def _waiting_bytes(config: AcceleratorConfig, work: FrameWork, pairs: int, own_right: bool) -> int:
    """Bytes of all lists between binning and sorting."""
    timing = config.binning_unit.timing
    if timing.list_layout == "pairs":
        return pairs * timing.pair_bytes
    if not work.shared_front_end:
        return 2 * work.front_end.row_entries * timing.span_bytes
    right = timing.right_span_bytes if own_right else 0
    return work.front_end.row_entries * (timing.span_bytes + right)


def _total(array: Int32) -> int:
    return int(array.sum(dtype=np.int64))
