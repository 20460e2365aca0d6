"""How far an image rendered in each number format is from float32 (docs/number_formats.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from gaussians.number_formats import FORMATS, NumberFormat, rasterise_in_format
from gaussians.quality import error_8bit, psnr_db
from gaussians.rasterization import rasterise
from gaussians.tiling import tile_lists
from nebula.figures.output import Figure
from nebula.figures.views import View, choose_views
from nebula.options import FigureOptions
from nebula.output import text_table
from nebula.progress import progress

SCENES = ("street", "playbot", "st_peter")
REQUIRED_DB = 70.0
BLACK = (0.0, 0.0, 0.0)


def make(options: FigureOptions) -> Figure:
    """The left eye of every scene in every format but float32, against float32."""
    formats = {name: f for name, f in FORMATS.items() if name != "fp32"}
    views = choose_views(options, SCENES)
    rows, described = [], []
    for view in views:
        rows += measure(view, formats)
        described.append(view.description)
    notes = {
        "reference": "fp32, left eye, black background, ellipse lists of 4x4 tiles",
        "required_db": REQUIRED_DB,
        "scenes": described,
        "missing_scenes": list(views.missing),
        "formats": {name: {"kind": type(f).__name__, **asdict(f)} for name, f in formats.items()},
    }
    return Figure(
        f"Number formats against float32: {', '.join(views.chosen)}",
        notes,
        rows,
        lambda canvas: _draw(canvas, rows),
        _table(rows) + views.missing_text,
    )


def measure(view: View, formats: dict[str, NumberFormat]) -> list[dict[str, Any]]:
    """One row per format; ``psnr_db`` is None for an image equal to that of float32."""
    splats, spans = view.binned(eyes=1)
    features, lists, grid = splats.features[0], tile_lists(spans, 0), spans.grid
    reference = rasterise(features, lists, grid, BLACK).image
    rows: list[dict[str, Any]] = []
    with progress(f"{view.name} in {len(formats)} number formats", len(formats)) as step:
        for name, number_format in formats.items():
            made = rasterise_in_format(number_format, features, lists, grid, BLACK)
            error = error_8bit(made.image, reference)
            rows.append(
                {
                    **view.labels,
                    "format": name,
                    "psnr_db": psnr_db(made.image, reference),
                    "pixels": error.size,
                    "pixels_off_8bit_share": float((error > 0).mean()),
                    "pixels_off_more_than_1_lsb_share": float((error > 1).mean()),
                    "max_error_lsb": int(error.max()),
                    **{f"saturated_{k}": n for k, n in asdict(made.saturations).items()},
                }
            )
            step()
    return rows


def _table(rows: Sequence[dict[str, Any]]) -> str:
    heads = ["scene", "format", "PSNR dB", "off by > 1 LSB", "saturated"]
    lines = []
    for row in rows:
        saturated = sum(n for key, n in row.items() if key.startswith("saturated_"))
        psnr = "identical" if row["psnr_db"] is None else f"{row['psnr_db']:.1f}"
        off = f"{row['pixels_off_more_than_1_lsb_share']:.4%}"
        lines.append([row["scene"], row["format"], psnr, off, str(saturated)])
    return text_table(heads, lines, (2, 3, 4))


def _draw(canvas: Any, rows: Sequence[dict[str, Any]]) -> None:
    canvas.set_size_inches(11, 5.2)
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    formats = list(dict.fromkeys(row["format"] for row in rows))
    psnr_axes, share_axes = canvas.subplots(1, 2, sharey=True)
    height = 0.8 / len(scenes)
    smallest = 1e-5
    for index, scene in enumerate(scenes):
        of_scene = {row["format"]: row for row in rows if row["scene"] == scene}
        at = np.arange(len(formats)) + (index - (len(scenes) - 1) / 2) * height
        label = f"{scene}, {next(iter(of_scene.values()))['display']}"
        psnr = [of_scene[f]["psnr_db"] or np.nan for f in formats]
        off = [100 * of_scene[f]["pixels_off_more_than_1_lsb_share"] for f in formats]
        bars = psnr_axes.barh(at, psnr, height, label=label)
        psnr_axes.bar_label(bars, fmt="{:.1f}", fontsize=7, padding=2)
        bars = share_axes.barh(at, np.maximum(off, smallest), height)
        share_axes.bar_label(bars, [f"{p:.2g} %" for p in off], fontsize=7, padding=2)
    psnr_axes.axvline(REQUIRED_DB, color="black", linestyle="--", linewidth=1, zorder=0)
    psnr_axes.set_yticks(np.arange(len(formats)), formats)
    psnr_axes.invert_yaxis()
    measured = [row["psnr_db"] for row in rows if row["psnr_db"] is not None]
    psnr_axes.set_xlim(min(40.0, *measured) - 5, max(REQUIRED_DB, *measured) + 6)
    psnr_axes.set_xlabel(f"PSNR against fp32, dB (dashed: required of hw, {REQUIRED_DB:.0f} dB)")
    share_axes.set_xscale("log")
    share_axes.set_xlim(smallest, 500)
    share_axes.set_xlabel("pixels off by more than 1 step of 8 bit, %")
    canvas.legend(*psnr_axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
