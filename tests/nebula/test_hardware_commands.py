"""``nebula area`` and ``nebula energy`` on the shipped configurations."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from gaussians.errors import InputError
from nebula import area, energy
from nebula.config import configs_root
from nebula.hardware import load_accelerator
from nebula.options import AreaOptions, EnergyOptions
from nebula.output import json_text, text_table
from nebula.session_config import load_session_config
from tests.nebula.sample_report import sample_report


@pytest.mark.parametrize("name", ["nebula", "gscore_nebula"])
def test_area_is_the_sum_of_its_parts(name: str) -> None:
    result = area.run(AreaOptions(name, 16.0, "deepscaletool"))
    parts = math.fsum(part["mm2"] for part in result.data["parts"])
    assert result.data["total_mm2"] == pytest.approx(parts, rel=1e-12)
    assert result.text.startswith(f"{name}: {result.data['total_mm2']:.3f} mm² at 16 nm")
    json_text(result.data, "area")


def test_area_shrinks_with_the_node_by_the_model_that_is_named() -> None:
    totals = {
        (node, model): area.run(AreaOptions("nebula", node, model)).data["total_mm2"]
        for node in (16.0, 8.0)
        for model in ("deepscaletool", "stillmaker_baas", "none")
    }
    assert totals[8.0, "none"] == totals[16.0, "none"]
    assert totals[8.0, "deepscaletool"] < 0.6 * totals[16.0, "deepscaletool"]
    assert totals[8.0, "stillmaker_baas"] > totals[8.0, "deepscaletool"]


def test_an_accelerator_may_be_a_file_and_must_be_known(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text((configs_root() / "nebula.yaml").read_text())
    assert load_accelerator(str(path)) == load_accelerator("nebula")
    path.write_text(path.read_text() + "row_count: 4\n")
    with pytest.raises(InputError, match=r"^mine: unknown key 'row_count'; known keys are name, "):
        load_accelerator(str(path))
    with pytest.raises(InputError, match="one of: gscore_nebula, nebula"):
        load_accelerator("nebulla")


def test_every_price_is_listed_with_its_source() -> None:
    result = energy.run(EnergyOptions(None))
    for price in result.data["prices"]:
        assert price["source"] and price["reference"] and price["confidence"] in "ABCM"
        assert price["values"] in result.text
    assert "component rendering_unit, operations 5.0 fp16_multiply" in result.text
    assert result.data["run"] is None


def test_a_finished_run_is_broken_down(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text(json.dumps(sample_report()))
    result = energy.run(EnergyOptions(path))
    assert result.data["run"] == sample_report()["energy"]
    breakdown = result.text.split("mJ per frame, ")[1]
    assert breakdown.index("dram") < breakdown.index("radio") < breakdown.index("decoder")


@pytest.mark.parametrize(
    ("content", "message"),
    [("", "must be a report in JSON"), ("[]", "must be a group of keys"), ("{}", "missing key")],
)
def test_what_is_not_a_report_is_refused(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "report.json"
    path.write_text(content)
    with pytest.raises(InputError, match=message):
        energy.run(EnergyOptions(path))


def test_columns_of_a_text_table_line_up() -> None:
    assert text_table(["a", "mm²"], [["bb", "1.0"], ["c", "10.0"]], numbers=(1,)) == (
        "a    mm²\nbb   1.0\nc   10.0"
    )


def test_the_decoder_is_built_for_the_codebook_of_the_session() -> None:
    book, decoder = load_session_config().codebook, load_accelerator("nebula").decoder
    assert decoder is not None
    timing = decoder.timing
    assert (timing.codebook_words, timing.codebook_stages) == (book.words, book.stages)
