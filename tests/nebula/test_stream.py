"""`nebula stream` as a user runs it, on a small city."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from gaussians.cameras import Display
from gaussians.errors import InputError
from lod_cloud import Link
from nebula import build_tree, stream
from nebula.options import BuildTreeOptions, GeneratedCity, SceneOptions, StreamOptions
from nebula.stream_measurement import Faults, first_pictures

DISPLAY = Display.from_fov(400, 300, 96.0)
SCENE = SceneOptions(GeneratedCity(3000), None, None, 1.0, None, 0.2, DISPLAY, "flight")


def options(**changes: Any) -> StreamOptions:
    values: dict[str, Any] = {
        "tree": None,
        "scene": SCENE,
        "seed": 3,
        "frames": 120,
        "tau_px": 6.0,
        "search_every": 4,
        "method": "flat",
        "hysteresis": 0.02,
        "codec": "paper",
        "rate_mbps": 100.0,
        "latency_ms": 5.0,
        "paced": False,
        "loss": 0.0,
        "reorder": 0.0,
        "corruption": 0.0,
    }
    return StreamOptions(**(values | changes))


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trees") / "city"
    build_tree.run(BuildTreeOptions(SCENE, 3, out))
    return out


@pytest.fixture(scope="module")
def whole(tree: Path) -> dict[str, Any]:
    return stream.run(options(tree=tree)).data


def test_every_search_has_a_row_and_the_summary_adds_up(whole: dict[str, Any]) -> None:
    rows, summary = whole["rows"], whole["summary"]
    assert len(rows) == 30 and summary["searches"] == 29
    assert rows[0]["kind"] == "start" and summary["kinds"] == {
        "start": 1, "step": 29, "repair": 0, "probe": 0,
    }  # fmt: skip
    assert summary["payloads"] == sum(row["payloads"] for row in rows[1:]) > 0
    size = sum(row["message_bytes"] for row in rows[1:])
    assert summary["mbps"] == pytest.approx(size * 8e-6 / (29 * 4 / 90))
    assert summary["pending_max"] == summary["refused"] == summary["messages_lost"] == 0
    assert all(row["pending_error_px"] == 0 for row in rows)
    for row in rows:
        assert row["arrives_s"] >= row["asked_s"] + 0.015  # both latencies and the cloud's time


def test_the_compact_codec_needs_fewer_bytes_for_the_same_cuts(
    tree: Path, whole: dict[str, Any]
) -> None:
    rows = stream.run(options(tree=tree, codec="compact")).data["rows"]
    for key in ("kind", "cut_size", "added", "removed", "held"):
        assert [row[key] for row in rows] == [row[key] for row in whole["rows"]]
    sizes = [sum(row["message_bytes"] for row in found) for found in (rows, whole["rows"])]
    assert sizes[0] < 0.8 * sizes[1]


def test_without_a_tree_the_scene_is_built() -> None:
    data = stream.run(options(frames=8)).data
    assert data["nodes"] == 5999 and len(data["rows"]) == 2


def test_paced_messages_stay_within_the_link_and_end_at_the_same_cut(
    tree: Path, whole: dict[str, Any]
) -> None:
    paced = stream.run(options(tree=tree, paced=True, rate_mbps=2.0)).data
    budget = paced["budget_bytes"]
    assert budget == int(4 / 90 * 2e6 / 8)
    rows = paced["rows"]
    assert max(row["message_bytes"] for row in rows) <= budget < whole["rows"][0]["message_bytes"]
    assert rows[0]["pending"] > 0 and rows[0]["deferred_bytes"] > 0
    assert rows[0]["tau_px"] == 30.0 and rows[-1]["tau_px"] == 6.0
    pictures = [p for p in paced["summary"]["first_pictures"] if p["line_s"] is not None]
    assert [p["tau_px"] for p in pictures][:2] == [120.0, 60.0]
    assert all(a["line_s"] <= b["line_s"] for a, b in pairwise(pictures))


def test_paced_compact_messages_bring_harmonics_last(tree: Path) -> None:
    """While tau is raised nodes come without; those that stay get theirs, and the report counts."""
    paced = stream.run(options(tree=tree, paced=True, rate_mbps=2.0, codec="compact")).data
    rows, summary = paced["rows"], paced["summary"]
    assert max(row["message_bytes"] for row in rows) <= paced["budget_bytes"]
    assert rows[0]["plain"] == rows[0]["payloads"] == rows[0]["pending_harmonics"] > 0
    assert all(row["plain"] == 0 for row in rows if row["tau_px"] == 6.0)
    assert all(row["completed"] == 0 for row in rows if row["pending"])
    assert sum(row["completed"] for row in rows) > 0
    assert summary["pending_harmonics"] == rows[-1]["pending_harmonics"] == 0


def test_a_faulty_line_heals(tree: Path) -> None:
    faulty = stream.run(options(tree=tree, frames=400, loss=0.1, reorder=0.1, corruption=0.05))
    summary = faulty.data["summary"]
    assert summary["messages_lost"] and summary["reports_lost"] and summary["refused"]
    assert summary["kinds"]["repair"] > 0
    behind = [row["behind"] for row in faulty.data["rows"]]
    assert max(behind) <= 8 and behind.count(0) + behind.count(1) > len(behind) / 2
    again = stream.run(options(tree=tree, frames=400, loss=0.1, reorder=0.1, corruption=0.05))
    assert [row["behind"] for row in again.data["rows"]] == behind


def test_a_picture_is_complete_when_no_larger_error_is_pending() -> None:
    link = Link(rate_mbps=8.0)  # a byte per microsecond
    rows = [
        {"pending_error_px": error, "message_bytes": 1000, "payloads": 10, "asked_s": 1.0,
         "arrives_s": 1.0 + 0.01 * (i + 1), "tau_px": tau}
        for i, (error, tau) in enumerate(
            ((None, 30.0), (130.0, 30.0), (60.0, 30.0), (31.0, 30.0), (0.0, 30.0), (0.0, 6.0))
        )
    ]  # fmt: skip
    found = first_pictures(rows, link, 6.0, before_bytes=500)
    assert [p["messages"] for p in found] == [3, 3, 5, 6, 6]
    assert [p["bytes"] for p in found] == [3500, 3500, 5500, 6500, 6500]
    assert found[0]["line_s"] == pytest.approx(3.5e-3)
    assert found[0]["complete_s"] == pytest.approx(0.03 + 0.5e-3)
    assert first_pictures(rows[:1], link, 6.0)[0]["line_s"] is None


def test_what_is_wrong_is_said(tree: Path) -> None:
    with pytest.raises(InputError, match=r"share of loss must lie in 0\.\.1, not 1\.5"):
        Faults(loss=1.5)
    with pytest.raises(InputError, match=r"tree\.json"):
        stream.run(options(tree=tree / "nothing"))
    text = stream.run(replace(options(tree=tree), frames=8)).text
    assert "Mbps" in text and "complete at tau" in text
