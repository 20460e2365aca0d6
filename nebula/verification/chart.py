"""The chart of ``nebula verify``: how wrong a stereo method's right eye is, against its work.

Two panels over one work axis: the share of pixels wrong in 8 bit, and PSNR. Neither logarithm has
a place for "identical", so each panel has a band for it. Points carry numbers, a table at the side
their names.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from gaussians.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Row = Mapping[str, Any]

_DPI = 150
_ROW_INCHES = 0.27
_BAND = "#e4f2ec"
_DOT_PX = 10  # half the side of the square kept free around a dot
_TEXT_PX = 12  # half the height kept free for a number
_RINGS_PX = range(14, 400, 12)  # distances tried for a number from its dot
_DIRECTIONS = 16


class MissingReportExtra(InputError):
    """A chart needs the optional extra ``report``, which is not installed."""


def accuracy_against_work(rows: Sequence[Row], title: str) -> bytes:
    """PNG of one point per row: accuracy of the right eye against alpha checks of both eyes.

    Keys of a row: ``method``, ``mismatching_pixels`` (float32 bits), ``mismatching_pixels_8bit``,
    ``pixels``, ``psnr_db`` (None when identical), ``alpha_checks``, ``processed_left``,
    ``processed_right``. Points are numbered in the order of the rows.

    Raises InputError without rows, and MissingReportExtra (one too) without matplotlib.
    """
    if not rows:
        raise InputError("a chart of accuracy against work needs at least one method")
    try:
        from matplotlib import style
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingReportExtra(
            f"the chart needs matplotlib (pip install 'nebula-splat[report]'): {error}"
        ) from error
    with style.context("default"):
        figure = Figure(figsize=(14.0, max(6.8, 1.6 + _ROW_INCHES * len(rows))), dpi=_DPI)
        canvas = FigureCanvasAgg(figure)
        grid = figure.add_gridspec(
            2, 2, width_ratios=(1.0, 0.86), left=0.085, right=0.985, bottom=0.085, top=0.92,
            hspace=0.09, wspace=0.06,
        )  # fmt: skip
        shares = figure.add_subplot(grid[0, 0])
        ratios = figure.add_subplot(grid[1, 0], sharex=shares)
        figure.suptitle(title, x=0.085, ha="left", fontsize=13)
        _draw_shares(shares, rows)
        _draw_psnr(ratios, rows)
        _draw_table(figure.add_subplot(grid[:, 1]), rows)
        canvas.draw()  # fixes the scales the numbers are placed by
        _number_points(shares, rows, [_share_place(row, rows) for row in rows])
        _number_points(ratios, rows, [_psnr_place(row, rows) for row in rows])
        return _png(figure)


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def _work(row: Row) -> float:
    """Millions of alpha checks."""
    return float(row["alpha_checks"]) / 1e6


def _share(row: Row) -> float:
    return float(row["mismatching_pixels_8bit"]) / float(row["pixels"])


def _least_share(rows: Sequence[Row]) -> float:
    """The power of ten below every share that is not zero; the band of zeros lies beneath it."""
    shares = [_share(row) for row in rows if row["mismatching_pixels_8bit"]]
    return 10.0 ** math.floor(math.log10(min(shares, default=0.01)) - 1e-9)


def _most_db(rows: Sequence[Row]) -> float:
    """The multiple of 10 dB above every PSNR; the band of identical images lies above it."""
    ratios = [float(row["psnr_db"]) for row in rows if row["psnr_db"] is not None]
    return 10.0 * math.ceil(max(ratios, default=59.0) / 10 + 0.05)


def _share_place(row: Row, rows: Sequence[Row]) -> float:
    least = _least_share(rows)
    return _share(row) or least * _band_ratio(least) ** 0.5


def _band_ratio(least: float) -> float:
    """Lower end of the band of zeros over its upper end: a seventh of the panel's height."""
    return least ** (1 / 6)


def _psnr_place(row: Row, rows: Sequence[Row]) -> float:
    most = _most_db(rows)
    return most * (1 + 1 / 12) if row["psnr_db"] is None else float(row["psnr_db"])


def _draw_shares(axes: Axes, rows: Sequence[Row]) -> None:
    least = _least_share(rows)
    lowest = least * _band_ratio(least)
    axes.set_yscale("log")
    axes.set_ylim(lowest, 2.0)
    axes.axhspan(lowest, least, color=_BAND, lw=0)
    decades = [10.0**e for e in range(round(math.log10(least)), 1)]
    axes.set_yticks(
        [least * _band_ratio(least) ** 0.5, *decades],
        ["0 (identical)", *(f"{100 * d:g} %" for d in decades)],
    )
    axes.set_yticks([], minor=True)
    axes.set_ylabel("right-eye pixels wrong in 8 bit")
    axes.tick_params(labelbottom=False)
    _draw_points(axes, rows, [_share_place(row, rows) for row in rows])


def _draw_psnr(axes: Axes, rows: Sequence[Row]) -> None:
    most = _most_db(rows)
    axes.set_ylim(0.0, most * (1 + 1 / 6))
    axes.axhspan(most, most * (1 + 1 / 6), color=_BAND, lw=0)
    step = 10 if most <= 70 else 20
    ticks = [float(db) for db in range(0, round(most) + 1, step)]
    axes.set_yticks([*ticks, most * (1 + 1 / 12)], [*(f"{t:g} dB" for t in ticks), "identical"])
    axes.set_ylabel("PSNR of the right eye")
    axes.set_xlabel("alpha checks of both eyes, millions")
    _draw_points(axes, rows, [_psnr_place(row, rows) for row in rows])


def _draw_points(axes: Axes, rows: Sequence[Row], places: Sequence[float]) -> None:
    """A filled diamond where every bit is right, else a circle; a grid behind."""
    axes.grid(True, color="#dddddd", lw=0.6)
    axes.set_axisbelow(True)
    axes.margins(x=0.1)
    for row, place in zip(rows, places, strict=True):
        exact = row["mismatching_pixels"] == 0
        axes.plot(
            _work(row), place, "D" if exact else "o", ms=7 if exact else 6,
            color="#007755" if exact else "#b0402a", mfc="#007755" if exact else "white",
        )  # fmt: skip


def _number_points(axes: Axes, rows: Sequence[Row], places: Sequence[float]) -> None:
    """Each dot's number beside it, clear of other numbers and dots; dots that hide each other share
    a label. A line leads to the dot."""
    points = [(_work(row), place) for row, place in zip(rows, places, strict=True)]
    dots = [_Box(x, y, _DOT_PX) for x, y in axes.transData.transform(points)]
    taken = list(dots)
    room = axes.get_window_extent().padded(-_TEXT_PX)
    for group in _hidden_together(dots):
        text = _numbers(group)
        spots = _around(dots[group[0]], 0.6 * _TEXT_PX * (len(text) + 1))
        inside = [spot for spot in spots if room.contains(spot.x, spot.y)]
        clashes = [sum(map(spot.overlaps, taken)) for spot in inside]
        taken.append(inside[clashes.index(min(clashes))])
        axes.annotate(
            text, points[group[0]],
            tuple(axes.transData.inverted().transform((taken[-1].x, taken[-1].y))),
            ha="center", va="center", fontsize=9,
            arrowprops={"arrowstyle": "-", "color": "#999999", "lw": 0.7, "shrinkB": 3},
        )  # fmt: skip


class _Box(NamedTuple):
    """A dot or a text on the figure, in pixels."""

    x: float
    y: float
    half_width: float

    def overlaps(self, other: _Box) -> bool:
        across = abs(self.x - other.x) < self.half_width + other.half_width
        return across and abs(self.y - other.y) < 2 * _TEXT_PX


def _hidden_together(dots: Sequence[_Box]) -> list[list[int]]:
    """Indices of the dots, those that nearly coincide in one group."""
    groups: list[list[int]] = []
    for i, dot in enumerate(dots):
        for group in groups:
            first = dots[group[0]]
            if math.hypot(dot.x - first.x, dot.y - first.y) < _DOT_PX / 2:
                group.append(i)
                break
        else:
            groups.append([i])
    return groups


def _numbers(group: Sequence[int]) -> str:
    """Indices as numbers from 1 with runs drawn together: "1, 3-5"."""
    runs: list[list[int]] = []
    for i in group:
        if runs and i == runs[-1][-1] + 1:
            runs[-1].append(i)
        else:
            runs.append([i])
    ends = [sorted({run[0] + 1, run[-1] + 1}) for run in runs]
    return ", ".join("-".join(map(str, pair)) for pair in ends)


def _around(dot: _Box, half_width: float) -> list[_Box]:
    """Places for a text beside a dot, nearest first."""
    angles = [2 * math.pi * (k + 0.5) / _DIRECTIONS for k in range(_DIRECTIONS)]
    return [
        _Box(
            dot.x + (ring + half_width) * math.cos(angle),
            dot.y + ring * math.sin(angle),
            half_width,
        )
        for ring in _RINGS_PX
        for angle in angles
    ]


_COLUMNS = (  # head, right edge as a share of the table's width
    ("wrong\nin 8 bit", 0.62),
    ("PSNR", 0.76),
    ("alpha\nchecks", 0.88),
    ("entries\nwalked", 1.0),
)


def _draw_table(axes: Axes, rows: Sequence[Row]) -> None:
    """Number, name and figures of each point; counts in millions, of both eyes."""
    axes.set_axis_off()
    lines = max(len(rows) + 2, 22)
    _write_row(axes, 1.0, "", "method", [head for head, _ in _COLUMNS], "#777777")
    for i, row in enumerate(rows):
        psnr = "identical" if row["psnr_db"] is None else f"{row['psnr_db']:.1f} dB"
        walked = (row["processed_left"] + row["processed_right"]) / 1e6
        cells = [f"{100 * _share(row):.3g} %", psnr, f"{_work(row):.4g} M", f"{walked:.3g} M"]
        ink = "#007755" if row["mismatching_pixels"] == 0 else "#222222"
        _write_row(axes, 1.0 - (i + 2) / lines, str(i + 1), row["method"], cells, ink)
    note = "diamond: equal in every float32 bit; circle: not"
    axes.text(0.06, 1.0 - (len(rows) + 2.6) / lines, note, fontsize=8.5, color="#777777", va="top")


def _write_row(
    axes: Axes, y: float, number: str, name: str, cells: Sequence[str], ink: str
) -> None:
    axes.text(0.035, y, number, ha="right", va="center", fontsize=9.5, color=ink)
    axes.text(0.06, y, name, ha="left", va="center", fontsize=9.5, color=ink)
    for cell, (_head, right) in zip(cells, _COLUMNS, strict=True):
        axes.text(right, y, cell, ha="right", va="center", fontsize=9.5, color=ink)
