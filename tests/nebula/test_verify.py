"""``nebula verify`` as a user runs it: rows, causes, files, and what it refuses."""

from __future__ import annotations

import csv
import io
import json
import re
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from gaussians.cameras import Display, StereoRig
from gaussians.poses import GENERATED_RATE_HZ
from gaussians.quality import differing, mismatching_pixels
from gaussians.render import StereoRenderer, render_stereo
from gaussians.stereo_causes import CAUSE_NAMES, LADDER
from gaussians.stereo_method import PRESETS
from gaussians.synthetic import HOSTILE, generate_city
from nebula.cli import cli
from nebula.program import main
from nebula.scene_input import head_trace

CITY = ("--city-leaves", "1500", "--width", "64", "--height", "48")
DISPLAY = Display.from_fov(64, 48, 96.0)
KEYS = {
    *("method", "description", "mismatching_pixels", "mismatching_pixels_8bit", "pixels"),
    *("psnr_db", "max_abs", "mean_abs", "ssim", "flip", "inserted", "forward_only"),
    *("entries_after_termination", "row_writes_per_entry", "processed_left", "processed_right"),
    *("alpha_checks", "duplicates", "causes", "covered_pixels_share"),
}
SCENES = (
    *("near_objects", "thin_between_columns", "wall_hides_the_right_view", "depth_ties"),
    *("smaller_than_a_tile", "baseline_zero", "view_dependent_colour", "tilted_close"),
    *("off_axis", "off_axis_inwards"),
)
BASELINES = [f"independent {kind}" for kind in ("square_3sigma", "obb", "ellipse")]
Result = tuple[dict[str, Any], Path]


def verified(out: Path, *arguments: str) -> Result:
    """What ``--json`` holds, and where the files are."""
    target = out.parent / f"{out.name}.json"
    line = ["verify", *arguments, "--out", str(out), "--json", str(target)]
    done = CliRunner().invoke(cli, line, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    data = json.loads(target.read_text())
    assert data == json.loads((out / "verify.json").read_text())
    for row in data["rows"]:
        assert row["method"] in done.output
    return data, out


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("verify")


@pytest.fixture(scope="module")
def ladder(folder: Path) -> Result:
    return verified(folder / "ladder", *CITY, "--ladder")


@pytest.fixture(scope="module")
def isolate(folder: Path) -> Result:
    return verified(folder / "isolate", *CITY, "--isolate")


@pytest.fixture(scope="module")
def default(folder: Path) -> Result:
    return verified(folder / "default", *CITY)


@pytest.fixture(scope="module")
def hostile(folder: Path) -> Result:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nebula.verify.HOSTILE", {name: HOSTILE[name] for name in SCENES})
        return verified(folder / "hostile", "--hostile")


def assert_sound(row: dict[str, Any]) -> None:
    """Keys, and numbers that follow from one another."""
    assert row.keys() >= KEYS
    assert row["description"].startswith(row["method"] + ": ")
    wrong, wrong_8bit = row["mismatching_pixels"], row["mismatching_pixels_8bit"]
    assert 0 <= wrong_8bit <= wrong <= row["pixels"]
    assert sum(cause["pixels"] for cause in row["causes"].values()) == wrong
    assert sum(cause["pixels_8bit"] for cause in row["causes"].values()) == wrong_8bit
    for cause in row["causes"].values():
        assert max(cause["necessary"], cause["sufficient"], cause["runner_up"]) <= wrong
        assert 0 <= cause["pixels_8bit"] <= cause["pixels"]
    assert (wrong == 0) == (row["max_abs"] == 0 and row["psnr_db"] is None and not wrong)
    assert row["row_writes_per_entry"] == pytest.approx(
        row["inserted"] / row["left_entries"] if row["left_entries"] else 0
    )
    assert row["processed_left"] <= row["left_entries"]
    assert row["processed_right"] <= row["right_entries"]
    assert 0 <= row["covered_pixels_share"] <= 1


def assert_exact(row: dict[str, Any]) -> None:
    assert row["mismatching_pixels"] == row["max_abs"] == row["mean_abs"] == 0
    assert row["psnr_db"] is None
    assert row["duplicates"] == row["dropped"] == row["unseen"] == 0
    assert row["rows"] == 4 and row["inserted"] == row["right_entries"]
    assert not any(cause["pixels"] for cause in row["causes"].values())


def assert_csv_agrees(data: dict[str, Any], out: Path) -> None:
    """A line per row and baseline, a column per key, and two per cause."""
    rows = [*data["rows"], *data["baselines"]]
    lines = list(csv.DictReader(io.StringIO((out / "verify.csv").read_text())))
    assert len(lines) == len(rows)
    for line, row in zip(lines, rows, strict=True):
        for key, value in row.items():
            if key != "causes":
                assert line.pop(key) == ("" if value is None else str(value)), key
        causes = {
            f"{name}_{unit}": str(cause[unit])
            for name, cause in row["causes"].items()
            for unit in ("pixels", "pixels_8bit")
        }
        assert line.items() >= causes.items()
        assert {value for key, value in line.items() if key not in causes} <= {"0"}


def test_the_ladder_runs_from_paper_to_exact(ladder: Result) -> None:
    data, _ = ladder
    rungs = [f"paper+{cause}" for cause in LADDER[:-1]]
    assert [row["method"] for row in data["rows"]] == ["paper", *rungs, "paper+ellipse", "exact"]
    assert [row["method"] for row in data["baselines"]] == BASELINES
    for row in (*data["rows"], *data["baselines"]):
        assert_sound(row)
    assert data["rows"][0]["mismatching_pixels"] > 1000
    assert_exact(data["rows"][-1])
    present = [len(row["causes"].keys() - {"interaction"}) for row in data["rows"]]
    assert present == [10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 1, 0]


def test_isolated_defects_stand_one_by_one(isolate: Result) -> None:
    data, _ = isolate
    single = [f"exact-{cause}" for cause in CAUSE_NAMES]
    assert [row["method"] for row in data["rows"]] == ["paper", *single, "exact"]
    for row, cause in zip(data["rows"][1:-1], CAUSE_NAMES, strict=True):
        assert_sound(row)
        assert cause in row["causes"]
        if len(row["causes"]) == 1:
            count = row["causes"][cause]
            wrong = row["mismatching_pixels"]
            assert count["necessary"] == count["sufficient"] == count["pixels"] == wrong
            assert count["runner_up"] == 0
    wrong = {row["method"]: row["mismatching_pixels"] for row in data["rows"]}
    assert wrong["exact-conic"] > 0 and wrong["exact-footprint"] > 0
    assert_exact(data["rows"][-1])


@pytest.mark.parametrize("mode", ["ladder", "isolate", "default"])
def test_tables_and_pictures_are_written(mode: str, request: pytest.FixtureRequest) -> None:
    data, out = request.getfixturevalue(mode)
    assert_csv_agrees(data, out)
    assert data["mode"] == ("methods" if mode == "default" else mode)
    assert data["rig"]["width"] == 64 and data["tile_px"] == 4 and data["views"] == 1
    names = [row["method"] for row in (*data["rows"], *data["baselines"])]
    pictures = {f"difference-{re.sub('[,= ]', '-', name)}.png" for name in names}
    pictures |= {"causes-paper.png", "side-by-side-paper.png"}
    tables = {"verify.json", "verify.csv", "verify.md"}
    assert {path.name for path in out.iterdir()} - {"chart.png"} == pictures | tables
    assert (out / "chart.png").exists() == (data["missing"] == [])
    for name in pictures:
        with Image.open(out / name) as picture:
            picture.verify()
    text = (out / "verify.md").read_text()
    assert all(f"| {name} |" in text for name in names)


def test_without_a_mode_it_is_paper_and_exact_as_the_library_renders_them(default: Result) -> None:
    data, _ = default
    paper, exact = data["rows"]
    assert (paper["method"], exact["method"]) == ("paper", "exact")
    assert_exact(exact)
    city = generate_city(1500, 0)
    rig = StereoRig(DISPLAY, city.start)
    frame = render_stereo(city.scene, rig, PRESETS["paper"], compare=True)
    assert frame.independent_right is not None
    error = np.abs(frame.right.astype(float) - frame.independent_right)
    wrong = differing(frame.right, frame.independent_right)
    assert paper["mismatching_pixels"] == wrong.sum() > 0
    assert paper["max_abs"] == error.max()
    assert paper["mean_abs"] == pytest.approx(error.mean())
    assert paper["psnr_db"] == pytest.approx(-10 * np.log10(np.mean(error**2)))
    stereo = frame.work.stereo
    assert paper["inserted"] == stereo.fifo_entries.sum()
    assert (paper["dropped"], paper["unseen"]) == (stereo.dropped, stereo.unseen)
    assert paper["independent_tiles"] == frame.work.independent_right_tiles
    work = (frame.work.left, frame.work.right)
    assert paper["alpha_checks"] == sum(int(eye.alpha_checks.sum()) for eye in work)
    assert paper["covered_pixels_share"] == exact["covered_pixels_share"] > 0.5
    assert exact["forward_only"] > 0


def test_methods_stand_in_the_order_given(folder: Path) -> None:
    given = ("exact,rows=1", "paper", "exact,conic=left")
    line = [word for text in given for word in ("--method", text)]
    data, out = verified(folder / "methods", *CITY, *line, "--tile", "8")
    assert [row["method"] for row in data["rows"]] == list(given)
    for row in data["rows"]:
        assert_sound(row)
    assert data["rows"][0]["mismatching_pixels"] == 0
    assert set(data["rows"][2]["causes"]) == {"conic"}
    assert data["tile_px"] == 8 and (out / "causes-exact-rows-1.png").exists()
    assert_csv_agrees(data, out)


def test_along_a_trace_counts_are_sums_over_the_frames(folder: Path, default: Result) -> None:
    data, out = verified(folder / "walk", *CITY, "--trace", "walk", "--frames", "2")
    assert data["views"] == 2
    city = generate_city(1500, 0)
    trace = head_trace("walk", city.start, city.up, 2, GENERATED_RATE_HZ, 0)
    wrong, squares = [], []
    for i in range(2):
        rig = StereoRig(DISPLAY, trace.pose(i))
        frame = render_stereo(city.scene, rig, PRESETS["paper"], compare=True)
        assert frame.independent_right is not None
        wrong.append(mismatching_pixels(frame.right, frame.independent_right))
        squares.append(np.mean((frame.right.astype(float) - frame.independent_right) ** 2))
    paper, exact = data["rows"]
    assert paper["mismatching_pixels"] == sum(wrong) and paper["pixels"] == 2 * 64 * 48
    assert paper["psnr_db"] == pytest.approx(-10 * np.log10(np.mean(squares)))
    assert_sound(paper)
    assert_exact(exact)
    assert_csv_agrees(data, out)


def test_hostile_scenes_are_judged_one_by_one(hostile: Result) -> None:
    data, out = hostile
    assert data["mode"] == "hostile" and data["rig"] is None and data["baselines"] == []
    names = [(row["scene"], row["method"]) for row in data["rows"]]
    assert names == [(name, method) for name in SCENES for method in ("paper", "exact")]
    for row in data["rows"]:
        assert_sound(row)
        assert row["breaks"] == HOSTILE[row["scene"]]().breaks
    for row in data["rows"][1::2]:
        assert_exact(row)
    near = HOSTILE["near_objects"]()
    alone = StereoRenderer(near.scene, near.rig, near.background).independent_right()
    share = data["rows"][0]["covered_pixels_share"]
    assert 0.1 < share < 0.99 and share == (alone.transmittance < 1).mean()
    wrong = {row["scene"] for row in data["rows"][::2] if row["mismatching_pixels"]}
    assert wrong == set(SCENES) - {"smaller_than_a_tile", "baseline_zero"}
    assert {path.name for path in out.iterdir()} == {"verify.json", "verify.csv", "verify.md"}
    assert_csv_agrees(data, out)
    assert all(why.startswith("smaller_than_a_tile: SSIM") for why in data["missing"])


# ---------------------------------------------------------------- what is not installed


def test_without_matplotlib_there_is_no_chart(folder: Path, monkeypatch: Any) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    data, out = verified(folder / "no_chart", *CITY)
    assert [why for why in data["missing"] if "chart.png was not drawn" in why]
    assert not (out / "chart.png").exists() and (out / "difference-paper.png").exists()
    assert_exact(data["rows"][1])


@pytest.mark.parametrize(
    ("module", "key", "measure"),
    [("flip_evaluator", "flip", "FLIP"), ("skimage.metrics", "ssim", "SSIM")],
)
def test_without_a_quality_package_its_measure_is_null(
    module: str, key: str, measure: str, folder: Path, monkeypatch: Any
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    data, out = verified(folder / f"no_{key}", *CITY)
    assert all(row[key] is None for row in (*data["rows"], *data["baselines"]))
    assert [why for why in data["missing"] if f"{measure} needs" in why]
    assert_csv_agrees(data, out)
    assert data["rows"][0]["psnr_db"] > 0


# ---------------------------------------------------------------- errors


@pytest.fixture
def refused(capsys: Any) -> Any:
    """The one line of error of ``nebula verify ARGUMENTS``; exit status 2."""

    def call(*arguments: str) -> str:
        with pytest.raises(SystemExit) as end:
            main(["verify", *arguments])
        written = capsys.readouterr()
        assert (end.value.code, written.out) == (2, "")
        assert written.err.startswith("nebula: error: ") and written.err.count("\n") == 1
        return str(written.err)

    before = signal.getsignal(signal.SIGTERM)
    yield call
    signal.signal(signal.SIGTERM, before)


EXCLUDE = "--ladder, --isolate, --hostile and --method exclude each other"
OWN_SCENES = "--hostile brings its own scenes and rigs; --"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("--ladder --method paper", EXCLUDE),
        ("--ladder --isolate", EXCLUDE),
        ("--hostile --isolate", EXCLUDE),
        ("--hostile --method exact", EXCLUDE),
        ("--method best", "method must be one of independent, paper, exact, not 'best'"),
        ("--method paper,row=8", "method paper: 'row=8' must be SWITCH=VALUE with one of the"),
        ("--method exact --method paper,tie=both", "tie must be one of id, depth, not 'both'"),
        ("--method paper,rows=0", "rows must lie in 1..1024, not 0"),
        ("--method exact,insertion=floor", "out_of_range forward_only needs insertion carrier"),
        ("--hostile --scene a.ply", OWN_SCENES + "scene"),
        ("--hostile --config garden", OWN_SCENES + "config"),
        ("--hostile --trace walk", OWN_SCENES + "trace"),
        ("--hostile --width 64", OWN_SCENES + "width"),
        ("--hostile --frames 2", OWN_SCENES + "frames"),
        ("--scene nowhere.ply", "nowhere.ply: "),
        ("--trace nowhere.csv", "nowhere.csv"),
        ("--tile 5", "'5' is not one of '4', '8', '16'"),
        ("--frames 0", "0 is not in the range x>=1"),
    ],
)
def test_what_is_refused_writes_nothing(
    line: str, message: str, refused: Callable[..., str], tmp_path: Path
) -> None:
    size = () if "--hostile" in line else ("--width", "64", "--height", "48")
    leaves = () if "--hostile" in line or "--scene" in line else ("--city-leaves", "1500")
    out = tmp_path / "out"
    assert message in refused(*line.split(), *size, *leaves, "--out", str(out))
    assert list(tmp_path.iterdir()) == []


def test_a_view_of_nothing_is_refused_and_writes_nothing(
    refused: Callable[..., str], tmp_path: Path
) -> None:
    away = ("--view", "0,9000,10:0,18000,10")
    assert "no splat is visible from this view" in refused(
        *CITY, *away, "--out", str(tmp_path / "out")
    )
    assert list(tmp_path.iterdir()) == []
