"""Energy: sums, linearity, completeness of the price list, known magnitudes."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

from arch import (
    COUNTERS,
    AcceleratorConfig,
    CostTable,
    EnergyReport,
    FrameAnalysis,
    Technology,
    analyse_frame,
    frame_energy,
)
from arch.memory.sram import MEMORY_COUNTERS, macro
from gaussians.errors import InputError
from tests.arch.build import changed, client, random_frame


@pytest.fixture(scope="module")
def analysis(nebula: AcceleratorConfig) -> FrameAnalysis:
    work = random_frame(np.random.default_rng(3), 40, 50, 60)
    counts = {"decoded_splats": 500, "escaped_splats": 5, "received_bytes": 20_000}
    return analyse_frame(nebula, work, client(work.front_end.submitted, **counts))


@pytest.fixture(scope="module")
def report(
    nebula: AcceleratorConfig,
    analysis: FrameAnalysis,
    costs: CostTable,
    technology: Technology,
) -> EnergyReport:
    return frame_energy(nebula, analysis.activity, analysis.timing, costs, technology)


def test_total_is_the_sum_of_the_parts(report: EnergyReport) -> None:
    parts = math.fsum(part.value_mj for part in report.parts)
    assert report.total_mj_per_frame == pytest.approx(parts, rel=1e-12)
    split = report.on_chip_mj_per_frame + report.dram_mj_per_frame + report.radio_mj_per_frame
    assert split == pytest.approx(parts, rel=1e-12)
    assert all(part.value_mj > 0 for part in report.parts)
    assert len({part.name for part in report.parts}) == len(report.parts)


def test_every_counter_is_priced_and_every_price_counted(report: EnergyReport) -> None:
    names = {part.name for part in report.parts}
    assert set(COUNTERS) <= names
    beyond = names - set(COUNTERS)
    standing = {f"{memory}_leakage" for memory in MEMORY_COUNTERS}
    others = {"clock_tree", "interconnect", "logic_leakage"}
    assert beyond == standing | others | {"dram_io", "dram_standby", "dram_refresh"}


def test_a_missing_or_unknown_price_is_refused(costs: CostTable) -> None:
    with pytest.raises(InputError, match=r"counter 'alpha_checks' must have a price"):
        kept = tuple(a for a in costs.actions if a.counter != "alpha_checks")
        dataclasses.replace(costs, actions=kept)
    stranger = dataclasses.replace(costs.actions[0], counter="coffee")
    with pytest.raises(InputError, match=r"counter 'coffee' has a price but nobody counts it"):
        dataclasses.replace(costs, actions=(*costs.actions, stranger))
    with pytest.raises(InputError, match=r"must have one price, not 2"):
        dataclasses.replace(costs, actions=(*costs.actions, costs.actions[0]))
    unknown = dataclasses.replace(costs.actions[0], operations={"fp64_add": 1.0})
    with pytest.raises(
        InputError, match=r"no operation 'fp64_add'; known operations are int32_add"
    ):
        dataclasses.replace(costs, actions=(unknown, *costs.actions[1:]))
    with pytest.raises(InputError, match=r"area component 'merge_unit' must have a price"):
        kept_areas = tuple(a for a in costs.areas if a.component != "merge_unit")
        dataclasses.replace(costs, areas=kept_areas)


def test_half_the_work_is_half_the_dynamic_energy(
    nebula: AcceleratorConfig,
    analysis: FrameAnalysis,
    costs: CostTable,
    technology: Technology,
) -> None:
    """Activity doubled first, so that halving is exact. Static parts keep their time."""
    doubled = analysis.activity.scaled(2, 1)
    whole = frame_energy(nebula, doubled, analysis.timing, costs, technology)
    half = frame_energy(nebula, doubled.scaled(1, 2), analysis.timing, costs, technology)
    for before, after in zip(whole.parts, half.parts, strict=True):
        factor = 0.5 if before.kind == "dynamic" else 1.0
        assert after.value_mj == pytest.approx(factor * before.value_mj, rel=1e-12), before.name


def test_static_energy_follows_the_time(
    nebula: AcceleratorConfig,
    analysis: FrameAnalysis,
    report: EnergyReport,
    costs: CostTable,
    technology: Technology,
) -> None:
    longer = dataclasses.replace(analysis.timing, frame_ms=3 * analysis.timing.frame_ms)
    slow = frame_energy(nebula, analysis.activity, longer, costs, technology)
    for before, after in zip(report.parts, slow.parts, strict=True):
        factor = 3.0 if before.kind == "static" else 1.0
        assert after.value_mj == pytest.approx(factor * before.value_mj, rel=1e-12), before.name


def test_single_prices_by_hand(report: EnergyReport, analysis: FrameAnalysis) -> None:
    """An alpha check is 6 x 3.7 + 5 x 0.9 + 2 x 0.1 pJ at 45 nm, 0.196 of that at 8 nm."""
    parts = {part.name: part for part in report.parts}
    check = parts["alpha_checks"]
    expected = analysis.activity["alpha_checks"] * 26.9e-9 * (0.12353 / 0.63)
    assert check.value_mj == pytest.approx(expected, rel=1e-3)
    assert check.node == "8 nm (deepscaletool from 45 nm)"
    assert "Horowitz" in check.reference
    assert (check.source, check.confidence) == ("derived", "B")
    assert parts["radio_bytes_received"].value_mj == pytest.approx(2.0)  # 20 000 B at 100 nJ/B
    reads = parts["stereo_buffer_reads"]
    per_read = reads.value_mj / analysis.activity["stereo_buffer_reads"] * 1e9
    assert per_read == pytest.approx(1.51 * 0.12353 / 0.30, rel=1e-3)


def test_band_holds_the_point_and_names_its_model(
    nebula: AcceleratorConfig,
    analysis: FrameAnalysis,
    report: EnergyReport,
    costs: CostTable,
    technology: Technology,
) -> None:
    low, high = report.band_mj_per_frame
    assert low < high
    assert low <= report.total_mj_per_frame <= high
    other = changed(technology, "choice.model", "stillmaker_baas")
    second = frame_energy(nebula, analysis.activity, analysis.timing, costs, other)
    assert second.model == "stillmaker_baas"
    assert second.band_mj_per_frame == pytest.approx((low, high), rel=1e-2)
    none = changed(technology, "choice.model", "none")
    unscaled = frame_energy(nebula, analysis.activity, analysis.timing, costs, none)
    assert unscaled.total_mj_per_frame > high
    assert unscaled.dram_mj_per_frame == report.dram_mj_per_frame  # DRAM does not scale


def test_larger_node_costs_more(
    nebula: AcceleratorConfig, analysis: FrameAnalysis, costs: CostTable, technology: Technology
) -> None:
    totals = [
        frame_energy(nebula, analysis.activity, analysis.timing, costs, technology, node)
        for node in (8.0, 16.0, 28.0)
    ]
    on_chip = [total.on_chip_mj_per_frame for total in totals]
    assert on_chip == sorted(on_chip)
    assert totals[0].node_nm == 8.0


def test_one_library_for_logic(costs: CostTable) -> None:
    """Aladdin's floating-point energies are 10 to 19 times Horowitz's: never added together."""
    references = " ".join(leaf.reference for leaf in costs.operations)
    assert "Aladdin" not in references
    assert {leaf.node_nm for leaf in costs.operations} == {45.0}


def test_sram_between_and_outside_the_table(costs: CostTable) -> None:
    between = macro(costs.sram, 8.0, "1RW")
    assert 1.18 < between.read_pj < 4.16
    assert between.read_pj == pytest.approx(math.sqrt(1.18 * 4.16))
    assert (between.source, between.capacity_kib) == ("derived", 8.0)
    assert macro(costs.sram, 16.0, "1R1W").read_pj == 4.09
    with pytest.raises(InputError, match=r"no 1R1W memory macro of 2 KiB; it must lie within"):
        macro(costs.sram, 2.0, "1R1W")


def test_report_is_plain_data(report: EnergyReport) -> None:
    assert json.loads(json.dumps(dataclasses.asdict(report)))["model"] == "deepscaletool"
