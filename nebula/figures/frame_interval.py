"""A search every w frames (paper Sec. 7.4, Fig. 24): time, changes, Mbps, staleness."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from gaussians.errors import InputError
from gaussians.poses import HeadTrace
from lod_cloud import Cloud, TreeEncoder, make_search
from nebula.figures import machine
from nebula.figures.codecs import train_codecs
from nebula.figures.output import Figure
from nebula.figures.trees import Subject, choose_tree, motion_name, speed_m_s
from nebula.options import FigureOptions
from nebula.output import text_table
from nebula.progress import progress
from nebula.session_config import load_session_config

INTERVALS = tuple(2**n for n in range(7))  # 1 to 64 frames
FRAMES = 513  # eight intervals of 64 frames after the first search
TIMED = ("wheel", "temporal")
_EVERY_MESSAGE = (2**31, 2**31)  # messages and nodes that may be unacknowledged: no client answers
DIFFERENCE = (
    "The paper shows that bandwidth hardly depends on w, in a figure without numbers, for scenes "
    "that are not available here. Changes are a property of the way gone: a longer interval saves "
    "only what enters and leaves the cut within it, and the reuse window saves the rest."
)


def make(options: FigureOptions) -> Figure:
    """One row per interval."""
    frames = options.frames or FRAMES
    if frames <= 2 * INTERVALS[-1]:
        raise InputError(f"--frames must be above {2 * INTERVALS[-1]}, not {frames}")
    subject = choose_tree(options)
    motion = options.given.get("trace") or "walk"
    trace = subject.trace(motion, frames)
    codecs = train_codecs(subject.tree, subject.seed)
    encoders = {name: TreeEncoder(subject.tree, codec) for name, codec in codecs.items()}
    rows = []
    with progress("searching", len(INTERVALS)) as step, machine.one_thread():
        for every in INTERVALS:
            row: dict[str, Any] = {"trace": motion_name(motion), "search_every": every}
            row |= _searched(subject, trace, every)
            for name, encoder in encoders.items():
                row[f"mbps_{name}"] = _mbps(subject, trace, every, encoder)
            rows.append({**subject.labels, **row})
            step()
    about = machine.described()
    notes = {
        "scenes": [subject.description],
        "machine": about,
        "speed_m_s": speed_m_s(trace),
        "frames": frames,
        "definitions": {
            "stale_share_mean": "nodes of a cut that are not in the next one, of all its nodes",
            "cpu_ms": "CPU time of a search on one thread, mean; the first search is not counted",
            "mbps": "messages after the first, over the frames they serve",
        },
        "paper": {"reference": "Sec. 7.4, Fig. 24", "difference": DIFFERENCE},
    }
    title = f"Frame interval: {subject.title}, {motion_name(motion)} at {speed_m_s(trace):.2f} m/s"
    return Figure(
        title,
        notes,
        rows,
        lambda canvas: _draw(canvas, rows, list(codecs), machine.in_words(about)),
        _table(rows, list(codecs)),
    )


def _searched(subject: Subject, trace: HeadTrace, every: int) -> dict[str, Any]:
    """Time, changes and staleness of searches along the trace."""
    requests = [subject.request(trace, frame) for frame in range(0, len(trace), every)]
    seconds = (len(requests) - 1) * every / load_session_config().display_rate.hz
    row: dict[str, Any] = {"searches": len(requests) - 1}
    for method in TIMED:
        search = make_search(method, subject.hot)
        before = search.search(requests[0]).cut_size
        times_ms, adds, removes, stale = [], [], [], []
        for request in requests[1:]:
            begin = time.process_time()
            result = search.search(request)
            times_ms.append(1e3 * (time.process_time() - begin))
            adds.append(len(result.added))
            removes.append(len(result.removed))
            stale.append(removes[-1] / before)
            before = result.cut_size
        row[f"{method}_cpu_ms_mean"] = float(np.mean(times_ms))
        row[f"{method}_cpu_ms_per_s"] = float(np.sum(times_ms)) / seconds
    return {
        **row,
        "adds_mean": float(np.mean(adds)),
        "removes_mean": float(np.mean(removes)),
        "adds_per_s": float(np.sum(adds)) / seconds,
        "stale_share_mean": float(np.mean(stale)),
        "stale_share_max": float(np.max(stale)),
    }


def _mbps(subject: Subject, trace: HeadTrace, every: int, encoder: TreeEncoder) -> float:
    """Rate of the messages after the first."""
    config = load_session_config()
    cloud = Cloud(
        subject.tree,
        encoder,
        search=make_search("wheel", subject.hot),
        frames_per_search=every,
        reuse_window_frames=config.reuse_window.frames,
        unacknowledged=_EVERY_MESSAGE,
    )
    sizes = [
        len(cloud.search(subject.request(trace, frame), frame))
        for frame in range(0, len(trace), every)
    ]
    return 8e-6 * sum(sizes[1:]) * config.display_rate.hz / ((len(sizes) - 1) * every)


def _table(rows: Sequence[dict[str, Any]], codecs: Sequence[str]) -> str:
    heads = ["w", *(f"{method} ms" for method in TIMED), *(f"{m} ms/s" for m in TIMED)]
    heads += ["added", "removed", "stale", *(f"Mbps {codec}" for codec in codecs)]
    lines = [
        [
            str(row["search_every"]),
            *(f"{row[f'{method}_cpu_ms_mean']:.3f}" for method in TIMED),
            *(f"{row[f'{method}_cpu_ms_per_s']:.1f}" for method in TIMED),
            f"{row['adds_mean']:.0f}",
            f"{row['removes_mean']:.0f}",
            f"{row['stale_share_mean']:.3%}",
            *(f"{row[f'mbps_{codec}']:.3f}" for codec in codecs),
        ]
        for row in rows
    ]
    return text_table(heads, lines, range(len(heads)))


def _draw(canvas: Any, rows: Sequence[dict[str, Any]], codecs: Sequence[str], where: str) -> None:
    canvas.set_size_inches(12, 7)
    panels = canvas.subplots(2, 2)
    intervals = [row["search_every"] for row in rows]

    def plot(axes: Any, key: str, label: str, scale: float = 1.0) -> None:
        axes.plot(intervals, [scale * row[key] for row in rows], "o-", label=label)

    for method in TIMED:
        plot(panels[0, 0], f"{method}_cpu_ms_mean", method)
        plot(panels[0, 1], f"{method}_cpu_ms_per_s", method)
    for codec in codecs:
        plot(panels[1, 0], f"mbps_{codec}", f"codec {codec}")
    plot(panels[1, 1], "stale_share_mean", "mean", 100.0)
    plot(panels[1, 1], "stale_share_max", "largest", 100.0)
    labels = {
        (0, 0): "CPU ms per search",
        (0, 1): "CPU ms per second of motion",
        (1, 0): "stream, Mbps",
        (1, 1): "of the client's cut, stale at the\nnext search, %",
    }
    for place, label in labels.items():
        axes = panels[place]
        axes.set_xscale("log", base=2)
        axes.set_xticks(intervals, [str(w) for w in intervals])
        axes.set_xlabel("frames per search, w")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        axes.legend()
        if place != (1, 0):
            axes.set_yscale("log")
    panels[1, 0].set_ylim(bottom=0)
    canvas.text(0.01, 0.01, where, fontsize=8)
    canvas.get_layout_engine().set(rect=(0, 0.03, 1, 0.97))
