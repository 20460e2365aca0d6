"""Each unit's formula on work small enough to compute by hand. Tight: equal, not at most."""

from __future__ import annotations

import numpy as np
import pytest

from arch import AcceleratorConfig
from arch.component import UnitReport
from arch.memory.splat_record import record_bytes
from arch.units.binning_unit import binning_unit
from arch.units.decoder import decoder
from arch.units.merge_unit import merge_unit
from arch.units.projection_unit import projection_unit
from arch.units.sorting_unit import sort_cost, sorting_unit
from arch.units.stereo_reprojection_unit import stereo_reprojection_unit
from arch.units.subgraph_unit import subgraph_unit
from tests.arch.build import changed, client, eye, frame


def bytes_of(report: UnitReport, name: str) -> tuple[int, int]:
    stream = next(s for s in report.streams if s.name == name)
    return stream.read_bytes, stream.write_bytes


def test_record_layouts(nebula: AcceleratorConfig) -> None:
    sizes = {"decoded_fp32": (236, 56), "decoded_fp16": (118, 28), "compressed_in_dram": (36, 28)}
    for layout, (degree3, degree0) in sizes.items():
        record = changed(nebula.splat_record, "layout", layout)
        assert (record_bytes(record, 3), record_bytes(record, 0)) == (degree3, degree0)


def test_decoder_on_arrival(nebula: AcceleratorConfig) -> None:
    """236 B at 64 B per cycle: 4 cycles a splat, escaped or not; 8 stages of 256 codewords of 90 B,
    seven of which take 2 cycles each to be added."""
    work = frame(eye([[1]]), eye([[1]]))
    report = decoder(
        nebula, work, client(decoded_splats=1000, escaped_splats=10, received_bytes=777)
    )
    assert report.cycles == 1000 * 4 + 990 * 7 * 2
    words_read = 990 * 8 * 6
    assert report.counts == {"attributes_dequantised": 990 * 14, "codebook_words_read": words_read}
    missed = -(-990 * 8 * (2048 * 90 - 16 * 1024) // (2048 * 90))
    assert bytes_of(report, "codebook") == (missed * 90, 0)
    assert bytes_of(report, "incoming_stream") == (777, 777)
    assert bytes_of(report, "new_records") == (0, 236_000)


def test_decoder_behind_dram_decodes_what_is_drawn(nebula: AcceleratorConfig) -> None:
    config = changed(nebula, "splat_record.layout", "compressed_in_dram")
    stereo = frame(eye([[1]]), eye([[1]]), np.zeros((4, 1, 1)), splats=50)
    assert decoder(config, stereo, client(50)).cycles == 50 * (4 + 7 * 2)
    independent = frame(eye([[1]]), eye([[1]]), splats=50)
    assert decoder(config, independent, client(50)).cycles == 2 * 50 * (4 + 7 * 2)


def test_no_decoder_leaves_the_traffic(gscore: AcceleratorConfig) -> None:
    report = decoder(gscore, frame(eye([[1]]), eye([[1]])), client(decoded_splats=3))
    assert (report.instances, report.cycles, dict(report.counts)) == (0, 0, {})
    assert bytes_of(report, "new_records") == (0, 3 * 236)


def test_subgraph_walks_every_held_header(nebula: AcceleratorConfig) -> None:
    report = subgraph_unit(nebula, client(0, held_splats=1001, decoded_splats=5, evicted_splats=3))
    assert report.cycles == 251  # four units
    assert report.busy_cycles == 1001
    assert bytes_of(report, "headers") == (1001 * 16, 8 * 16)


def test_projection_charges_the_right_eye_extras(nebula: AcceleratorConfig) -> None:
    lists, fifo = eye([[1]]), np.zeros((4, 1, 1))
    own = projection_unit(nebula, frame(lists, lists, fifo, splats=101))
    assert own.busy_cycles == 101 + 101
    assert own.cycles == 51
    reused = projection_unit(nebula, frame(lists, lists, fifo, splats=101, right_projected=False))
    assert reused.busy_cycles == 101
    assert bytes_of(reused, "feature_writes") == (0, 101 * 64)
    twice = projection_unit(nebula, frame(lists, lists, splats=101))
    assert twice.busy_cycles == 2 * 101
    assert bytes_of(own, "splat_records") == (101 * 236, 0)
    assert bytes_of(twice, "splat_records") == (2 * 101 * 236, 0)
    assert own.counts["covariances_built"] == 101
    assert twice.counts["covariances_built"] == 202
    assert own.counts["sh_coefficients"] == 2 * 101 * 48


def test_binning_is_bound_by_spans_or_pairs(nebula: AcceleratorConfig) -> None:
    fifo = np.zeros((4, 1, 2))
    pairs_bound = frame(eye([[30, 11]]), eye([[9, 9]]), fifo, [[1, 1]], rows=7)
    report = binning_unit(nebula, pairs_bound)
    assert report.counts["pairs_emitted"] == 43  # right lists come from the stereo buffer
    assert report.counts["row_spans_solved"] == 14
    assert report.cycles == 11
    assert binning_unit(nebula, frame(eye([[3]]), eye([[3]]), rows=6)).cycles == 3  # 12 spans
    independent = binning_unit(nebula, frame(eye([[30, 11]]), eye([[9, 9]]), rows=7))
    assert independent.counts["pairs_emitted"] == 59


def test_edge_tiles_of_a_stereo_method_are_binned_on_their_own(nebula: AcceleratorConfig) -> None:
    work = frame(
        eye([[1, 1, 1], [1, 1, 1]]),
        eye([[50, 60, 7], [80, 90, 9]]),
        np.zeros((4, 2, 3)),
        independent_right_tiles=2,
    )
    assert binning_unit(nebula, work).counts["pairs_emitted"] == 6 + 7 + 9


def test_lists_beyond_half_the_global_buffer_wait_in_dram(nebula: AcceleratorConfig) -> None:
    half = 72 * 1024
    fitting = frame(eye([[1]]), eye([[1]]), np.zeros((4, 1, 1)), rows=half // 16)
    assert bytes_of(binning_unit(nebula, fitting), "tile_lists") == (0, 0)
    larger = frame(eye([[1]]), eye([[1]]), np.zeros((4, 1, 1)), rows=half // 16 + 5)
    assert bytes_of(binning_unit(nebula, larger), "tile_lists") == (80, 80)
    as_pairs = changed(nebula, "binning_unit.timing.list_layout", "pairs")
    many = frame(eye([[20_000]]), eye([[1]]), np.zeros((4, 1, 1)))
    assert bytes_of(binning_unit(as_pairs, many), "tile_lists")[0] == 160_000 - half


SORT_TABLE = [  # entries, partitions, cycles, comparisons
    (0, 0, 0, 0),
    (1, 0, 1, 80),
    (16, 0, 1, 80),
    (17, 0, 2 + 3, 2 * 80 + 3 * 32),
    (86, 0, 6 + 3 * 11, 6 * 80 + 3 * 11 * 32),
    (256, 0, 16 + 4 * 32, 16 * 80 + 4 * 32 * 32),
    (257, 1, 129 + 17 + 2 * 33, 257 * 7 + 17 * 80 + 2 * 33 * 32),
    (2048, 1, 1024 + 128 + 4 * 256, 2048 * 7 + 128 * 80 + 4 * 256 * 32),
    (2049, 2, 2 * 1025 + 129 + 2 * 257, 2 * 2049 * 7 + 129 * 80 + 2 * 257 * 32),
]


@pytest.mark.parametrize(("entries", "partitions", "cycles", "comparisons"), SORT_TABLE)
def test_sort_cost(
    nebula: AcceleratorConfig, entries: int, partitions: int, cycles: int, comparisons: int
) -> None:
    cost = sort_cost(nebula.sorting_unit.timing, 2049)
    assert cost.partition_passes[entries] == partitions
    assert cost.cycles[entries] == cycles
    assert cost.comparisons[entries] == comparisons


def test_sorting_skips_merged_right_lists(nebula: AcceleratorConfig) -> None:
    left, right = eye([[14, 86], [86, 0]]), eye([[86, 86], [86, 86]])
    shared = sorting_unit(nebula, frame(left, right, np.zeros((4, 2, 2)), [[3, 0], [0, 0]]))
    assert shared.busy_cycles == 5 + 39 + 39  # 14 + 3 forward-only entries take 5
    assert shared.cycles == 44
    own = sorting_unit(nebula, frame(left, right))
    assert own.busy_cycles == 1 + 39 + 39 + 4 * 39
    assert own.cycles == 78


def test_long_lists_spill_while_they_are_partitioned(nebula: AcceleratorConfig) -> None:
    """Half the buffer over eight cores is 9 KB: 1152 entries of 8 B."""
    at = frame(eye([[1152]]), eye([[0]]), np.zeros((4, 1, 1)))
    assert bytes_of(sorting_unit(nebula, at), "sort_spill") == (0, 0)
    over = frame(eye([[1153]]), eye([[0]]), np.zeros((4, 1, 1)))
    assert bytes_of(sorting_unit(nebula, over), "sort_spill") == (8, 8)
    twice = frame(eye([[3000]]), eye([[0]]), np.zeros((4, 1, 1)))
    assert bytes_of(sorting_unit(nebula, twice), "sort_spill")[0] == 2 * (3000 - 1152) * 8


def test_sru_walks_past_termination_and_writes_one_row_per_cycle(
    nebula: AcceleratorConfig,
) -> None:
    fifo = np.zeros((4, 2, 2), np.int32)
    fifo[:, 0, 0] = 9  # 36 writes in the first tile row
    fifo[1, 1, 1] = 2
    left = eye([[10, 5], [20, 0]], [[4, 5], [1, 0]])
    rows = stereo_reprojection_unit(nebula, frame(left, left, fifo, [[2, 0], [0, 1]]))
    assert rows.examined.tolist() == [17, 21]
    assert rows.writes.tolist() == [36, 2]
    assert rows.cycles.tolist() == [36, 21]
    faster = changed(nebula, "stereo.reprojection.writes_per_cycle", 4)
    again = stereo_reprojection_unit(faster, frame(left, left, fifo, [[2, 0], [0, 1]]))
    assert again.cycles.tolist() == [17, 21]
    assert stereo_reprojection_unit(nebula, frame(left, left)).cycles.tolist() == [0, 0]


def test_merge_stops_with_the_right_tile(nebula: AcceleratorConfig) -> None:
    fifo = np.zeros((4, 1, 3), np.int32)
    fifo[0, 0], fifo[3, 0] = (5, 0, 2), (5, 0, 0)
    right = eye([[10, 4, 2]], [[6, 4, 2]])
    rows = merge_unit(nebula, frame(right, right, fifo))
    assert rows.outputs.tolist() == [8]  # 6 + 0 (nothing forwarded) + 2
    assert rows.cycles.tolist() == [8 + 2 * 2]
