"""The report as one self-contained HTML page: images inline, no script, no request to anywhere."""

from __future__ import annotations

import base64
import re
import string
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from nebula.report import results, tables
from nebula.report.blocks import tile
from nebula.report.charts import exact, scaled, significant, words
from nebula.report.schema import validate_report

_HERE = Path(__file__).parent

CAPTIONS = {
    "left": "Left eye",
    "right": "Right eye",
    "difference": "Right eye against an independently rendered one: mismatching pixels in white",
}


def html_page(report: Mapping[str, Any], images: Mapping[str, Path | bytes]) -> str:
    """The page of a report.

    Parameters
    ----------
    report : a report that passes ``validate_report``; InputError otherwise.
    images : PNG files or their bytes by name. ``left``, ``right`` and ``difference`` have captions,
        any other name is its own. ``difference`` is left out where it would be black.
    """
    validate_report(report)
    sections = [
        _headline(report),
        _images(images, identical=report["stereo"]["right_mismatching_pixels"] == 0),
        _notes(report["notes"]),
        results.accelerator(report),
        results.streaming(report),
        results.stereo_and_quality(report),
        tables.frames(report["frames"]),
        tables.provenance(report),
        tables.sources(report["sources"]),
    ]
    body = _header(report) + f'<main class="wide">{"".join(sections)}</main>'
    template = string.Template((_HERE / "page.html").read_text(encoding="utf-8"))
    style = (_HERE / "page.css").read_text(encoding="utf-8").strip()
    title = f"NEBULA · {escape(report['scene']['name'])}"
    return template.substitute(title=title, style=style, body=body)


def _header(report: Mapping[str, Any]) -> str:
    scene, run = report["scene"], report["provenance"]
    what = (
        f"{exact(scene['leaves'])} Gaussians · {len(report['frames'])} frames · "
        f"{run['display']['width']} × {run['display']['height']} px per eye · "
        f"stereo method {report['stereo']['method']} · "
        f"accelerator {report['timing']['accelerator']}"
    )
    commit = f"commit {run['commit'][:12]}" if run["commit"] else "installed package"
    return (
        '<header><div class="wide"><div>'
        f"<h1>NEBULA · {escape(scene['name'])}</h1><p>{escape(what)}</p></div>"
        f'<p class="right">version {escape(run["version"])} · {escape(commit)}<br>'
        f"{escape(run['started_utc'])}</p></div></header>"
    )


def _headline(report: Mapping[str, Any]) -> str:
    timing, stream, energy = report["timing"], report["stream"], report["energy"]
    area, stereo, quality = report["area"], report["stereo"], report["quality"]
    wrong, psnr = stereo["right_mismatching_pixels"], quality["decoded_vs_leaves"]["psnr_db"]
    lod, radio, scaled_area = report["lod"], energy["radio"]["mj_per_frame"], area["scaled"]
    tiles = [
        tile(
            "Frame rate",
            significant(timing["fps"]),
            "FPS",
            f"{scaled(timing['cycles_per_frame'], 'cycles')} per stereo frame",
        ),
        tile("Bound by", words(timing["bound_by"]), "", f"{timing['fidelity']} model"),
        tile(
            "Stream",
            significant(stream["mbps_mean"]),
            "Mbps",
            f"after a first {scaled(stream['initial_bytes'], 'B')}",
        ),
        tile(
            "Energy per frame",
            significant(energy["total_mj_per_frame"]),
            "mJ",
            f"radio {significant(radio)} mJ of it; {scaled(energy['power_mw'], 'mW')}",
        ),
        tile(
            "Area",
            significant(area["total_mm2"]),
            f"mm² at {area['node_nm']:g} nm",
            f"{significant(scaled_area['total_mm2'])} mm² at {scaled_area['node_nm']:g} nm",
        ),
        tile(
            "Right-eye mismatching pixels",
            exact(wrong),
            "",
            f"of {exact(stereo['pixels'])} compared, all float32 bits",
            "bad" if wrong else "good",
        ),
        tile(
            "Right eye, PSNR",
            "identical" if stereo["psnr_db"] is None else significant(stereo["psnr_db"]),
            "" if stereo["psnr_db"] is None else "dB",
            "against an independently rendered right eye",
        ),
        tile(
            "Image, PSNR",
            "identical" if psnr is None else significant(psnr),
            "" if psnr is None else "dB",
            f"what was streamed against all leaves, τ = {lod['tau_px']:g} px",
        ),
    ]
    return f'<div class="tiles">{"".join(tiles)}</div>'


def _images(images: Mapping[str, Path | bytes], identical: bool) -> str:
    figures = []
    for name, image in images.items():
        if identical and name == "difference":
            continue
        content = image if isinstance(image, bytes) else image.read_bytes()
        data = base64.b64encode(content).decode("ascii")
        caption = escape(CAPTIONS.get(name, name))
        figures.append(
            f'<figure><img src="data:image/png;base64,{data}" alt="{caption}">'
            f"<figcaption>{caption}</figcaption></figure>"
        )
    if not figures:
        return ""
    return f'<h2>Images</h2><div class="images">{"".join(figures)}</div>'


def _notes(notes: Sequence[str]) -> str:
    if not notes:
        return ""
    marked = (re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(note)) for note in notes)
    items = "".join(f"<li>{note}</li>" for note in marked)
    return f'<h2>What is thin here</h2><div class="card notes"><ul>{items}</ul></div>'
