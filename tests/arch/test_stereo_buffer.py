"""Occupancy and spill of the stereo buffer against twins that move single entries."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from arch import AcceleratorConfig
from arch.config import StereoConfig
from arch.units.stereo_buffer import occupancy, spill, stereo_buffer
from tests.arch.build import changed
from tests.naive import stereo_buffer as naive

FIFOS = npst.arrays(
    np.int32,
    st.tuples(st.just(4), st.integers(1, 2), st.integers(1, 8)),
    elements=st.integers(0, 6),
)


def sized(nebula: AcceleratorConfig, organisation: str, row_entries: int) -> StereoConfig:
    """A stereo buffer of 4 rows of ``row_entries`` entries, 1 KiB in all."""
    assert nebula.stereo is not None
    stereo = changed(nebula.stereo, "entries.organisation", organisation)
    stereo = changed(stereo, "buffer.capacity_kib", 1)
    return changed(stereo, "entries.entry_bytes", 256 // row_entries)


@given(fifo=FIFOS)
@settings(deadline=None)
def test_occupancy_equals_naive(fifo: np.ndarray) -> None:
    assert np.array_equal(occupancy(fifo), naive.occupancy(fifo))


@given(fifo=FIFOS, row_entries=st.sampled_from([1, 2, 4, 8]))
@settings(deadline=None)
def test_spill_equals_naive(nebula: AcceleratorConfig, fifo: np.ndarray, row_entries: int) -> None:
    rows, pool = (sized(nebula, name, row_entries) for name in ("rows", "pool"))
    assert np.array_equal(spill(fifo, rows), naive.spill(fifo, row_entries, None))
    assert np.array_equal(spill(fifo, pool), naive.spill(fifo, row_entries, 4 * row_entries))


@given(fifo=FIFOS)
@settings(deadline=None)
def test_nothing_spills_that_fits(nebula: AcceleratorConfig, fifo: np.ndarray) -> None:
    stereo = sized(nebula, "pool", 8)
    result = stereo_buffer(stereo, fifo, 32)
    fits = occupancy(fifo).sum(axis=0).max() <= 32
    assert (result.use.spilled_entries == 0) == fits
    assert result.use.tiles_over_the_pool == np.count_nonzero(occupancy(fifo).sum(axis=0) > 32)


def test_occupancy_of_one_long_row() -> None:
    """Right tile 0 starts when left tile 3 is done: row 0 holds four tiles' entries, row 3 one."""
    fifo = np.ones((4, 1, 10), np.int32)
    assert occupancy(fifo)[:, 0, 0].tolist() == [4, 3, 2, 1]
    assert occupancy(fifo)[:, 0, 8].tolist() == [2, 2, 2, 1]


def test_spilled_entries_cost_bursts_and_waits(nebula: AcceleratorConfig) -> None:
    """Rows of 512: 4 x 150 in row 0 spill 88 of the fourth list; a pool of 2048 takes all."""
    fifo = np.zeros((4, 1, 4), np.int32)
    fifo[0, 0] = 150
    assert nebula.stereo is not None
    rows = stereo_buffer(changed(nebula.stereo, "entries.organisation", "rows"), fifo, 32)
    assert rows.use.spilled_entries == 88
    assert rows.stream.read_bytes == rows.stream.write_bytes == 88 * 8
    assert rows.stall_cycles.tolist() == [112]
    assert rows.use.peak_row_entries == (600, 0, 0, 0)
    assert (rows.use.tiles_over_a_row, rows.use.tiles_over_the_pool) == (1, 0)
    pool = stereo_buffer(nebula.stereo, fifo, 32)
    assert pool.use.spilled_entries == 0
    assert pool.stall_cycles.tolist() == [0]
    assert pool.use.tiles_over_a_row == 1


def test_spill_is_written_in_whole_bursts(nebula: AcceleratorConfig) -> None:
    assert nebula.stereo is not None
    fifo = np.zeros((4, 1, 1), np.int32)
    fifo[3] = 513
    result = stereo_buffer(changed(nebula.stereo, "entries.organisation", "rows"), fifo, 32)
    assert (result.use.spilled_entries, result.stream.write_bytes) == (1, 32)


@pytest.mark.parametrize("organisation", ["rows", "pool"])
def test_whole_frame_of_long_lists_spills_more_with_more_entries(
    nebula: AcceleratorConfig, organisation: str
) -> None:
    assert nebula.stereo is not None
    stereo = changed(nebula.stereo, "entries.organisation", organisation)
    fifo = np.random.default_rng(1).poisson(300, (4, 20, 40)).astype(np.int32)
    few, many = (stereo_buffer(stereo, scale * fifo, 32).use.spilled_entries for scale in (1, 2))
    assert 0 < few < many
