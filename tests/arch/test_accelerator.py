"""Whole frames: bounds, overlap, conservation, monotonicity, refusals."""

from __future__ import annotations

import dataclasses
import json
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arch import AcceleratorConfig, ClientWork, analyse_frame
from gaussians.errors import InputError
from tests.arch.build import changed, client, eye, frame, random_frame


@pytest.mark.parametrize("stereo", [True, False])
def test_frame_is_the_slowest_unit_and_the_fill(nebula: AcceleratorConfig, stereo: bool) -> None:
    work = random_frame(np.random.default_rng(5), 30, 40, 50, stereo=stereo)
    timing = analyse_frame(nebula, work, client(work.front_end.submitted)).timing
    slow = max(timing.units, key=lambda unit: unit.cycles)
    assert timing.bound_by == slow.name
    assert timing.cycles_per_frame == slow.cycles + timing.fill_cycles
    fill = 4 + 12 + 128 + 14 + 68 + 192 + 56 + (4 if stereo else 0)
    assert timing.fill_cycles == fill
    assert timing.fps == pytest.approx(1e9 / timing.cycles_per_frame)
    assert timing.frame_ms == pytest.approx(1e3 / timing.fps)
    assert timing.fidelity == "analytic"
    for unit in timing.units:
        assert 0 <= unit.utilisation <= 1, unit.name
        assert unit.busy_cycles <= unit.instances * unit.cycles or unit.instances == 0, unit.name


@pytest.mark.parametrize("stereo", [True, False])
def test_peak_rate_bounds(nebula: AcceleratorConfig, stereo: bool) -> None:
    """FPS <= 8e9 / entries walked over both eyes, and <= 25.6e9 / DRAM bytes."""
    work = random_frame(np.random.default_rng(6), 60, 40, 90, stereo=stereo)
    timing = analyse_frame(nebula, work, client(work.front_end.submitted)).timing
    walked = int(work.left.processed.sum() + work.right.processed.sum())
    assert timing.fps <= 8e9 / walked
    assert timing.fps <= 25.6e9 / timing.dram_bytes


def test_ninety_fps_needs_156_cycles_per_tile(nebula: AcceleratorConfig) -> None:
    """11.11 M cycles x 8 cores over 2 x 284 832 tiles; every stall included."""
    config = changed(nebula, "dram.channels.count", 1024)  # leave the cores as the bound
    for mean, reached in ((150, True), (160, False)):
        lists = eye(np.full((552, 516), mean))
        fifo = np.zeros((4, 552, 516), np.int32)
        fifo[0] = mean
        work = frame(lists, lists, fifo, rows=1000)
        timing = analyse_frame(config, work, client()).timing
        assert timing.bound_by == "volume_rendering_core"
        assert (timing.fps >= 90) == reached


def test_dram_bytes_are_the_sum_of_the_streams(nebula: AcceleratorConfig) -> None:
    work = random_frame(np.random.default_rng(7), 30, 40, 50)
    analysis = analyse_frame(nebula, work, client(work.front_end.submitted, received_bytes=999))
    timing, activity = analysis.timing, analysis.activity
    read = sum(stream.read_bytes for stream in timing.dram)
    written = sum(stream.write_bytes for stream in timing.dram)
    assert timing.dram_bytes == read + written
    assert (activity["dram_bytes_read"], activity["dram_bytes_written"]) == (read, written)
    scan = next(s for s in timing.dram if s.name == "display_scan_out")
    rate = 2 * work.width * work.height * 4 * 72
    assert scan.read_bytes == pytest.approx(rate * timing.frame_ms * 1e-3, abs=1)
    assert activity["radio_bytes_received"] == 999
    names = [stream.name for stream in timing.dram]
    assert len(set(names)) == len(names)


def test_stereo_saves_the_second_front_end(nebula: AcceleratorConfig) -> None:
    """The same lists: half the projection passes, sorts and pairs; more entries in the cores."""
    rng = np.random.default_rng(8)
    shared = random_frame(rng, 30, 40, 50)
    own = frame(shared.left, shared.right, splats=6000, rows=shared.front_end.row_entries)
    both = {}
    for name, work in (("shared", shared), ("own", own)):
        analysis = analyse_frame(nebula, work, client(work.front_end.submitted))
        both[name] = {unit.name: unit for unit in analysis.timing.units}
    assert both["shared"]["sorting_unit"].busy_cycles < both["own"]["sorting_unit"].busy_cycles
    assert both["shared"]["binning_unit"].cycles < both["own"]["binning_unit"].cycles
    cores = both["shared"]["volume_rendering_core"], both["own"]["volume_rendering_core"]
    assert cores[0].busy_cycles > cores[1].busy_cycles


@given(seed=st.integers(0, 1000), factor=st.integers(2, 4))
@settings(max_examples=25, deadline=None)
def test_more_work_never_takes_less(nebula: AcceleratorConfig, seed: int, factor: int) -> None:
    """Every list ``factor`` times as long: no unit, stream or counter goes down."""
    work = random_frame(np.random.default_rng(seed), 6, 9, 40)
    left, right = (
        eye(factor * one.entries, factor * one.processed) for one in (work.left, work.right)
    )
    more = frame(
        left,
        right,
        factor * work.stereo.fifo_entries,
        factor * work.stereo.forward_only,
        splats=factor * work.front_end.submitted,
        rows=factor * work.front_end.row_entries,
    )
    few, many = (analyse_frame(nebula, w, client(w.front_end.submitted)) for w in (work, more))
    assert few.timing.cycles_per_frame < many.timing.cycles_per_frame
    for before, after in zip(few.timing.units, many.timing.units, strict=True):
        assert before.cycles <= after.cycles
    for one, other in zip(few.timing.dram, many.timing.dram, strict=True):
        assert one.read_bytes <= other.read_bytes
    for count, larger in zip(few.activity.counts, many.activity.counts, strict=True):
        assert count.value <= larger.value


@given(seed=st.integers(0, 1000), cores=st.integers(1, 8))
@settings(max_examples=25, deadline=None)
def test_more_hardware_never_takes_longer(nebula: AcceleratorConfig, seed: int, cores: int) -> None:
    """Twice the cores never finish later."""
    work = random_frame(np.random.default_rng(seed), 24, 9, 40)
    counted = []
    for count in (cores, 2 * cores):
        config = changed(nebula, "volume_rendering_core.units.count", count)
        timing = analyse_frame(config, work, client(work.front_end.submitted)).timing
        counted.append(next(u.cycles for u in timing.units if u.name == "volume_rendering_core"))
    assert counted[1] <= counted[0]


def test_empty_frame(nebula: AcceleratorConfig) -> None:
    nothing = eye(np.zeros((3, 4)))
    work = frame(nothing, nothing, np.zeros((4, 3, 4)), splats=0)
    timing = analyse_frame(nebula, work, client(0)).timing
    cores = next(unit for unit in timing.units if unit.name == "volume_rendering_core")
    assert cores.cycles == 2 * 4  # tile switches of one row, both eyes
    assert timing.stereo_buffer is not None
    assert timing.stereo_buffer.peak_total_entries == 0


def test_off_axis_plane_wider_than_the_window(nebula: AcceleratorConfig) -> None:
    work = random_frame(np.random.default_rng(9), 4, 6, 20)
    wide = np.pad(work.stereo.forward_only, ((0, 0), (0, 5)))
    stereo = dataclasses.replace(work.stereo, forward_only=wide)
    analysis = analyse_frame(nebula, dataclasses.replace(work, stereo=stereo), client(320))
    base = analyse_frame(nebula, work, client(320))
    assert analysis.activity["pairs_emitted"] == base.activity["pairs_emitted"]
    assert analysis.activity["sru_entries_examined"] == base.activity["sru_entries_examined"]


def test_refusals(nebula: AcceleratorConfig, gscore: AcceleratorConfig) -> None:
    work = random_frame(np.random.default_rng(10), 3, 4, 20)
    enough = client(work.front_end.submitted)
    eight = dataclasses.replace(work, tile_px=8)
    with pytest.raises(InputError, match=r"must have 4 px tiles, not 8; another tile size needs"):
        analyse_frame(nebula, eight, enough)
    with pytest.raises(InputError, match=r"gscore_nebula: has no stereo units.*'independent'"):
        analyse_frame(gscore, work, enough)
    with pytest.raises(InputError, match=r"selected_splats must be at least the 240 splats"):
        analyse_frame(nebula, work, client(10))
    more_rows = dataclasses.replace(
        work.stereo, fifo_entries=np.concatenate([work.stereo.fifo_entries] * 2)
    )
    with pytest.raises(InputError, match=r"the stereo buffer has 4 rows.*not 8"):
        analyse_frame(nebula, dataclasses.replace(work, stereo=more_rows), enough)
    with pytest.raises(InputError, match=r"left.entries must have shape \(4, 4\), not \(3, 4\)"):
        analyse_frame(nebula, dataclasses.replace(work, height=16), enough)
    alone = dataclasses.replace(work, shared_front_end=False)
    with pytest.raises(InputError, match="independent eyes must not have stereo-buffer entries"):
        analyse_frame(nebula, alone, enough)


def test_client_work_is_checked() -> None:
    with pytest.raises(
        InputError, match=r"received_bytes must be an integer of at least 0, not -1"
    ):
        client(received_bytes=-1)
    with pytest.raises(
        InputError, match=r"selected_splats must be at most held_splats \(3\), not 4"
    ):
        ClientWork(3, 4, 0, 0, 0, 0)
    with pytest.raises(InputError, match=r"escaped_splats must be at most decoded_splats \(1\)"):
        client(decoded_splats=1, escaped_splats=2)


def test_host_decoding_is_said(gscore: AcceleratorConfig, nebula: AcceleratorConfig) -> None:
    work = random_frame(np.random.default_rng(11), 3, 4, 20, stereo=False)
    decoding = client(work.front_end.submitted, decoded_splats=5)
    assert "decoded by the host" in analyse_frame(gscore, work, decoding).timing.notes[0]
    assert analyse_frame(nebula, work, decoding).timing.notes == ()
    assert analyse_frame(gscore, work, decoding).timing.stereo_buffer is None


def test_result_is_plain_data(nebula: AcceleratorConfig) -> None:
    work = random_frame(np.random.default_rng(12), 3, 4, 20)
    analysis = analyse_frame(nebula, work, client(work.front_end.submitted))
    again = json.loads(json.dumps(dataclasses.asdict(analysis)))
    assert again["timing"]["bound_by"] == analysis.timing.bound_by
    assert len(again["activity"]["counts"]) == len(analysis.activity.counts)


def test_a_whole_headset_frame_is_analysed_quickly(nebula: AcceleratorConfig) -> None:
    """About 10 ms for 516 x 552 tiles on a free core, goal 30; the bound leaves room."""
    work = random_frame(np.random.default_rng(13), 552, 516, 86)
    seconds = []
    for _ in range(5):
        start = time.process_time()
        analyse_frame(nebula, work, client(work.front_end.submitted))
        seconds.append(time.process_time() - start)
    assert min(seconds) < 0.1
