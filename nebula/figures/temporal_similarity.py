"""What cuts some frames apart have in common (paper Sec. 3.3, Fig. 7)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gaussians.errors import InputError
from gaussians.poses import HeadTrace
from lod_cloud import Cut, make_search, overlap
from nebula.figures.output import Figure
from nebula.figures.trees import Subject, choose_motions, choose_tree, motion_name, speed_m_s
from nebula.options import FigureOptions
from nebula.output import text_table
from nebula.progress import progress

GAPS = tuple(2**n for n in range(8))  # 1 to 128 frames
PLACES = 4  # along the trace, where a gap begins
FRAMES = 450  # 5 s
PAPER = {1: 0.99, 64: 0.95}  # at least, Sec. 3.3
DIFFERENCE = (
    "The paper averages over data sets that are not available here and does not say how the viewer "
    "moves. What is lost depends on the way gone, not on frames: standing, nearly nothing; at a "
    "walk, what the scene's density near the viewer makes of 1.5 cm per frame; in flight, tens of "
    "times that."
)


def make(options: FigureOptions) -> Figure:
    """One row per motion and gap."""
    subject = choose_tree(options)
    motions, missing = choose_motions(options, recorded=True)
    frames = options.frames or FRAMES
    if frames < GAPS[-1] + 1:
        raise InputError(f"--frames must be at least {GAPS[-1] + 1}, not {frames}")
    rows = []
    with progress("searching", len(motions)) as step:
        for motion in motions:
            trace = subject.trace(motion, frames)
            for row in _measure(subject, trace):
                rows.append({**subject.labels, "trace": motion_name(motion), **row})
            step()
    notes = {
        "scenes": [subject.description],
        "missing_traces": missing,
        "definition": "share of the later cut that was in the earlier one; mean over places",
        "paper": {
            "at_least": {str(gap): share for gap, share in PAPER.items()},
            "reference": "Sec. 3.3, Fig. 7",
            "difference": DIFFERENCE,
        },
    }
    return Figure(
        f"Temporal similarity of cuts: {subject.title}",
        notes,
        rows,
        lambda canvas: _draw(canvas, rows),
        _table(rows) + "".join(f"\nnot measured: {path} (no such file)" for path in missing),
    )


def _measure(subject: Subject, trace: HeadTrace) -> list[dict[str, Any]]:
    """One row per gap; cuts by a search that knows no history."""
    search = make_search("streaming", subject.hot)

    def cut(frame: int) -> Cut:
        result = search.search(subject.request(trace, frame))
        return Cut(result.cut, result.nodes_tested, result.bytes_touched)

    shares: dict[int, list[float]] = {gap: [] for gap in GAPS}
    metres: dict[int, list[float]] = {gap: [] for gap in GAPS}
    sizes = []
    for place in _places(len(trace)):
        first = cut(place)
        for gap in GAPS:
            later = cut(place + gap)
            sizes.append(len(later))
            shares[gap].append(overlap(first, later))
            way = trace.positions[place + gap] - trace.positions[place]
            metres[gap].append(float(np.linalg.norm(way)))
    return [
        {
            "gap_frames": gap,
            "overlap_mean": float(np.mean(shares[gap])),
            "overlap_min": min(shares[gap]),
            "paper_at_least": PAPER.get(gap),
            "displacement_m_mean": float(np.mean(metres[gap])),
            "places": len(shares[gap]),
            "cut_size_mean": float(np.mean(sizes)),
            "speed_m_s": speed_m_s(trace),
        }
        for gap in GAPS
    ]


def _places(frames: int) -> list[int]:
    """Evenly spread frames at which every gap still fits; fewer where they would coincide."""
    return np.unique(np.linspace(0, frames - 1 - GAPS[-1], PLACES).astype(int)).tolist()


def _table(rows: Sequence[dict[str, Any]]) -> str:
    heads = ["trace", "m/s", *(f"gap {gap}" for gap in GAPS)]
    lines = []
    for trace in dict.fromkeys(row["trace"] for row in rows):
        own = [row for row in rows if row["trace"] == trace]
        shares = [f"{row['overlap_mean']:.3%}" for row in own]
        lines.append([trace, f"{own[0]['speed_m_s']:.2f}", *shares])
    paper = [f"> {PAPER[gap]:.0%}" if gap in PAPER else "" for gap in GAPS]
    return text_table(heads, [*lines, ["paper", "", *paper]], range(1, len(heads)))


def _draw(canvas: Any, rows: Sequence[dict[str, Any]]) -> None:
    canvas.set_size_inches(11, 5)
    whole, lost = canvas.subplots(1, 2)
    for trace in dict.fromkeys(row["trace"] for row in rows):
        own = [row for row in rows if row["trace"] == trace]
        gaps = [row["gap_frames"] for row in own]
        label = f"{trace}, {own[0]['speed_m_s']:.2f} m/s"
        whole.plot(gaps, [100 * row["overlap_mean"] for row in own], "o-", label=label)
        lost.plot(gaps, [100 * (1 - row["overlap_mean"]) for row in own], "o-")
    for axes, sign in ((whole, 1), (lost, -1)):
        shown = [100 * (share if sign > 0 else 1 - share) for share in PAPER.values()]
        axes.plot(list(PAPER), shown, "kx", markersize=9, label="paper: better than this")
        axes.set_xscale("log", base=2)
        axes.set_xticks(GAPS, [str(gap) for gap in GAPS])
        axes.set_xlabel("frames between the cuts (90 Hz)")
        axes.grid(alpha=0.3)
    whole.set_ylabel("share of the cut that was there before, %")
    lost.set_ylabel("share of the cut that is new, %")
    lost.set_yscale("log")
    canvas.legend(*whole.get_legend_handles_labels(), loc="outside lower center", ncols=3)
