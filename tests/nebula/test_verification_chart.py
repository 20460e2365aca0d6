"""The chart of ``nebula verify``: where the points, their numbers and their names stand."""

from __future__ import annotations

import io
import sys
from itertools import combinations

import pytest
from PIL import Image

from gaussians.errors import InputError
from nebula.verification import chart
from nebula.verification.chart import MissingReportExtra, accuracy_against_work


def row(method: str, wrong: int, psnr: float | None, checks: float, bits: int | None = None):
    """A row of 1 000 000 pixels."""
    return {
        "method": method,
        "mismatching_pixels": 2 * wrong if bits is None else bits,
        "mismatching_pixels_8bit": wrong,
        "pixels": 1_000_000,
        "psnr_db": psnr,
        "alpha_checks": round(checks * 1e6),
        "processed_left": 20_000_000,
        "processed_right": 5_000_000,
    }


LADDER = [
    row("paper", 660_000, 13.6, 1395),
    row("paper+past_termination", 600_000, 14.1, 1402),
    row("paper+two_tiles", 410_000, 21.1, 1454),
    row("paper+right_span", 400_000, 21.2, 1455),
    row("paper+rows", 300_000, 31.2, 1518),
    row("paper+field_of_view", 210_000, 41.0, 1519),
    row("paper+conic", 54_300, 86.2, 1518),
    row("paper+colour", 38_600, 86.3, 1520),
    row("paper+ellipse", 18_300, 95.3, 686),
    row("paper+list_membership", 1_100, 98.4, 695),
    row("paper+centre", 100, 120.4, 694),
    row("paper+tie_rule", 0, 133.0, 694, bits=310),
    row("exact", 0, None, 640),
]


@pytest.fixture
def figures(monkeypatch):
    """Figures as they are when written."""
    pytest.importorskip("matplotlib", reason="needs matplotlib (extra report)")
    written = []
    png = chart._png
    monkeypatch.setattr(chart, "_png", lambda figure: (written.append(figure), png(figure))[1])
    return written


def test_chart_is_a_png_that_names_every_method(figures):
    png = accuracy_against_work(LADDER, "street: accuracy against work")
    assert Image.open(io.BytesIO(png)).size == (2100, 1020)
    assert accuracy_against_work(LADDER, "street: accuracy against work") == png
    shares, ratios, table = figures[0].axes
    written = [text.get_text() for text in table.texts]
    for i, line in enumerate(LADDER):
        assert line["method"] in written and str(i + 1) in written
    assert "0.11 %" in written and "133.0 dB" in written and "25 M" in written
    assert figures[0].get_suptitle() == "street: accuracy against work"
    for axes in (shares, ratios):
        assert [line.get_xdata()[0] for line in axes.lines] == [
            line["alpha_checks"] / 1e6 for line in LADDER
        ]


def test_chart_puts_identical_images_into_their_bands(figures):
    accuracy_against_work(LADDER, "")
    shares, ratios, _table = figures[0].axes
    share = [line.get_ydata()[0] for line in shares.lines]
    assert share[:11] == [line["mismatching_pixels_8bit"] / 1e6 for line in LADDER[:11]]
    assert share[11] == share[12] < 1e-4 and share[12] > shares.get_ylim()[0]
    ratio = [line.get_ydata()[0] for line in ratios.lines]
    assert ratio[:12] == [line["psnr_db"] for line in LADDER[:12]]
    assert 140 < ratio[12] < ratios.get_ylim()[1]
    for axes, place, name in (
        (shares, share[12], "0 (identical)"),
        (ratios, ratio[12], "identical"),
    ):
        names = [label.get_text() for label in axes.get_yticklabels()]
        ticks = dict(zip(names, axes.get_yticks(), strict=True))
        assert ticks[name] == place
    markers = [line.get_marker() for line in shares.lines]
    assert markers == ["o"] * 12 + ["D"]  # equal in 8 bit alone is not yet exact


@pytest.mark.parametrize(
    "rows",
    [LADDER, LADDER[:1], LADDER[-1:], [LADDER[6]] * 20, LADDER[5:9] * 4],
    ids=["ladder", "one", "exact alone", "all in one place", "some in one place"],
)
def test_numbers_cover_neither_each_other_nor_a_dot(figures, rows):
    accuracy_against_work(rows, "")
    for axes in figures[0].axes[:2]:
        numbers = [number for text in axes.texts for number in expanded(text.get_text())]
        assert sorted(numbers) == list(range(1, len(rows) + 1))
        texts = [ink(text) for text in axes.texts]
        assert not any(a.overlaps(b) for a, b in combinations(texts, 2))
        dots = axes.transData.transform([line.get_xydata()[0] for line in axes.lines])
        assert not any(text.padded(3).contains(*dot) for text in texts for dot in dots)
        panel = axes.get_window_extent()
        assert all(panel.contains(*corner) for text in texts for corner in text.corners())


def test_dots_share_a_label_only_where_they_hide_each_other(figures):
    accuracy_against_work(LADDER, "")
    shares, ratios, _table = figures[0].axes
    labels = [text.get_text() for text in shares.texts]
    assert labels == ["1", "2", "3-4", *map(str, range(5, 14))]
    assert [text.get_text() for text in ratios.texts if "-" in text.get_text()] == ["3-4", "7-8"]


def ink(text):
    """The box of a number alone; an annotation's own box includes the line to its dot."""
    from matplotlib.text import Text

    return Text.get_window_extent(text)


def expanded(label: str) -> list[int]:
    """The numbers of a label such as '1, 3-5'."""
    numbers: list[int] = []
    for part in label.split(", "):
        ends = [int(end) for end in part.split("-")]
        numbers += range(ends[0], ends[-1] + 1)
    return numbers


def test_chart_needs_rows_and_matplotlib(monkeypatch):
    with pytest.raises(InputError, match="needs at least one method"):
        accuracy_against_work([], "")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingReportExtra, match=r"pip install 'nebula-splat\[report\]'"):
        accuracy_against_work(LADDER, "")
    assert issubclass(MissingReportExtra, InputError)
