"""What the right eye shares with the left one (paper Sec. 3.3, Fig. 8).

The paper warps the left image to the right eye and counts right pixels that nothing reaches: fewer
than 1 %. Here the left image is warped by its expected depth (blending weights times depths over
the sum of weights), pixels without splats at infinity; eye_overlap.py has further measures beside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from nebula.figures.eye_overlap import DEPTH_TOLERANCE, overlap
from nebula.figures.output import Figure
from nebula.figures.views import choose_views
from nebula.options import FigureOptions
from nebula.output import text_table
from nebula.progress import progress

SCENES = ("street", "near", "elev", "playbot", "st_peter", "donut")
PAPER_SHARE = 0.01  # fewer than this, Sec. 3.3

MEASURES = {
    "unreached": "pixels no warped left pixel touches",
    "unreached_of_covered": "the same, of the pixels with splats alone",
    "unreached_by_points": "pixels no left pixel's centre falls into",
    "other_depth": f"pixels at another depth than in the left eye (> {DEPTH_TOLERANCE:.0%})",
    "splats_right_only": "blended splats not blended in the left eye",
    "pairs_right_only": "(splat, tile) pairs of such splats",
    "weight_right_only": "blending weight of such splats",
}
DIFFERENCE = (
    "The paper does not say how it treats cracks of the warp, the window's edge or near content, "
    "and its scenes are not available here. Unreached pixels lie behind depth edges, which these "
    "streets and their trees have many of, and in the strip that only the right eye sees "
    "(unreached_right_edge); both grow with baseline x focal length / depth. Warped "
    "as bare points, surfaces that are wider in the right eye leave cracks. Reaching a pixel does "
    "not mean seeing its surface: see other_depth, where translucent splats have no single depth."
)


def make(options: FigureOptions) -> Figure:
    """One row per scene, all shares of the right eye."""
    views = choose_views(options, SCENES)
    rows, described = [], []
    for view in views:
        with progress(f"both eyes of {view.name}"):
            splats, spans = view.binned(eyes=2)
            found = overlap(splats, spans, view.rig)
        row: dict[str, Any] = {**view.labels, "baseline_m": view.rig.baseline_m, **asdict(found)}
        rows.append({**row, "paper_unreached_below": PAPER_SHARE})
        described.append(view.description)
    notes = {
        "measures": MEASURES,
        "paper": {
            "unreached_below": PAPER_SHARE,
            "reference": "Sec. 3.3 and Fig. 8",
            "scenes": "the paper's data sets, not available here",
            "difference": DIFFERENCE,
        },
        "scenes": described,
        "missing_scenes": list(views.missing),
    }
    return Figure(
        f"Share of the right eye that the left eye does not have: {', '.join(views.chosen)}",
        notes,
        rows,
        lambda canvas: _draw(canvas, rows),
        _table(rows) + "\npaper: fewer than 1 % of the pixels unreached" + views.missing_text,
    )


def _table(rows: Sequence[dict[str, Any]]) -> str:
    heads = ["scene", *(measure.replace("_", " ") for measure in MEASURES)]
    lines = [[row["scene"], *(f"{row[measure]:.2%}" for measure in MEASURES)] for row in rows]
    return text_table(heads, lines, range(1, len(heads)))


def _draw(canvas: Any, rows: Sequence[dict[str, Any]]) -> None:
    canvas.set_size_inches(11, 2.6 + len(rows))
    axes = canvas.subplots()
    height = 0.84 / len(MEASURES)
    smallest = 1e-3
    for index, (measure, label) in enumerate(MEASURES.items()):
        at = np.arange(len(rows)) + (index - (len(MEASURES) - 1) / 2) * height
        percent = [100 * row[measure] for row in rows]
        bars = axes.barh(at, np.maximum(percent, smallest), height, label=label)
        axes.bar_label(bars, [f"{p:.2g} %" for p in percent], fontsize=7, padding=2)
    paper = f"paper: fewer than {PAPER_SHARE:.0%} of the pixels unreached"
    axes.axvline(
        100 * PAPER_SHARE, color="black", linestyle="--", linewidth=1, zorder=0, label=paper
    )
    axes.set_yticks(
        np.arange(len(rows)), [f"{r['scene']}\n{r['display'].replace(', ', chr(10))}" for r in rows]
    )
    axes.tick_params(axis="y", labelsize=8)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlim(smallest, 150)
    axes.set_xlabel(f"share of the right eye, % (baseline {100 * rows[0]['baseline_m']:g} cm)")
    canvas.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
