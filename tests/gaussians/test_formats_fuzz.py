"""A few hundred damaged files per reader; ``python -m benchmarks.fuzz_formats`` runs thousands."""

from __future__ import annotations

import tracemalloc

import pytest

from tests.fuzz_formats import fuzz
from tests.fuzz_targets import READERS

MUTATIONS = 300
PEAK_MIB = 24  # the largest document that may be read has 8 MiB, a bomb 32
SLOWEST_S = 2.0


@pytest.mark.parametrize("reader", READERS)
def test_a_damaged_file_loads_or_is_refused_in_one_line(tmp_path, reader):
    outcome = fuzz(reader, MUTATIONS, seed=7, folder=tmp_path)
    assert outcome.loaded + outcome.refused == MUTATIONS
    assert outcome.loaded > 0  # else the damage is too crude to reach the decoder
    assert outcome.refused > MUTATIONS / 2
    assert outcome.slowest_s < SLOWEST_S, outcome.slowest


@pytest.mark.parametrize("reader", ["spz", "sog", "lod_meta"])
def test_bombs_stay_within_a_bounded_memory(tmp_path, reader):
    tracemalloc.start()
    try:
        peak = fuzz(reader, 40, seed=8, folder=tmp_path).peak_bytes
    finally:
        tracemalloc.stop()
    assert 0 < peak < PEAK_MIB * 2**20, peak / 2**20
