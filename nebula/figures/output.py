"""What a figure is, and how it becomes three files."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gaussians.errors import InputError
from nebula.output import OutputDirectory

DPI = 110
Row = Mapping[str, str | int | float | bool | None]


@dataclass(frozen=True)
class Figure:
    """Measured rows and how to draw them.

    Every row names its scene, display and source, so that no number stands alone.
    """

    title: str
    notes: dict[str, Any]  # definitions, scenes, what is missing, what it is compared with
    rows: Sequence[Row]
    draw: Callable[[Any], None]  # onto a matplotlib figure
    text: str  # for the terminal


def require_matplotlib() -> None:
    """Raise InputError where the pictures could not be drawn, before anything is computed."""
    try:
        import matplotlib  # noqa: F401 - only whether it is there
    except ImportError as error:
        raise InputError(
            "figures are drawn by matplotlib, which is not installed: "
            "pip install 'nebula-splat[report]'"
        ) from error


def write_figure(out: OutputDirectory, name: str, figure: Figure) -> dict[str, Any]:
    """NAME.json, NAME.csv and NAME.png; returns what stands in the JSON file."""
    data = {"figure": name, "title": figure.title, **figure.notes, "rows": list(figure.rows)}
    out.write_json(f"{name}.json", data)
    out.write_text(f"{name}.csv", csv_text(figure.rows))
    out.write_bytes(f"{name}.png", png_of(figure))
    return data


def csv_text(rows: Sequence[Row]) -> str:
    """A header line and one line per row; empty where a row has no such value."""
    heads = list(dict.fromkeys(key for row in rows for key in row))
    stream = io.StringIO()
    writer = csv.DictWriter(stream, heads, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def png_of(figure: Figure) -> bytes:
    """The drawn figure with its title; the same bytes for the same rows."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    canvas = Canvas(layout="constrained")
    FigureCanvasAgg(canvas)
    canvas.suptitle(figure.title)
    figure.draw(canvas)
    stream = io.BytesIO()
    canvas.savefig(stream, format="png", dpi=DPI, metadata={"Software": None})
    return stream.getvalue()
