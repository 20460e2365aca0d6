"""Volume rendering cores (VRC): rendering units, feature buffer, SRU, stereo buffer, merge unit.

A tile row stays on one core, because the stereo buffer is the core's own. With a shared front end
the core renders left and right tiles of the row in turn; independent eyes are separate rows of
work.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arch.component import Int64, Stream, UnitReport, ceil_div, schedule_rows, slowest
from arch.config import AcceleratorConfig, StereoConfig
from arch.results import Stall, StereoBufferUse
from arch.units.binning_unit import row_sums
from arch.units.merge_unit import MergeRows, merge_unit
from arch.units.stereo_buffer import StereoBufferRows, stereo_buffer
from arch.units.stereo_reprojection_unit import ReprojectionRows, stereo_reprojection_unit
from gaussians.work import EyeWork, FrameWork

Owners = NDArray[np.intp]

WORD_BYTES = 16
STALLS = {
    "wait_for_sru": "left list walked, row writes of the SRU outstanding",
    "wait_for_merge_unit": "right tile waits for the merged list",
    "wait_for_stereo_spill": "merge unit waits for entries spilled to DRAM",
    "feature_buffer_chunks": "a list longer than the feature buffer starts another chunk",
}


@dataclass(frozen=True)
class RasterReport:
    """The cores and what stands inside them, with the cores' waits."""

    units: tuple[UnitReport, ...]
    stalls: tuple[Stall, ...]
    stereo_buffer: StereoBufferUse | None


@dataclass(frozen=True)
class _EyeRows:
    """Per tile row of one eye, [tiles_y] int64, and feature fetches of the whole eye."""

    rendering: Int64  # cycles the rendering units are given entries
    chunk_stall: Int64
    fetched_records: int


def passes_per_entry(config: AcceleratorConfig, tile_px: int) -> int:
    """Times an entry is broadcast when a core has fewer rendering units than a tile has pixels."""
    return ceil_div(tile_px * tile_px, config.volume_rendering_core.rendering_units.per_core)


def volume_rendering_cores(config: AcceleratorConfig, work: FrameWork) -> RasterReport:
    """Slowest core; cycles of a tile row =

    max(left list walk, SRU) + max(right list walk, merge unit) + chunk switches + waits for
    spilled entries. A list walk takes ``passes_per_entry`` cycles per processed entry, one per
    entry read for the SRU alone, and ``tile_switch_cycles`` per tile. SRU and merge unit run
    beside the walk, decoupled over a tile row by queues.
    """
    left, right = _eye_rows(config, work, work.left), _eye_rows(config, work, work.right)
    sru, merge = stereo_reprojection_unit(config, work), merge_unit(config, work)
    buffer = _buffer_rows(config, work)
    spill_stall = buffer.stall_cycles if buffer else np.zeros_like(left.rendering)
    headers = row_sums(work.stereo.forward_only) + row_sums(work.stereo.walked_after_termination)
    switch = config.volume_rendering_core.timing.tile_switch_cycles * work.left.entries.shape[1]
    left_walk, right_walk = left.rendering + headers + switch, right.rendering + switch
    left_rows = np.maximum(left_walk, sru.cycles) + left.chunk_stall
    right_rows = np.maximum(right_walk, merge.cycles) + right.chunk_stall + spill_stall
    jobs = _jobs(work, left_rows, right_rows)
    owners = schedule_rows(jobs, config.volume_rendering_core.units.count)
    units = [
        _core_report(config, work, left, right, jobs, owners, int(headers.sum())),
        _rendering_report(config, work, _jobs(work, left.rendering, right.rendering), owners),
    ]
    if buffer and config.stereo:
        cores = config.volume_rendering_core.units.count
        units += _stereo_reports(config.stereo, work, sru, merge, buffer.stream, owners, cores)
    waits = {
        "wait_for_sru": np.maximum(0, sru.cycles - left_walk),
        "wait_for_merge_unit": np.maximum(0, merge.cycles - right_walk),
        "wait_for_stereo_spill": spill_stall,
        "feature_buffer_chunks": left.chunk_stall + right.chunk_stall,
    }
    stalls = tuple(Stall(name, STALLS[name], int(rows.sum())) for name, rows in waits.items())
    return RasterReport(tuple(units), stalls, buffer.use if buffer else None)


def _jobs(work: FrameWork, left_rows: Int64, right_rows: Int64) -> Int64:
    """Cycles of the pieces of work that stay on one core: rows of both eyes, or rows of each."""
    if work.shared_front_end:
        return left_rows + right_rows
    return np.concatenate([left_rows, right_rows])


def _buffer_rows(config: AcceleratorConfig, work: FrameWork) -> StereoBufferRows | None:
    if config.stereo is None:
        return None
    burst = config.dram.organisation.burst_bytes
    return stereo_buffer(config.stereo, work.stereo.fifo_entries, burst)


def _core_report(
    config: AcceleratorConfig,
    work: FrameWork,
    left: _EyeRows,
    right: _EyeRows,
    jobs: Int64,
    owners: Owners,
    headers: int,
) -> UnitReport:
    core = config.volume_rendering_core
    return UnitReport(
        "volume_rendering_core",
        core.units.count,
        slowest(jobs, owners),
        int(jobs.sum()),
        core.fill.latency_cycles,
        _raster_counts(config, work, left, right, headers),
        (_feature_stream(config, left, right), _frame_buffer_stream(config, work)),
    )


def _rendering_report(
    config: AcceleratorConfig, work: FrameWork, rendering: Int64, owners: Owners
) -> UnitReport:
    """Busy are the rendering units whose pixel is live: one check each."""
    core = config.volume_rendering_core
    lanes = core.units.count * core.rendering_units.per_core
    checks = _total(work.left.alpha_checks) + _total(work.right.alpha_checks)
    return UnitReport("rendering_unit", lanes, slowest(rendering, owners), checks)


def _stereo_reports(
    stereo: StereoConfig,
    work: FrameWork,
    sru: ReprojectionRows,
    merge: MergeRows,
    spill: Stream,
    owners: Owners,
    cores: int,
) -> list[UnitReport]:
    """SRUs and merge units, one of each per core; idle for independent eyes."""
    fill = stereo.fill.latency_cycles if work.shared_front_end else 0
    rows = len(sru.cycles)
    sru_counts = {
        "sru_entries_examined": int(sru.examined.sum()),
        "stereo_buffer_writes": int(sru.writes.sum()),
    }
    merge_counts = _merge_counts(work, int(merge.outputs.sum()))
    return [
        UnitReport(
            "stereo_reprojection_unit",
            cores,
            slowest(sru.cycles, owners[:rows]),
            int(sru.cycles.sum()),
            fill,
            sru_counts,
            (spill,),
        ),
        UnitReport(
            "merge_unit",
            cores,
            slowest(merge.cycles, owners[:rows]),
            int(merge.cycles.sum()),
            0,
            merge_counts,
        ),
    ]


def resident_records(config: AcceleratorConfig, work: FrameWork) -> int:
    """Feature records one eye's tile may hold: half the buffer where both eyes share the core."""
    records = config.volume_rendering_core.feature_buffer.records
    return records // 2 if work.shared_front_end else records


def _eye_rows(config: AcceleratorConfig, work: FrameWork, eye: EyeWork) -> _EyeRows:
    """Miss model of the feature buffer, and the chunks of long lists.

    The nearest ``resident_records`` of a list stay for the next tile of the row; of these a tile
    fetches the share that is new, (splat, tile row) entries / (splat, tile) pairs of the frame.
    What is beyond streams through and is fetched by every tile. Only processed entries are
    fetched.
    """
    resident = resident_records(config, work)
    processed = eye.processed
    kept = np.minimum(processed, resident)
    kept_sum, total = _total(kept), _total(processed)
    pairs = max(1, _total(eye.entries))
    new_entries = min(work.front_end.row_entries, pairs)
    fetched = ceil_div(kept_sum * new_entries, pairs) + total - kept_sum
    chunk_stall = np.zeros(len(processed), np.int64)
    long_rows = np.flatnonzero((processed > resident).any(axis=1))
    if len(long_rows):
        chunks = np.maximum(0, (processed[long_rows] - 1) // resident)
        switch = config.volume_rendering_core.timing.chunk_switch_cycles
        chunk_stall[long_rows] = row_sums(chunks) * switch
    rendering = row_sums(processed) * passes_per_entry(config, work.tile_px)
    return _EyeRows(rendering, chunk_stall, fetched)


def _raster_counts(
    config: AcceleratorConfig, work: FrameWork, left: _EyeRows, right: _EyeRows, headers: int
) -> dict[str, int]:
    words = ceil_div(config.volume_rendering_core.feature_buffer.record.record_bytes, WORD_BYTES)
    processed = _total(work.left.processed) + _total(work.right.processed)
    reads = processed * words * passes_per_entry(config, work.tile_px) + headers
    return {
        "list_entries_walked": processed + headers,
        "feature_buffer_reads": reads,
        "feature_buffer_writes": (left.fetched_records + right.fetched_records) * words,
        "alpha_checks": _total(work.left.alpha_checks) + _total(work.right.alpha_checks),
        "alpha_passes": _total(work.left.passes) + _total(work.right.passes),
        "blends": _total(work.left.blends) + _total(work.right.blends),
        "pixels_written": 2 * work.width * work.height,
    }


def _merge_counts(work: FrameWork, outputs: int) -> dict[str, int]:
    """Duplicates are popped too; each output compares the heads of all rows."""
    rows = work.stereo.fifo_entries.shape[0]
    written = int(work.stereo.fifo_entries.sum(dtype=np.int64))
    return {
        "stereo_buffer_reads": min(written, outputs + work.stereo.duplicates),
        "merge_comparisons": outputs * max(0, rows - 1),
    }


def _feature_stream(config: AcceleratorConfig, left: _EyeRows, right: _EyeRows) -> Stream:
    record = config.volume_rendering_core.feature_buffer.record.record_bytes
    fetched = left.fetched_records + right.fetched_records
    sentence = "feature records fetched into the feature buffers"
    return Stream("feature_reads", sentence, fetched * record, granule_bytes=record)


def _frame_buffer_stream(config: AcceleratorConfig, work: FrameWork) -> Stream:
    written = 2 * work.width * work.height * config.display.pixel.pixel_bytes
    return Stream("frame_buffer", "finished pixels of both eyes", write_bytes=written)


def _total(array: np.ndarray) -> int:
    return int(array.sum(dtype=np.int64))
