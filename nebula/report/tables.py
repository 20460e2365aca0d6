"""Frame by frame, how the report came about, and the source of every number: the page's tables."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from nebula.report.blocks import card, pairs, plain, table
from nebula.report.charts import exact, scaled, significant, words


def frames(frames: Sequence[Mapping[str, Any]]) -> str:
    heads = [
        *("frame", "time s", "search", "message", "drawn splats", "visible left", "visible right"),
        *("mismatch", "cycles", "FPS", "bound by", "DRAM", "energy mJ"),
    ]
    rows = [
        [
            str(f["index"]),
            f"{f['time_s']:.3f}",
            "yes" if f["searched"] else "",
            scaled(f["message_bytes"], "B") if f["message_bytes"] else "",
            scaled(f["drawn_splats"], ""),
            scaled(f["visible_splats"]["left"], ""),
            scaled(f["visible_splats"]["right"], ""),
            exact(f["right_mismatching_pixels"]),
            scaled(f["cycles"], ""),
            significant(f["fps"]),
            words(f["bound_by"]),
            scaled(f["dram_bytes"], "B"),
            significant(f["energy_mj"]),
        ]
        for f in frames
    ]
    return f'<h2>Frames</h2><div class="card">{table(heads, rows)}</div>'


def provenance(report: Mapping[str, Any]) -> str:
    run, scene = report["provenance"], report["scene"]
    machine = run["machine"]
    how = [
        ("command", run["command"]),
        ("version", run["version"]),
        ("commit", run["commit"] or "–"),
        ("started", run["started_utc"]),
        ("wall time", f"{significant(run['wall_s'])} s"),
        *((f"– {name}", f"{significant(s)} s") for name, s in run["stage_wall_s"].items()),
        ("machine", f"{machine['processor']}, {machine['platform']}"),
        ("cores, threads", f"{machine['cores']}, {machine['threads']}"),
        ("packages", plain(machine["packages"])),
    ]
    what = [
        ("scene", f"{scene['name']} ({scene['origin']}), SH degree {scene['sh_degree']}"),
        ("bounds, m", f"{plain(scene['bounds_min_m'])} to {plain(scene['bounds_max_m'])}"),
        *((name, plain(value)) for name, value in run["placement"].items()),
        *((f"display {name}", plain(value)) for name, value in run["display"].items()),
        ("seed", str(run["seed"])),
        *((name, plain(value)) for name, value in run["options"].items()),
    ]
    inputs = [[i["name"], scaled(i["bytes"], "B"), i["sha256"]] for i in run["inputs"]]
    cards = card("Run", "how this report came about", pairs(how)) + card(
        "Placement and options", "what was asked for", pairs(what)
    )
    files = ""
    if inputs:
        listing = table(["file", "size", "SHA-256"], inputs, numbers=False)
        files = f'<div class="card" style="margin-top:16px">{listing}</div>'
    return f'<h2>Provenance</h2><div class="grid">{cards}</div>{files}'


def sources(sources: Sequence[Mapping[str, Any]]) -> str:
    lines = []
    for s in sources:
        mark = escape(s["confidence"])
        value = s["value"]
        lines.append(
            f'<tr><td class="name">{_breakable(s["name"])}</td>'
            f"<td>{escape(significant(value) if isinstance(value, float) else plain(value))}</td>"
            f"<td>{escape(s['unit'])}</td><td>{escape(s['source'])}</td>"
            f'<td class="long">{escape(s["reference"])}</td>'
            f'<td><span class="mark {mark}">{mark}</span></td></tr>'
        )
    heads = ("number", "value", "unit", "source", "reference", "confidence")
    head = "".join(f"<th>{name}</th>" for name in heads)
    return (
        '<h2>Source of every number</h2><div class="card">'
        '<p class="sub">A: read in the primary text. B: read in a secondary text. C: computed from '
        "such values. M: from memory or judgement, unverified.</p>"
        f'<div class="scroll"><table class="sources"><tr>{head}</tr>{"".join(lines)}</table>'
        "</div></div>"
    )


def _breakable(name: str) -> str:
    """A dotted name as HTML that may break after dots and underscores only."""
    return re.sub(r"([._])", r"\1<wbr>", escape(name))
