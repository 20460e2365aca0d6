"""Figures of searches and streams, on small trees: what their numbers mean."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gaussians.errors import InputError
from gaussians.parallel import threads
from lod_cloud import Cloud, flat_search, load_tree, make_search
from nebula import figure
from nebula.figures import gpu_time, trees
from nebula.figures.codecs import train_codecs
from nebula.figures.gpu_time import PLANS, VARIANTS, GpuWork, load_gpu, time_us
from nebula.figures.memory_by_stage import tree_bytes
from nebula.figures.trees import choose_motions, choose_tree
from nebula.search import METHODS
from tests.nebula.small_trees import figure_options, small_street

FRAMES = {
    "lod-search": 60,
    "temporal-similarity": 140,
    "frame-interval": 130,
    "memory-by-stage": 9,
}


@pytest.fixture(scope="module")
def tree(tmp_path_factory: Any) -> Path:
    return small_street(tmp_path_factory.mktemp("trees") / "small_street")


@pytest.fixture(scope="module")
def made(tree: Path, tmp_path_factory: Any) -> Any:
    """What a figure of the small tree returned, each made once; and where it was written."""
    out, done = tmp_path_factory.mktemp("figure"), {}

    def make(name: str) -> tuple[Path, dict[str, Any]]:
        if name not in done:
            asked = figure_options(name, out, tree, frames=FRAMES[name])
            done[name] = figure.run(asked).data
        return out, done[name]

    return make


@pytest.mark.parametrize("name", FRAMES)
def test_a_figure_is_three_files_and_every_row_names_its_tree(made, tree, name):
    out, data = made(name)
    written = json.loads((out / f"{name}.json").read_text())
    assert len(written["rows"]) == len(data["rows"]) > 0
    assert len(list(csv.DictReader((out / f"{name}.csv").read_text().splitlines()))) == len(
        data["rows"]
    )
    picture = np.asarray(Image.open(out / f"{name}.png"))
    assert picture.shape[0] > 300 and picture.shape[1] > 600 and picture.std() > 10
    for row in data["rows"]:
        assert row["scene"] == "small_street" and row["source"] == f"tree: {tree}"
        assert row["display"].startswith("96 x 64 px, f 48.0") and row["tau_px"] == 6.0
    assert "small_street, τ = 6 px" in data["title"]
    (scene,) = data["scenes"]
    assert scene["leaves"] == load_tree(tree).leaves


# ---------------------------------------------------------------- the tree


def test_a_tree_brings_its_own_scene(tree, tmp_path):
    for given, flag in (({"city_leaves": 1500}, "--city-leaves"), ({"up": "+z"}, "--up")):
        asked = figure_options("lod-search", tmp_path, tree, given=given)
        with pytest.raises(InputError, match=f"--tree brings its own scene; {flag}: not of use"):
            choose_tree(asked)
    with pytest.raises(InputError, match="--config: not of use"):
        choose_tree(figure_options("lod-search", tmp_path, tree, config="playbot"))


def test_without_a_scene_a_dense_city_is_searched(tmp_path, monkeypatch):
    monkeypatch.setattr(trees, "LEAVES", 2000)
    subject = choose_tree(figure_options("lod-search", tmp_path, None, tau_px=3.0))
    assert subject.title == "dense city of 2000, τ = 3 px" and subject.tree.leaves == 2000
    city = choose_tree(figure_options("x", tmp_path, None, given={"city_leaves": 1500}))
    assert city.name == "city of 1500" and city.source.startswith("generated: city of 1500 leaves")
    assert subject.request(subject.trace("walk", 3), 0).position == tuple(
        float(np.float32(c)) for c in subject.view.position
    )


def test_recordings_that_are_not_here_are_said_to_be_missing(tree, tmp_path, monkeypatch):
    monkeypatch.setenv("NEBULA_DATA", str(tmp_path))
    asked = figure_options("temporal-similarity", tmp_path, tree)
    motions, missing = choose_motions(asked, recorded=True)
    assert motions == ("stand", "walk", "flight") and missing == [
        str(tmp_path / "traces/eyenavgs/user113_alameda.csv")
    ]
    walk = figure_options("temporal-similarity", tmp_path, tree, given={"trace": "walk"})
    assert choose_motions(walk, recorded=True) == (("walk",), [])


@pytest.mark.parametrize(
    ("name", "frames", "least"),
    [
        ("lod-search", 40, "above 40"),
        ("temporal-similarity", 128, "at least 129"),
        ("frame-interval", 128, "above 128"),
    ],
)
def test_too_few_frames_are_refused(tree, tmp_path, name, frames, least):
    asked = figure_options(name, tmp_path / "out", tree, frames=frames)
    with pytest.raises(InputError, match=f"--frames must be {least}"):
        figure.run(asked)


# ---------------------------------------------------------------- lod-search


def test_all_methods_are_compared_on_one_thread(made):
    before = threads()
    _, data = made("lod-search")
    rows = {row["method"]: row for row in data["rows"]}
    assert list(rows) == [*METHODS, *VARIANTS] and threads() == before
    for name, row in rows.items():
        if name in VARIANTS:
            assert row["cpu_p50_ms"] is None and row["cpu_speedup_over_octree_gs"] is None
        else:
            assert row["threads"] == 1 and row["cpu_p50_ms"] > 0 and row["searches"] == 5
        exact = not name.startswith(("octree_gs", "city_gaussian"))
        assert row["identical_to_flat"] == (5 if exact else None)
        assert row["gpu_fast_us"] < row["gpu_us"] < row["gpu_slow_us"]
    assert rows["flat"]["nodes_tested_mean"] == data["scenes"][0]["nodes"]
    assert rows["flat"]["gpu_speedup_over_flat"] == rows["flat"]["cpu_speedup_over_flat"] == 1
    assert rows["temporal"]["paper_speedup_up_to"] == data["paper"]["speedup_up_to"] == 52.7
    assert rows["wheel"]["nodes_tested_mean"] < 0.1 * rows["temporal"]["nodes_tested_mean"]
    assert data["machine"]["processor"] and len(data["machine"]["load_average"]) == 3
    assert {"memory", "gather", "launch"} <= {c["path"] for c in data["gpu"]["constants"]}


# ---------------------------------------------------------------- the GPU model


def test_gpu_time_by_hand():
    gpu = load_gpu()
    stream_us = 2.039e9 / (2039e3 * 0.85)
    assert time_us(GpuWork(2.039e9, launches=0), gpu) == pytest.approx(stream_us)
    assert time_us(GpuWork(2.039e9, launches=0), gpu, "fast") == pytest.approx(1000)
    gather = GpuWork(0, launches=3, sectors=1e6, steps=10)
    by_hand = 32e6 / (2039e3 * 0.5) + 3 * 2.5 + 10 * 466 / 1410
    assert time_us(gather, gpu) == pytest.approx(by_hand)
    arithmetic_us = 1e9 * 24 / (6912 * 1410)
    assert time_us(GpuWork(1, launches=0, tests=1e9), gpu) == pytest.approx(arithmetic_us)
    both = time_us(GpuWork(2.039e9, launches=0, tests=1e8), gpu)
    assert both == pytest.approx(stream_us), "memory and arithmetic overlap"


def test_plans_charge_what_was_counted():
    gpu = load_gpu()
    row = {
        "nodes_tested_mean": 1000,
        "bytes_touched_mean": 32 * 1000 + 36 * 50,
        "adds_mean": 6,
        "removes_mean": 4,
        "cut_size_mean": 700,
    }
    work = {m: gpu_time.plan_work(m, row, 5000, 12, gpu) for m in PLANS}
    assert work["flat"].streamed_bytes == row["bytes_touched_mean"] + 40
    assert work["temporal"].streamed_bytes == 36 * 50 + 40 and work["temporal"].sectors == 1000
    in_order = work[gpu_time.SUBTREE_ORDER]
    assert in_order.streamed_bytes == row["bytes_touched_mean"] + 40 and in_order.sectors == 0
    assert work["temporal"].tests == 1050 and work["depth_first"].steps == 1000
    assert work["streaming"].steps == 24 and work["wheel"].sectors == 4000
    assert work[gpu_time.TENSOR_PASSES].streamed_bytes == 150 * 5000 + 8 * 700
    assert work[gpu_time.TENSOR_PASSES].launches == 14


# ---------------------------------------------------------------- temporal similarity


def test_similarity_is_that_of_flat_searches(made, tree, tmp_path):
    _, data = made("temporal-similarity")
    rows = {(row["trace"], row["gap_frames"]): row for row in data["rows"]}
    subject = choose_tree(figure_options("temporal-similarity", tmp_path, tree))
    trace = subject.trace("flight", FRAMES["temporal-similarity"])
    shares = []
    for place in (0, 3, 7, 11):  # 140 frames leave room for these
        cuts = [
            set(flat_search(subject.tree, subject.request(trace, f)).node_ids.tolist())
            for f in (place, place + 32)
        ]
        shares.append(len(cuts[0] & cuts[1]) / len(cuts[1]))
    assert rows["flight", 32]["places"] == 4
    assert rows["flight", 32]["overlap_mean"] == pytest.approx(np.mean(shares))
    assert rows["flight", 32]["overlap_min"] == pytest.approx(min(shares)) and min(shares) < 1
    assert rows["walk", 1]["overlap_mean"] >= rows["walk", 128]["overlap_mean"]
    assert rows["walk", 1]["paper_at_least"] == 0.99 and rows["walk", 2]["paper_at_least"] is None
    assert rows["walk", 128]["displacement_m_mean"] == pytest.approx(1.4 * 128 / 90, rel=0.1)


# ---------------------------------------------------------------- frame interval


def test_the_rate_is_that_of_all_messages_but_the_first(made, tree, tmp_path):
    _, data = made("frame-interval")
    subject = choose_tree(figure_options("frame-interval", tmp_path, tree))
    trace = subject.trace("walk", FRAMES["frame-interval"])
    for name, codec in train_codecs(subject.tree, subject.seed).items():
        search = make_search("streaming", subject.hot)
        cloud = Cloud(subject.tree, codec, search=search, frames_per_search=32)
        sizes = [len(cloud.search(subject.request(trace, f), f)) for f in range(0, 130, 32)]
        (row,) = (row for row in data["rows"] if row["search_every"] == 32)
        assert row[f"mbps_{name}"] == pytest.approx(sum(sizes[1:]) * 8 / (128 / 90) / 1e6)
        assert sizes[0] > sizes[1]


def test_stale_nodes_are_those_the_next_cut_lacks(made, tree, tmp_path):
    _, data = made("frame-interval")
    subject = choose_tree(figure_options("frame-interval", tmp_path, tree))
    trace = subject.trace("walk", FRAMES["frame-interval"])
    cuts = [
        set(flat_search(subject.tree, subject.request(trace, f)).node_ids.tolist())
        for f in (0, 64, 128)
    ]
    stale = [len(cuts[i] - cuts[i + 1]) / len(cuts[i]) for i in (0, 1)]
    row = data["rows"][-1]
    assert row["stale_share_mean"] == pytest.approx(np.mean(stale)) and row["search_every"] == 64
    assert row["stale_share_max"] == pytest.approx(max(stale)) and min(stale) > 0


def test_fewer_searches_change_more_each(made):
    _, data = made("frame-interval")
    rows = {row["search_every"]: row for row in data["rows"]}
    assert list(rows) == [1, 2, 4, 8, 16, 32, 64]
    assert [rows[w]["searches"] for w in (1, 4, 64)] == [129, 32, 2]
    assert rows[64]["adds_mean"] > rows[1]["adds_mean"]
    assert rows[64]["stale_share_mean"] > rows[1]["stale_share_mean"] > 0
    for row in rows.values():
        seconds = row["searches"] * row["search_every"] / 90
        assert row["adds_per_s"] == pytest.approx(row["adds_mean"] * row["searches"] / seconds)
        per_s = row["wheel_cpu_ms_mean"] * row["searches"] / seconds
        assert row["wheel_cpu_ms_per_s"] == pytest.approx(per_s)
        assert row["mbps_paper"] > 0 and row["stale_share_max"] >= row["stale_share_mean"]


# ---------------------------------------------------------------- memory by stage


def test_memory_of_every_stage(made, tree):
    _, data = made("memory-by-stage")
    rows = {row["stage"]: row for row in data["rows"]}
    assert list(rows) == ["LoD search", "projection", "sorting", "rasterisation"]
    loaded = load_tree(tree)
    per_node = 4 * (5 + 3 + 4 + 3 + 1 + 12)  # topology, test, Gaussian with 12 coefficients
    assert tree_bytes(loaded) == per_node * len(loaded)
    search = rows["LoD search"]
    assert search["held_bytes_local"] == per_node * len(loaded)
    assert search["gaussians_local"] == len(loaded) and data["cut_size"] <= len(loaded)
    assert data["cut_size"] <= search["gaussians_split"] == data["client"]["held"]
    involved = [row["gaussians_local"] for row in rows.values()]
    assert involved == sorted(involved, reverse=True) and involved[-1] > 0
    for name, row in rows.items():
        if name != "LoD search":
            assert row["held_bytes_local"] == row["held_bytes_split"] > 0
            assert row["moved_bytes_local"] == row["moved_bytes_split"]
    assert rows["rasterisation"]["held_bytes_split"] == 2 * 16 * 96 * 64
    held = data["client"]
    assert search["held_bytes_split"] == held["table_bytes"] + held["held"] * (
        41 + held["record_bytes"]
    )
