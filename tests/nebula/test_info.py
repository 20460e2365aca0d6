"""``nebula info``: figures that can be counted by hand; what it says of real scenes and trees."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gaussians.formats import write_ply
from gaussians.placement import parse_view
from gaussians.scene import Scene
from nebula.info import run
from nebula.options import InfoOptions, scene_options
from nebula.program import main
from tests.gaussians.real_data import data_file
from tests.gaussians.test_transforms import random_scene


def info(path: Path, **given) -> dict:
    return run(InfoOptions(scene_options(None, {"scene": str(path), **given}), 0)).data


def line_scene() -> Scene:
    """1 000 Gaussians along x, 1 mm apart, degree 1; the oddities are at known places."""
    count = 1000
    means = np.zeros((count, 3), np.float32)
    means[:, 0] = 0.001 * np.arange(count)
    scales = np.full((count, 3), 0.01, np.float32)
    opacities = np.full(count, 0.55, np.float32)
    sh = np.zeros((count, 4, 3), np.float32)
    means[0], means[1] = (50, 0, 0), (-9, 0, 0)  # outliers
    scales[2] = (0.01, 0.01, 0.00009)  # 111
    scales[3] = (0.01, 0.01, 0.9e-6)  # 11 111
    scales[4:7, 0] = 0
    scales[7] = 0
    opacities[10:13] = (0.0, 0.003, 1.0)
    sh[20, 2, 1] = sh[21, 2, 1] = sh[21, 1, 0] = 0.5
    return Scene(means, np.tile(np.float32([1, 0, 0, 0]), (count, 1)), scales, opacities, sh)


@pytest.fixture(scope="module")
def line(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("line") / "line.ply"
    write_ply(line_scene(), path)
    return path


def test_figures_that_can_be_counted(line: Path) -> None:
    data = info(line, up="+z")
    assert (data["splats"], data["sh_degree"], data["up"]) == (1000, 1, "+z")
    assert data["sh_nonzero"] == {"coefficients": 3 / 9000, "splats": 2 / 1000}
    assert data["oddities"] == {
        "outliers": 2,
        "needles_100": 2,
        "needles_10000": 1,
        "some_scale_zero": 4,
        "all_scales_zero": 1,
    }
    opacity = data["opacity_histogram"]
    assert opacity["counts"] == [2, 0, 0, 0, 0, 997, 0, 0, 0, 1]
    assert (opacity["above_one"], opacity["never_drawn"]) == (0, 2)
    assert data["scale_histogram"]["zero"] == 1
    assert sum(data["scale_histogram"]["counts"]) == 999
    assert data["memory_bytes"] == {
        "record": 92,  # 3 + 4 + 3 + 1 + 12 numbers
        "scene": 92 * 1000,
        "tree": (92 + 24) * 1999,
    }
    assert np.allclose(np.array(data["position_m"])[:, 0], [-9, 0.01099, 0.5005, 0.99001, 50])


def test_scale_bins_have_equal_ratios(tmp_path: Path) -> None:
    scene = random_scene(np.random.default_rng(0), 500, 0)
    write_ply(scene, tmp_path / "a.ply")
    histogram = info(tmp_path / "a.ply")["scale_histogram"]
    edges, largest = np.array(histogram["edges_m"]), scene.scales.max(axis=1)
    assert len(edges) == 11 and np.allclose(
        np.diff(np.log(edges)), np.log(edges[-1] / edges[0]) / 10
    )
    assert np.allclose(edges[[0, -1]], [largest.min(), largest.max()], rtol=1e-6)
    assert sum(histogram["counts"]) == 500 and histogram["zero"] == 0


def test_the_suggested_view_is_in_file_units_and_the_near_plane_in_metres(tmp_path: Path) -> None:
    scene = random_scene(np.random.default_rng(1), 300, 0)
    write_ply(scene, tmp_path / "a.ply")
    for units in (1.0, 100.0):
        suggested = info(tmp_path / "a.ply", units_per_metre=units)["suggested"]
        eye, target = (np.array(p) for p in parse_view(suggested["view"]))
        distance = np.linalg.norm(eye - target)
        assert 1.5 < distance < 10  # the ball of radius 1 is framed
        low, high = np.percentile(scene.means, (1, 99), axis=0)
        assert np.abs(target - (low + high) / 2).max() < 1e-3 * distance
        expected = min(0.2, distance / units / 50)
        assert suggested["near_m"] == pytest.approx(expected, rel=2e-3)
    big = info(tmp_path / "a.ply", units_per_metre=0.01)["suggested"]
    assert big["near_m"] == 0.2


def test_a_single_gaussian_has_a_report(tmp_path: Path) -> None:
    write_ply(line_scene().take(np.array([5])), tmp_path / "one.ply")
    data = info(tmp_path / "one.ply")
    assert data["splats"] == 1 and sum(data["scale_histogram"]["counts"]) == 1
    assert data["oddities"]["outliers"] == 0


def run_main(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(["info", *arguments])
    return int(end.value.code or 0)


def test_a_file_may_be_named_by_position_or_option_not_both(line: Path, capsys) -> None:
    assert run_main(str(line), "--json", "-") == 0
    by_position = json.loads(capsys.readouterr().out)
    assert run_main("--scene", str(line), "--json", "-") == 0
    assert json.loads(capsys.readouterr().out) == by_position
    assert run_main(str(line), "--scene", str(line)) == 2
    assert "FILE and --scene name the same thing" in capsys.readouterr().err
    assert run_main(str(line), "--city", "1000") == 2
    assert "exclude each other" in capsys.readouterr().err


def test_the_text_has_bars_and_the_suggestion(line: Path, capsys) -> None:
    assert run_main(str(line), "--up", "+z") == 0
    text = capsys.readouterr().out
    assert f"0.5 .. 0.6            997  {'#' * 40}\n" in text
    assert "0.9 .. 1                1  #\n" in text
    assert "0.1 .. 0.2              0\n" in text
    assert "outliers: 2 means outside 10 times the 1-99 % box" in text
    assert " --near " in text and "4 without thickness, 1 points" in text


def test_a_tree_directory_is_described(tmp_path: Path, capsys) -> None:
    with pytest.raises(SystemExit):
        main(["build-tree", "--city", "1000", "--out", str(tmp_path / "tree")])
    data = info(tmp_path / "tree")
    assert (data["leaves"], data["nodes"], data["nesting_violations"]) == (1000, 1999, 0)
    assert data["fan_out"] == {"0": 1000, "2": 999}
    assert data["fan_out_max"] == 2 and data["interior"] == "merged"
    assert sum(data["level_nodes"]) == 1999 and sum(data["level_leaves"]) == 1000
    sizes = data["level_median_extent_m"]
    assert len(data["level_nodes"]) == len(sizes) == data["levels"] and sizes[0] == max(sizes)
    assert 0 < data["opacities_above_one"] == round(999 * data["opacities_above_one_share"]) < 999
    files = list((tmp_path / "tree").iterdir())
    assert data["bytes_on_disk"] == sum(f.stat().st_size for f in files)
    capsys.readouterr()
    assert run_main(str(tmp_path / "tree")) == 0
    text = capsys.readouterr().out
    assert "nesting: 0 violations on 1998 edges" in text
    assert "interior nodes: merged from their children" in text
    assert f"      0           1           0  {sizes[0]:.4g}\n" in text
    assert run_main(str(tmp_path / "tree"), "--up", "-y") == 2
    assert "a tree knows its up axis and units" in capsys.readouterr().err


@pytest.mark.real_data
def test_real_scenes_are_described() -> None:
    statue = info(data_file("scenes/st_peter/st-peter.sog"))
    assert statue["splats"] == 133_618 and statue["sh_nonzero"]["coefficients"] == 0
    assert statue["oddities"]["needles_100"] > 10_000
    train = info(data_file("scenes/train_1000/train-1000.ply"))
    assert train["sh_degree"] == 3 and train["sh_nonzero"]["splats"] == 0.961
    assert sum(train["opacity_histogram"]["counts"]) == 1000


def test_a_single_point_has_no_view_to_suggest(tmp_path):
    point = line_scene().take(np.array([7]))  # without thickness
    write_ply(point, tmp_path / "point.ply")
    options = InfoOptions(scene_options(None, {"scene": str(tmp_path / "point.ply")}), 0)
    result = run(options)
    assert result.data["view"] is None and result.data["suggested"] is None
    assert "no extent to frame" in result.text
