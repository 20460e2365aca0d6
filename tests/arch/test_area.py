"""Area: sums, counts, and the paper's figures beside ours with their tolerances explained."""

from __future__ import annotations

import dataclasses
import json
import math

import pytest

from arch import (
    AcceleratorConfig,
    CostTable,
    Technology,
    area,
    paper_comparison,
    with_cores,
)
from tests.arch.build import changed


@pytest.mark.parametrize("model", ["deepscaletool", "stillmaker_baas", "none"])
def test_total_is_the_sum_of_the_parts(
    nebula: AcceleratorConfig, costs: CostTable, technology: Technology, model: str
) -> None:
    report = area(nebula, costs, changed(technology, "choice.model", model))
    total = math.fsum(part.mm2 for part in report.parts)
    assert report.total_mm2 == pytest.approx(total, rel=1e-12)
    for part in report.parts:
        assert part.mm2 == pytest.approx(part.count * part.unit_mm2)
    assert report.band_mm2[0] <= report.total_mm2 <= report.band_mm2[1]
    whole = report.logic_mm2 + report.sram_mm2
    assert total == pytest.approx(whole * (1 + costs.integration.share))


def test_counts_are_the_configurations(
    nebula: AcceleratorConfig, gscore: AcceleratorConfig, costs: CostTable, technology: Technology
) -> None:
    counts = {part.name: part.count for part in area(nebula, costs, technology).parts}
    assert counts["rendering_unit"] == 128
    assert counts["projection_unit"] == counts["sorting_unit"] == 4
    assert counts["stereo_reprojection_unit"] == counts["merge_unit"] == 8
    assert counts["stereo_buffer"] == 32  # eight times four banks of 4 KB
    names = {part.name for part in area(gscore, costs, technology).parts}
    added = {"stereo_reprojection_unit", "merge_unit", "stereo_buffer", "decoder"}
    assert not names & (added | {"codebook_buffer"})
    assert area(with_cores(nebula, 16), costs, technology).parts[4].count == 256


def test_unit_areas_by_hand(
    nebula: AcceleratorConfig, costs: CostTable, technology: Technology
) -> None:
    """28 to 16 nm 0.308; cell area 22 to 16 nm 0.804."""
    units = {part.name: part.unit_mm2 for part in area(nebula, costs, technology).parts}
    assert units["rendering_unit"] == pytest.approx(0.02384 * 0.3082, rel=1e-3)
    assert units["feature_buffer"] == pytest.approx(0.0285 * 0.074 / 0.092, rel=1e-9)
    at_28 = area(gs_logic(nebula), costs, changed(technology, "choice.model", "none"))
    assert next(p for p in at_28.parts if p.name == "rendering_unit").unit_mm2 == 0.02384


def gs_logic(config: AcceleratorConfig) -> AcceleratorConfig:
    return changed(changed(config, "stereo", None), "decoder", None)


def test_paper_figures(
    nebula: AcceleratorConfig, gscore: AcceleratorConfig, costs: CostTable, technology: Technology
) -> None:
    """Comparisons, not fits. Tolerances: what our sources leave open.

    Base and total 25 %: module areas of two re-implementations differ by 1.3. Added area 50 %: the
    merge unit is cell area alone and SRU and decoder are estimates. 256 RUs: the paper does not
    say what is doubled; everything in a core gives more than its 62.9 %.
    """
    figures = {
        figure.name: figure for figure in paper_comparison(nebula, gscore, costs, technology)
    }
    assert figures["GSCore area"].ratio == pytest.approx(1.0, abs=0.25)
    assert figures["NEBULA area"].ratio == pytest.approx(1.0, abs=0.25)
    assert figures["area added by NEBULA"].ratio == pytest.approx(1.0, abs=0.5)
    assert 45.0 < figures["more area for 256 RUs"].ours < 90.0
    for figure in figures.values():
        assert figure.reason
        assert figure.ratio == pytest.approx(figure.ours / figure.paper)
    overhead = figures["area added by NEBULA"].ours / figures["GSCore area"].ours
    assert figures["area overhead"].ours == pytest.approx(100 * overhead)


def test_modules_of_gscore_at_28_nm(costs: CostTable) -> None:
    """4 CCU, 4 sorters and 64 VRU: 2.26 mm2; with 248 KB by 1758 um2/KB 2.7 of the published 3.95.

    The missing third is control, network and buffers nobody lists: our integration share of 15 % is
    below it.
    """
    modules = (
        4 * costs.area_of("projection_unit").mm2
        + 4 * costs.area_of("sorting_unit").mm2
        + 64 * costs.area_of("rendering_unit").mm2
    )
    assert modules == pytest.approx(2.26, abs=0.02)
    assert 0.6 < (modules + 248 * 1758e-6) / 3.95 < 1.0


def test_8_nm_is_smaller_and_the_models_disagree(
    nebula: AcceleratorConfig, costs: CostTable, technology: Technology
) -> None:
    at_16, at_8 = area(nebula, costs, technology, 16.0), area(nebula, costs, technology, 8.0)
    assert at_8.total_mm2 < 0.3 * at_16.total_mm2
    assert at_8.band_mm2[1] > 2 * at_8.band_mm2[0]
    assert "8 nm (deepscaletool from 28 nm)" in {part.node for part in at_8.parts}


def test_report_is_plain_data(
    nebula: AcceleratorConfig, costs: CostTable, technology: Technology
) -> None:
    report = area(nebula, costs, technology)
    assert json.loads(json.dumps(dataclasses.asdict(report)))["node_nm"] == 16.0
