"""Tile rows on cores: who renders what, what a row costs, what the feature buffer fetches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arch import AcceleratorConfig
from arch.component import UnitReport, schedule_rows, slowest
from arch.units.volume_rendering_core import RasterReport, volume_rendering_cores
from tests.arch.build import changed, eye, frame


def unit(report: RasterReport, name: str) -> UnitReport:
    return next(u for u in report.units if u.name == name)


def stall(report: RasterReport, name: str) -> int:
    return next(s.cycles for s in report.stalls if s.name == name)


def fetched(report: RasterReport) -> int:
    streams = unit(report, "volume_rendering_core").streams
    return next(s.read_bytes for s in streams if s.name == "feature_reads") // 64


def test_equal_rows_go_round_robin() -> None:
    owners = schedule_rows(np.full(7, 5, np.int64), 3)
    assert owners.tolist() == [0, 1, 2, 0, 1, 2, 0]


def test_a_row_goes_to_the_core_that_is_free_first() -> None:
    """Core 0 is busy with the long row; the short ones share core 1. An average would say 12."""
    rows = np.array([20, 1, 1, 1, 1], np.int64)
    owners = schedule_rows(rows, 2)
    assert owners.tolist() == [0, 1, 1, 1, 1]
    assert slowest(rows, owners) == 20


@given(st.lists(st.integers(0, 1000), min_size=1, max_size=60), st.integers(1, 9))
@settings(deadline=None)
def test_schedule_bounds(cycles: list[int], instances: int) -> None:
    """Greedy: between the mean and the mean plus the longest row; every row has one owner."""
    rows = np.array(cycles, np.int64)
    owners = schedule_rows(rows, instances)
    assert owners.min() >= 0
    assert owners.max() < instances
    longest = slowest(rows, owners)
    mean = rows.sum() / instances
    assert max(mean, rows.max()) <= longest <= mean + rows.max()


def test_row_cycles_by_hand(nebula: AcceleratorConfig) -> None:
    """Left 7 + 3 after termination + 2 forward-only + 2 tiles; right 9 + 2 tiles."""
    left, right = eye([[6, 4]], [[3, 4]]), eye([[5, 4]])
    fifo = np.zeros((4, 1, 2), np.int32)
    fifo[0] = right.entries
    report = volume_rendering_cores(nebula, frame(left, right, fifo, [[0, 2]]))
    core = unit(report, "volume_rendering_core")
    left_walk = 7 + 3 + 2 + 2
    merge = 9 + 2 * 2  # two cycles at the start of each tile: two more than the right walk
    assert core.cycles == left_walk + merge
    assert stall(report, "wait_for_merge_unit") == merge - (9 + 2)
    assert stall(report, "wait_for_sru") == 0
    assert core.counts["list_entries_walked"] == 16 + 5
    assert core.counts["feature_buffer_reads"] == 16 * 4 + 5
    assert unit(report, "rendering_unit").cycles == 16
    assert unit(report, "rendering_unit").instances == 128
    assert unit(report, "stereo_reprojection_unit").cycles == 12
    assert unit(report, "merge_unit").cycles == merge


def test_sru_makes_the_core_wait(nebula: AcceleratorConfig) -> None:
    left, right = eye([[4]]), eye([[16]])
    fifo = np.full((4, 1, 1), 4, np.int32)
    report = volume_rendering_cores(nebula, frame(left, right, fifo))
    assert stall(report, "wait_for_sru") == 16 - (4 + 1)
    assert unit(report, "volume_rendering_core").cycles == 16 + max(16 + 1, 16 + 2)


def test_fewer_rendering_units_pass_an_entry_several_times(nebula: AcceleratorConfig) -> None:
    work = frame(eye([[10]]), eye([[10]]))
    for per_core, passes in ((16, 1), (32, 1), (15, 2), (8, 2), (5, 4), (1, 16)):
        config = changed(nebula, "volume_rendering_core.rendering_units.per_core", per_core)
        core = unit(volume_rendering_cores(config, work), "volume_rendering_core")
        assert core.cycles == 10 * passes + 1


def test_slowest_core_not_the_average(nebula: AcceleratorConfig) -> None:
    """Nine rows of 11 cycles on eight cores: one core renders two."""
    lists = eye(np.full((9, 1), 10))
    nothing = eye(np.zeros((9, 1)))
    stereo = frame(lists, nothing, np.zeros((4, 9, 1)))
    core = unit(volume_rendering_cores(nebula, stereo), "volume_rendering_core")
    assert core.cycles == 2 * (11 + 1)
    assert core.busy_cycles == 9 * (11 + 1)


def test_independent_eyes_are_separate_rows(nebula: AcceleratorConfig) -> None:
    """Five rows of two eyes are ten pieces of work: two rounds on eight cores, not one of both."""
    lists = eye(np.full((5, 1), 10))
    apart = unit(volume_rendering_cores(nebula, frame(lists, lists)), "volume_rendering_core")
    assert apart.cycles == 22
    fifo = np.zeros((4, 5, 1), np.int32)
    together = volume_rendering_cores(nebula, frame(lists, lists, fifo))
    assert unit(together, "volume_rendering_core").cycles == 11 + 11


def test_feature_buffer_fetches_each_splat_once_per_tile_row(nebula: AcceleratorConfig) -> None:
    """One splat in ten tiles of a row: one fetch per eye. 16 KiB hold 256 records."""
    lists = eye(np.ones((1, 10)))
    assert fetched(volume_rendering_cores(nebula, frame(lists, lists, rows=1))) == 2
    assert fetched(volume_rendering_cores(nebula, frame(lists, lists, rows=10))) == 20


def test_lists_beyond_the_feature_buffer_stream_in_every_tile(nebula: AcceleratorConfig) -> None:
    """300 entries, 256 records: 44 stream per tile; with both eyes on a core 128 stay each."""
    lists = eye(np.full((1, 10), 300))
    independent = volume_rendering_cores(nebula, frame(lists, lists, rows=300))
    assert fetched(independent) == 2 * (256 + 440)
    assert stall(independent, "feature_buffer_chunks") == 2 * 10 * 1 * 2
    fifo = np.zeros((4, 1, 10), np.int32)
    shared = volume_rendering_cores(nebula, frame(lists, lists, fifo, rows=300))
    assert fetched(shared) == 2 * (128 + 1720)
    assert stall(shared, "feature_buffer_chunks") == 2 * 10 * 2 * 2
    mixed = eye([[256, 257, 512, 513]])  # 0, 1, 1 and 2 further chunks of two cycles, each eye
    chunks = volume_rendering_cores(nebula, frame(mixed, mixed, rows=300))
    assert stall(chunks, "feature_buffer_chunks") == 2 * 4 * 2
    exact = eye(np.full((1, 10), 256))
    fits = volume_rendering_cores(nebula, frame(exact, exact, rows=256))
    assert stall(fits, "feature_buffer_chunks") == 0


def test_terminated_tiles_fetch_only_what_they_walk(nebula: AcceleratorConfig) -> None:
    lists = eye(np.full((1, 4), 100), np.full((1, 4), 30))
    assert fetched(volume_rendering_cores(nebula, frame(lists, lists, rows=400))) == 2 * 4 * 30


def test_spill_waits_are_added_to_the_row(nebula: AcceleratorConfig) -> None:
    config = changed(nebula, "stereo.entries.organisation", "rows")
    fifo = np.zeros((4, 1, 1), np.int32)
    fifo[3] = 600
    lists = eye([[600]])
    spilled = volume_rendering_cores(config, frame(lists, lists, fifo))
    pooled = volume_rendering_cores(nebula, frame(lists, lists, fifo))
    assert stall(spilled, "wait_for_stereo_spill") == 112
    difference = (
        unit(spilled, "volume_rendering_core").cycles - unit(pooled, "volume_rendering_core").cycles
    )
    assert difference == 112


@pytest.mark.parametrize("name", ["alpha_checks", "alpha_passes", "blends"])
def test_pixel_counts_are_the_traces(nebula: AcceleratorConfig, name: str) -> None:
    work = frame(eye([[6, 4]], [[3, 4]]), eye([[5, 4]]))
    factor = {"alpha_checks": 16, "alpha_passes": 8, "blends": 7}[name]
    core = unit(volume_rendering_cores(nebula, work), "volume_rendering_core")
    assert core.counts[name] == factor * (7 + 9)
    assert core.counts["pixels_written"] == 2 * 8 * 4
