"""`nebula search` as a user runs it, on a small city."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gaussians.cameras import Display
from gaussians.errors import InputError
from lod_cloud.search import SEARCHES
from nebula import build_tree, cli_options, search
from nebula.options import (
    BuildTreeOptions,
    GeneratedCity,
    SceneOptions,
    SearchOptions,
)
from nebula.program import main

DISPLAY = Display.from_fov(80, 64, 96.0)
SCENE = SceneOptions(GeneratedCity(2000), None, None, 1.0, None, 0.2, DISPLAY, "walk")


@pytest.fixture(scope="module")
def options(tmp_path_factory: pytest.TempPathFactory) -> SearchOptions:
    out = tmp_path_factory.mktemp("trees") / "city"
    build_tree.run(BuildTreeOptions(SCENE, 3, out))
    return SearchOptions(
        out, SCENE, frames=121, tau_px=6.0, search_every=4, seed=0, method="auto", compare=False,
        hysteresis=0.0,
    )  # fmt: skip


def test_the_names_are_those_of_the_searches() -> None:
    assert tuple(cli_options.SEARCH_METHODS.choices) == search.METHODS


def test_all_methods_are_compared(options: SearchOptions) -> None:
    result = search.run(replace(options, compare=True))
    rows: dict[str, Any] = {row["method"]: row for row in result.data["rows"]}
    assert tuple(rows) == search.METHODS
    for name, row in rows.items():
        assert row["searches"] == 31 - 10
        assert 0 < row["p50_ms"] <= row["p99_ms"] <= row["max_ms"]
        assert 0 < row["cpu_p50_ms"] <= row["cpu_max_ms"] and row["cpu_first_ms"] > 0
        assert set(row["overlap"]) == {"4", "8", "16", "32", "64"}
        assert all(0 < share <= 1 for share in row["overlap"].values())
        assert row["identical_to_flat"] == (row["searches"] if name in SEARCHES else None)
        assert name in result.text
    flat = rows["flat"]
    for name in SEARCHES:
        for key in ("adds_mean", "removes_mean", "cut_size_mean", "overlap"):
            assert rows[name][key] == flat[key]
    assert flat["nodes_tested_mean"] == 3999
    assert rows["wheel"]["nodes_tested_mean"] < 0.1 * rows["temporal"]["nodes_tested_mean"]
    assert rows["octree_gs"]["cut_size_mean"] > flat["cut_size_mean"]
    assert flat["adds_mean"] > 0


def test_enough_searches_by_default(options: SearchOptions) -> None:
    row = search.run(replace(options, frames=None, method="wheel")).data["rows"][0]
    assert row["method"] == "wheel" and row["searches"] == row["identical_to_flat"] == 450


def test_a_teleport_and_hysteresis_change_no_cut_between_methods(options: SearchOptions) -> None:
    jump = replace(options.scene, trace="teleport")
    result = search.run(replace(options, scene=jump, compare=True, hysteresis=0.02))
    for row in result.data["rows"]:
        assert row["identical_to_flat"] in (None, row["searches"])


def test_another_view_finds_another_cut(options: SearchOptions) -> None:
    far = replace(options, scene=replace(options.scene, view="0,0,500:0,10,0"))
    sizes = [search.run(o).data["rows"][0]["cut_size_mean"] for o in (options, far)]
    assert sizes[1] < sizes[0]


def test_a_trace_too_short_to_count_anything_is_refused(options: SearchOptions) -> None:
    with pytest.raises(InputError, match="--frames must be at least 41: the first 10 searches"):
        search.run(replace(options, frames=40))
    assert search.run(replace(options, frames=41)).data["rows"][0]["searches"] == 1


def test_a_directory_that_is_no_tree_is_refused(options: SearchOptions, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"tree\.json: cannot be read"):
        search.run(replace(options, tree=tmp_path))


def test_the_command_line_reaches_the_options(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[SearchOptions] = []

    def note(options: SearchOptions) -> None:
        seen.append(options)
        raise InputError("seen")

    monkeypatch.setattr(search, "run", note)
    line = "search --tree t --every 2 --method wheel --compare --hysteresis 0.02 --tau 15"
    with pytest.raises(SystemExit):
        main(line.split())
    assert seen[0].search_every == 2 and seen[0].method == "wheel" and seen[0].compare
    assert math.isclose(seen[0].hysteresis, 0.02) and seen[0].frames is None


@pytest.mark.parametrize("method", ["octree_gs", "city_gaussian", "depth_first"])
def test_one_method_alone(options: SearchOptions, method: str) -> None:
    rows = search.run(replace(options, method=method)).data["rows"]
    assert [row["method"] for row in rows] == [method]
