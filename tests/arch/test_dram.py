"""DRAM rate and energy: derived numbers against hand computations and published ranges."""

from __future__ import annotations

import pytest

from arch import AcceleratorConfig, CostTable
from arch.component import Stream
from arch.memory.dram import (
    activations,
    bus_bytes,
    channel_bytes_per_ns,
    dram,
    peak_bytes_per_ns,
    request_efficiency,
)
from arch.memory.dram_energy import dram_energy
from gaussians.errors import InputError
from tests.arch.build import changed


def test_peak_rate(nebula: AcceleratorConfig) -> None:
    assert channel_bytes_per_ns(nebula.dram) == pytest.approx(6.4)
    assert peak_bytes_per_ns(nebula.dram) == pytest.approx(25.6)


@pytest.mark.parametrize(
    ("granule", "efficiency"),
    [(0, 1.0), (32, 0.4), (64, 0.8), (65, 1.0), (96, 1.0), (236, 1.0)],
)
def test_random_requests_wait_for_the_four_activate_window(
    nebula: AcceleratorConfig, granule: int, efficiency: float
) -> None:
    """A burst of 32 B takes 5 ns; rows open every tFAW / 4 = 12.5 ns."""
    assert request_efficiency(nebula.dram, granule) == pytest.approx(efficiency)


def test_bursts_and_rows(nebula: AcceleratorConfig) -> None:
    assert bus_bytes(nebula.dram, 236 * 10, 236) == 256 * 10
    assert bus_bytes(nebula.dram, 33, 0) == 64
    assert activations(nebula.dram, 4097, 0) == 2
    assert activations(nebula.dram, 640, 64) == 10
    assert activations(nebula.dram, 10_000, 5_000) == 4
    assert activations(nebula.dram, 0, 64) == 0


def test_time_by_hand(nebula: AcceleratorConfig) -> None:
    """Sequential read 256 000 B, random 64 B reads of the same, refresh 210 of 3900 ns."""
    streams = (
        Stream("a", "a", read_bytes=256_000),
        Stream("b", "b", read_bytes=256_000, granule_bytes=64),
    )
    data_ns = 10_000 + 10_000 / 0.8
    report = dram(nebula, streams, 0.0)
    assert report.cycles == pytest.approx(data_ns / (1 - 210 / 3900), abs=1)
    assert report.total_bytes == 512_000
    assert report.activations == 63 + 4000
    with_display = dram(nebula, streams, 2.56e9)
    assert with_display.cycles == pytest.approx(data_ns / (1 - 210 / 3900 - 0.1), abs=1)


def test_writes_turn_the_bus_around(nebula: AcceleratorConfig) -> None:
    """A batch of 32 bursts on each of four channels costs tWTR + tCL = 22.5 ns."""
    read = dram(nebula, (Stream("a", "a", read_bytes=409_600),), 0.0)
    write = dram(nebula, (Stream("a", "a", write_bytes=409_600),), 0.0)
    assert write.cycles - read.cycles == pytest.approx(100 * 22.5 / (1 - 210 / 3900), abs=2)


def test_the_display_must_leave_bandwidth(nebula: AcceleratorConfig) -> None:
    with pytest.raises(InputError, match="must leave DRAM bandwidth"):
        dram(nebula, (), 25.0e9)


def test_energy_from_currents_equals_the_published_derivation(
    nebula: AcceleratorConfig, costs: CostTable
) -> None:
    energy = dram_energy(nebula.dram, costs.dram_rails)
    assert energy.activate_pj == pytest.approx(2732, rel=1e-3)
    assert energy.read_pj_per_bit == pytest.approx(4.59, rel=2e-3)
    assert energy.write_pj_per_bit == pytest.approx(4.83, rel=2e-3)
    assert energy.active_standby_mw == pytest.approx(51.6, rel=1e-3)
    assert energy.refresh_pj == pytest.approx(39_100, rel=2e-3)
    assert energy.refresh_mw == pytest.approx(10.0, rel=1e-2)


def test_energy_per_bit_lies_in_the_expected_range(
    nebula: AcceleratorConfig, costs: CostTable
) -> None:
    """Streaming with background 5.6 to 6.6 pJ/bit, random 64 B closed page 8 to 13, without I/O.

    The ranges are the spread of four current sets for LPDDR3-1600.
    """
    energy = dram_energy(nebula.dram, costs.dram_rails)
    gigabits = 8 * channel_bytes_per_ns(nebula.dram)
    standing = (energy.active_standby_mw + energy.refresh_mw) / gigabits
    page_bits = 8 * nebula.dram.organisation.page_bytes
    streaming = energy.read_pj_per_bit + energy.activate_pj / page_bits + standing
    assert 5.6 < streaming < 6.6
    random = energy.read_pj_per_bit + energy.activate_pj / 512
    assert 8.0 < random < 13.0


def test_more_banks_or_channels_never_slow_down(nebula: AcceleratorConfig) -> None:
    streams = (Stream("a", "a", 1_000_000, 1_000_000, 64),)
    base = dram(nebula, streams, 1e9).cycles
    assert dram(changed(nebula, "dram.channels.count", 8), streams, 1e9).cycles < base
    slow = changed(nebula, "dram.organisation.banks", 1)
    assert dram(slow, streams, 1e9).cycles > base
