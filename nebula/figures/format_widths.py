"""How the widths of format ``hw`` were settled: each one changed by a bit, all others kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from typing import Any

import numpy as np

from gaussians.fixed_records import FixedFormat
from gaussians.number_formats import NumberFormat
from nebula.figures.formats import REQUIRED_DB, SCENES, measure
from nebula.figures.output import Figure
from nebula.figures.views import choose_views
from nebula.options import FigureOptions
from nebula.output import text_table

HW = FixedFormat("hw")
WIDTHS = tuple(f.name for f in fields(FixedFormat) if f.name != "name")
CHANGES = (-1, 1)


def make(options: FigureOptions) -> Figure:
    """PSNR of the left eye of every scene with each width one bit less and one bit more."""
    formats: dict[str, NumberFormat] = {"hw": HW}
    changed = {f"{w} {change:+d}": (w, change) for w in WIDTHS for change in CHANGES}
    for name, (width, change) in changed.items():
        formats[name] = replace(HW, name=name, **{width: getattr(HW, width) + change})
    views = choose_views(options, SCENES)
    rows, described = [], []
    for view in views:
        measured = measure(view, formats)
        settled = measured[0]
        for row in measured[1:]:
            width, change = changed[row["format"]]
            bits = getattr(HW, width)
            row |= {"width": width, "bits": bits + change, "settled_bits": bits}
            row |= {"settled_psnr_db": settled["psnr_db"]}
        rows += measured[1:]
        described.append(view.description)
    notes = {
        "reference": "fp32, left eye, black background, ellipse lists of 4x4 tiles",
        "required_db": REQUIRED_DB,
        "settled": asdict(HW),
        "scenes": described,
        "missing_scenes": list(views.missing),
    }
    return Figure(
        f"Format hw, one width changed by one bit: {', '.join(views.chosen)}",
        notes,
        rows,
        lambda canvas: _draw(canvas, rows),
        _table(rows) + views.missing_text,
    )


def _pairs(rows: Sequence[dict[str, Any]], scene: str) -> dict[str, list[dict[str, Any]]]:
    """Of one scene: width -> the row with a bit less and the row with a bit more."""
    of_scene = [row for row in rows if row["scene"] == scene]
    return {w: sorted((r for r in of_scene if r["width"] == w), key=_bits) for w in WIDTHS}


def _bits(row: dict[str, Any]) -> int:
    return int(row["bits"])


def _table(rows: Sequence[dict[str, Any]]) -> str:
    heads = ["scene", "width", "bits", "one less", "settled", "one more"]
    lines = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        for width, (less, more) in _pairs(rows, scene).items():
            values = (less["psnr_db"], less["settled_psnr_db"], more["psnr_db"])
            shown = ["identical" if v is None else f"{v:.2f} dB" for v in values]
            lines.append([scene, width, str(less["settled_bits"]), *shown])
    return text_table(heads, lines, (2, 3, 4, 5))


def _draw(canvas: Any, rows: Sequence[dict[str, Any]]) -> None:
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    canvas.set_size_inches(3.2 + 3.6 * len(scenes), 5)
    at = np.arange(len(WIDTHS))
    for axes, scene in zip(
        canvas.subplots(1, len(scenes), sharey=True, squeeze=False)[0], scenes, strict=True
    ):
        pairs = list(_pairs(rows, scene).values())
        for place, marker, label in ((0, "<", "one bit less"), (1, ">", "one bit more")):
            axes.plot([p[place]["psnr_db"] for p in pairs], at, marker, label=label)
        settled = pairs[0][0]["settled_psnr_db"]
        if settled is not None:
            axes.axvline(settled, color="black", linewidth=1, label="hw as settled")
        axes.axvline(REQUIRED_DB, color="black", linestyle="--", linewidth=1, label="required")
        axes.set_yticks(at, [f"{w} = {getattr(HW, w)}".replace("_", " ") for w in WIDTHS])
        axes.set_ylim(len(WIDTHS) - 0.5, -0.5)
        axes.set_title(f"{scene}\n{pairs[0][0]['display']}", fontsize=9)
        axes.set_xlabel("PSNR against fp32, dB")
        axes.grid(axis="y", alpha=0.3)
    canvas.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4)
