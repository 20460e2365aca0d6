"""The report's schema, its documentation and its page."""

from __future__ import annotations

import copy
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from gaussians.errors import InputError
from nebula.report import html_page, stable_part, validate_report
from nebula.report.charts import bar_chart, column_chart, exact, part_bars, scaled, significant
from nebula.report.keys import KEYS
from nebula.report.schema import table
from tests.nebula.sample_report import sample_png, sample_report

DOCS = Path(__file__).parents[2] / "docs" / "report.md"
IMAGES: dict[str, Path | bytes] = {"left": sample_png(), "right": sample_png(8)}


def change(report: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    *groups, last = path.split(".")
    place = report
    for group in groups:
        place = place[group]
    place[last] = value
    return report


class Page(HTMLParser):
    """Collects tags, their attributes and the text; every tag must be closed in order."""

    VOID = ("meta", "img", "br", "wbr")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


# ---------------------------------------------------------------- schema


def test_the_sample_report_is_valid() -> None:
    report = sample_report()
    validate_report(report)
    assert report == sample_report()


def test_the_documentation_holds_the_table_of_the_schema() -> None:
    documented = DOCS.read_text(encoding="utf-8")
    assert table() in documented, (
        "run: python -m nebula.report, and put the table into docs/report.md"
    )


def test_the_documented_keys_are_the_validated_keys() -> None:
    documented = re.findall(r"^\| `([^`]+)` \|", DOCS.read_text(encoding="utf-8"), re.MULTILINE)
    assert documented == [key.path for key in KEYS]
    assert set(documented) == set(paths_of(sample_report()))


def paths_of(value: Any, path: str = "") -> list[str]:
    """Schema paths of a report's leaves, found without the validator."""
    known = {key.path for key in KEYS}
    if path in known:
        return [path]
    if isinstance(value, list):
        return [p for item in value for p in paths_of(item, f"{path}[]")]
    assert isinstance(value, dict), path
    found = []
    for key, item in value.items():
        below = f"{path}.{key}".lstrip(".")
        found += paths_of(item, f"{path}.*" if f"{path}.*" in known else below)
    return found


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("timing.fps", "fast", r"report\.timing\.fps: must be of type 'number', not 'fast'"),
        ("timing.fps", float("nan"), r"report\.timing\.fps: must be of type 'number', not nan"),
        ("timing.fps", True, r"report\.timing\.fps: must be of type 'number', not True"),
        ("timing.frames", 3, r"report\.timing: unknown key 'frames'; known keys are accelerator"),
        ("stereo.pixels", 1.5, r"report\.stereo\.pixels: must be of type 'integer', not 1\.5"),
        ("stereo.method", None, r"report\.stereo\.method: must be of type 'string', not None"),
        ("lod.cut_sizes", [1, 2.5], r"report\.lod\.cut_sizes: must be of type 'list of integers'"),
        ("energy.parts.dram", "a", r"report\.energy\.parts\.dram: must be of type 'number'"),
        ("area", 3, r"report\.area: must be a group of keys, not 3"),
        ("frames", {}, r"report\.frames: must be a list"),
        ("schema_version", 2, r"report\.schema_version: must be 1, not 2"),
        ("energy.total_mj_per_frame", 1.0, r"energy\.total_mj_per_frame: must be parts plus radio"),
        ("area.total_mm2", 2.5, r"report\.area\.total_mm2: must be the sum of parts, 2\.0"),
        ("timing.dram_bytes_per_frame", 5, r"dram_bytes_per_frame: must be the sum of streams"),
        ("timing.fps", 90.0, r"report\.timing\.fps: must be clock over cycles, 70\.1"),
        ("stereo.right_mismatching_pixels", 1, r"right_mismatching_pixels: must be the sum over"),
    ],
)
def test_a_wrong_report_is_refused_by_place(path: str, value: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        validate_report(change(sample_report(), path, value))


@pytest.mark.parametrize("key", [k for k in KEYS if "*" not in k.path], ids=lambda key: key.path)
def test_every_key_is_required(key: Any) -> None:
    report = sample_report()
    *groups, last = key.path.split(".")
    place: Any = report
    for group in groups:
        place = place[group[:-2]][0] if group.endswith("[]") else place[group]
    del place[last]
    with pytest.raises(InputError, match=f"missing key '{last}'"):
        validate_report(report)


def test_the_stable_part_leaves_out_machine_and_times_only() -> None:
    stable = stable_part(sample_report())
    assert set(stable["provenance"]) == {
        *("version", "commit", "machine", "seed", "placement", "display", "options", "inputs"),
        "stage_wall_s",
    }
    assert stable["provenance"]["machine"] == {"packages": {}}
    assert stable["provenance"]["stage_wall_s"] == {}
    assert "search_ms" not in stable["lod"]
    for group in ("scene", "stereo", "timing", "energy", "area", "quality", "frames", "sources"):
        assert stable[group] == sample_report()[group]


# ---------------------------------------------------------------- page


def test_the_page_is_well_formed_and_asks_for_nothing() -> None:
    page = Page(html_page(sample_report(), IMAGES))
    for tag, attributes in page.tags:
        assert tag not in ("script", "link", "iframe", "object")
        for name in ("src", "href", "xlink:href", "action", "srcset"):
            link = attributes.get(name)
            assert link is None or link.startswith("data:image/png;base64,")
    style = (Path(__file__).parents[2] / "nebula/report/page.css").read_text(encoding="utf-8")
    assert "url(" not in style and "@import" not in style
    assert sum(tag == "img" for tag, _ in page.tags) == 2


def test_images_come_from_files_as_from_bytes(tmp_path: Path) -> None:
    (tmp_path / "left.png").write_bytes(sample_png())
    from_file = html_page(sample_report(), {"left": tmp_path / "left.png"})
    assert from_file == html_page(sample_report(), {"left": sample_png()})


@pytest.mark.parametrize("mismatching", [0, 3])
def test_a_difference_picture_is_shown_where_there_is_a_difference(mismatching: int) -> None:
    report = sample_report()
    report["stereo"]["right_mismatching_pixels"] = mismatching
    report["frames"][2]["right_mismatching_pixels"] = mismatching
    page = Page(html_page(report, {**IMAGES, "difference": sample_png(16)}))
    assert sum(tag == "img" for tag, _ in page.tags) == (3 if mismatching else 2)


def test_the_page_shows_the_headline_figures_with_units() -> None:
    text = " ".join("".join(Page(html_page(sample_report(), IMAGES)).text).split())
    for expected in (
        "Frame rate70.1 FPS",
        "Bound byDRAM",
        "Stream9.00 Mbps",
        "Energy per frame30.6 mJ",
        "Area2.03 mm² at 16 nm",
        "Right-eye mismatching pixels0 of 12 582 912 compared",
        "Right eye, PSNRidentical",
        "Image, PSNR36.2 dB",
    ):
        assert expected in text


def test_a_method_that_is_not_exact_shows_its_count_and_psnr() -> None:
    report = sample_report()
    report["frames"][0]["right_mismatching_pixels"] = 1_234_567
    report["stereo"].update(right_mismatching_pixels=1_234_567, psnr_db=31.4159)
    text = "".join(Page(html_page(report, {})).text)
    assert "1\u202f234\u202f567" in text
    assert "31.4 dB" in text


def test_identical_images_and_missing_ssim_are_words() -> None:
    report = sample_report()
    report["quality"]["decoded_vs_cut"] = {"psnr_db": None, "ssim": None}
    text = "".join(Page(html_page(report, {})).text)
    assert "(codec loss)identicalnot measured" in text


def test_every_source_and_note_is_shown() -> None:
    report = sample_report()
    text = "".join(Page(html_page(report, {})).text)
    for source in report["sources"]:
        for key in ("name", "unit", "source", "reference", "confidence"):
            assert source[key] in text
    for note in report["notes"]:
        assert note in text


def test_texts_are_escaped_wherever_they_come_from() -> None:
    """Every text of the report becomes markup; none of it may reach the page as markup."""

    def poison(value: Any, key: str = "") -> Any:
        if isinstance(value, dict):
            return {k: poison(v, k) for k, v in value.items()}
        if isinstance(value, list):
            return [poison(v, key) for v in value]
        return f"{value}<script>&\"'" if isinstance(value, str) else value

    plain_tags = {tag for tag, _ in Page(html_page(sample_report(), IMAGES)).tags}
    report = poison(sample_report())
    for parts in (report["energy"]["parts"], report["area"]["parts"], report["timing"]["cycles"]):
        parts["<script>key"] = parts.pop("decoder")
    report["provenance"]["options"]["<script>option"] = 1
    text = html_page(report, {'<script>"': sample_png()})
    assert "<script" not in text
    assert {tag for tag, _ in Page(text).tags} <= plain_tags


def test_an_invalid_report_has_no_page() -> None:
    report = copy.deepcopy(sample_report())
    del report["area"]
    with pytest.raises(InputError, match="missing key 'area'"):
        html_page(report, {})


def test_a_single_search_without_updates_has_a_page() -> None:
    report = sample_report()
    report["lod"].update(overlap_mean=None, cut_sizes=[5], search_ms=[1.0])
    report["stream"].update(message_bytes=[10], mbps_mean=0.0)
    report["notes"] = []
    page = html_page(report, {})
    assert Page(page).tags and "Cut size per search" in page


# ---------------------------------------------------------------- charts and numbers


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0, "0"),
        (0.0, "0"),
        (70.126, "70.1"),
        (9.999, "10.0"),
        (0.9999, "1.00"),
        (0.012345, "0.0123"),
        (1234.5, "1\u202f230"),
        (-4.5678, "-4.57"),
        (0.00001234, "1.23e-05"),
    ],
)
def test_three_significant_digits(value: float, text: str) -> None:
    assert significant(value) == text


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (35_400_000, "B", "35.4 MB"),
        (14_260_000, "cycles", "14.3 M cycles"),
        (9_999, "B", "10\u202f000 B"),
        (999_900, "B", "1\u202f000 kB"),
        (12, "", "12.0"),
        (0, "B", "0 B"),
    ],
)
def test_large_numbers_get_a_prefix(value: float, unit: str, text: str) -> None:
    assert scaled(value, unit) == text


def test_counts_keep_every_digit() -> None:
    assert exact(12_582_912) == "12\u202f582\u202f912"


def test_bars_are_as_long_as_their_share() -> None:
    chart = part_bars({"small": 1.0, "large": 4.0}, "mJ")
    assert re.findall(r"width:([\d.]+)%", chart) == ["100.00", "25.00"]
    assert chart.index("large") < chart.index("small")
    assert "4.00 mJ · 80.0 %" in chart
    assert bar_chart([]) == '<div class="bars"></div>'


def test_columns_are_as_high_as_their_value() -> None:
    chart = column_chart([50.0, 100.0, 0.0], ["a", "b", "c"], "B", "frame")
    heights = [float(h) for h in re.findall(r'<rect [^>]*height="([\d.]+)"', chart)]
    assert heights[1] == pytest.approx(2 * heights[0], abs=0.2)
    assert heights[2] == 0
    assert "100 B" in chart
