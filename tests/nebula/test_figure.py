"""`nebula figure`: three files from one measurement, on small cities; what the measures mean."""

from __future__ import annotations

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from gaussians.cameras import DISPLAYS
from gaussians.errors import InputError
from gaussians.projection import project
from gaussians.tiling import TileGrid, row_spans
from nebula import figure
from nebula.cli import cli
from nebula.figures import FIGURES, formats, views
from nebula.figures.eye_overlap import hit, overlap, same_depth, touched
from nebula.figures.output import Figure, csv_text, png_of
from nebula.figures.views import choose_views
from nebula.options import FigureOptions, scene_options
from tests.gaussians.real_data import data_file
from tests.strategies import Splat, at_pixel, build_scene, small_rig

SMALL = {"city_leaves": 1500, "width": 64, "height": 48}


def options(name: str, out: Path, config: str | None = None, **given: Any) -> FigureOptions:
    return FigureOptions(name, config, given, seed=1, baseline_m=0.06, out=out)


VIEW_FIGURES = [name for name, kind in FIGURES.items() if "tree" not in kind.takes]


@pytest.fixture(scope="module", params=VIEW_FIGURES)
def made(request: Any, tmp_path_factory: Any) -> tuple[str, Path, dict[str, Any]]:
    """Every figure of views on a small city: its name, where it was written, what it returned."""
    out = tmp_path_factory.mktemp("figure")
    return request.param, out, figure.run(options(request.param, out, **SMALL)).data


# ---------------------------------------------------------------- files


def test_a_figure_is_json_csv_and_a_picture(made):
    name, out, data = made
    assert sorted(p.name for p in out.iterdir()) == [f"{name}.{s}" for s in ("csv", "json", "png")]
    assert json.loads((out / f"{name}.json").read_text()) == json.loads(json.dumps(plain(data)))
    rows = list(csv.DictReader((out / f"{name}.csv").read_text().splitlines()))
    assert len(rows) == len(data["rows"]) > 0
    for written, row in zip(rows, data["rows"], strict=True):
        assert written == {k: "" if v is None else str(v) for k, v in row.items()}
    picture = np.asarray(Image.open(out / f"{name}.png"))
    assert picture.shape[0] > 300 and picture.shape[1] > 600 and picture.std() > 10


def plain(value: Any) -> Any:
    """numpy arrays as lists."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    return [plain(v) for v in value] if isinstance(value, (list, np.ndarray)) else value


def test_every_row_names_scene_display_and_source(made):
    _, _, data = made
    for row in data["rows"]:
        assert row["scene"] == "city of 1500" and row["display"].startswith("64 x 48 px, f ")
        assert row["source"] == "generated: city of 1500 leaves, seed 1"
    (scene,) = data["scenes"]
    assert scene["splats"] == 1500 and scene["baseline_m"] == 0.06 and scene["near_m"] == 0.2


def test_the_picture_is_the_same_for_the_same_rows():
    def draw(canvas: Any) -> None:
        canvas.subplots().plot([1, 2])

    drawn = Figure("two points", {}, [], draw, "")
    assert png_of(drawn) == png_of(drawn)


def test_rows_of_different_keys_share_one_header():
    assert csv_text([{"a": 1, "b": None}, {"a": 2.5, "c": "x,y"}]) == 'a,b,c\n1,,\n2.5,,"x,y"\n'


# ---------------------------------------------------------------- the command


def test_help_lists_the_figures():
    shown = CliRunner().invoke(cli, ["figure", "--help"]).output
    assert all(f"{name} " in shown and kind.about in shown for name, kind in FIGURES.items())


@pytest.mark.parametrize(
    ("name", "option", "flag"),
    [
        ("formats", {"tree": Path("x")}, "--tree"),
        ("stereo-similarity", {"tau_px": 0.0}, "--tau"),
        ("frame-interval", {"search_every": 4}, "--every"),
        ("lod-search", {"shrink": 2}, "--shrink"),
        ("format-widths", {"frames": 7}, "--frames"),
    ],
)
def test_an_option_a_figure_has_no_use_for_is_refused(tmp_path, name, option, flag):
    with pytest.raises(InputError, match=f"figure {name}: {flag}: not of use here"):
        figure.run(replace(options(name, tmp_path / "out", **SMALL), **option))


@pytest.mark.parametrize(
    ("name", "given", "flag"),
    [("formats", {"trace": "walk"}, "--trace"), ("lod-search", {"near_m": 0.1}, "--near")],
)
def test_a_placement_a_figure_has_no_use_for_is_refused(tmp_path, name, given, flag):
    with pytest.raises(InputError, match=f"figure {name}: {flag}: not of use here"):
        figure.run(options(name, tmp_path / "out", **given, **SMALL))


def test_an_unknown_figure_is_refused_with_the_known_ones(tmp_path):
    with pytest.raises(InputError, match=r"no figure named 'fig9'; it must be one of: formats, "):
        figure.run(options("fig9", tmp_path))


def test_without_matplotlib_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(InputError, match=r"pip install 'nebula-splat\[report\]'"):
        figure.run(options("formats", tmp_path / "out", **SMALL))
    assert not (tmp_path / "out").exists()


def test_the_display_is_the_prototype_unless_something_else_is_said(tmp_path):
    def display(config: str | None = None, **given: Any) -> Any:
        (chosen,) = choose_views(options("formats", tmp_path, config, **given), ()).chosen.values()
        return chosen.display

    assert display(city_leaves=1500) == DISPLAYS["prototype"]
    assert display("street") == DISPLAYS["prototype"]
    assert display("street", display="quest3") == DISPLAYS["quest3"]
    assert (display(city_leaves=1500, width=80).width, display("near", height=90).height) == (
        80,
        90,
    )
    file = tmp_path / "own.yaml"
    file.write_text("scene: {city: 1500}\nwidth: 70\n")
    assert display(str(file)).width == 70
    assert scene_options(None, {"city_leaves": 1500}).display.width == 1024


def test_default_scenes_that_are_not_here_are_said_to_be_missing(tmp_path, monkeypatch):
    monkeypatch.setenv("NEBULA_DATA", str(tmp_path))
    city = tmp_path / "small.yaml"
    city.write_text("scene: {city: 1500}\nwidth: 32\nheight: 24\n")
    monkeypatch.setattr(formats, "SCENES", (str(city), "playbot"))
    result = figure.run(options("formats", tmp_path / "out"))
    (missing,) = result.data["missing_scenes"]
    assert missing["scene"] == "playbot" and str(tmp_path / "scenes") in missing["reason"]
    assert "not measured: playbot (no file " in result.text
    assert {row["scene"] for row in result.data["rows"]} == {str(city)}
    with pytest.raises(InputError, match="none of the scenes playbot is here"):
        choose_views(options("formats", tmp_path), ("playbot",))
    with pytest.raises(InputError, match="must be the folder that holds it"):
        choose_views(options("formats", tmp_path, "playbot"), ())


def test_a_view_of_nothing_is_refused(tmp_path):
    away = options("formats", tmp_path, **SMALL, view="0,0,500:0,1,1000")
    with pytest.raises(InputError, match="no splat is visible"):
        figure.run(away)


# ---------------------------------------------------------------- formats


def test_format_rows_say_how_far_and_how_often(tmp_path):
    data = figure.run(options("formats", tmp_path, **SMALL)).data
    rows = {row["format"]: row for row in data["rows"]}
    assert "fp32" not in rows and rows["hw"]["psnr_db"] > data["required_db"] == 70
    assert rows["hw"]["pixels"] == 64 * 48 and rows["hw"]["saturated_centres"] == 0
    assert rows["fp16"]["psnr_db"] < rows["hw"]["psnr_db"]
    for row in rows.values():
        shares = row["pixels_off_8bit_share"], row["pixels_off_more_than_1_lsb_share"]
        assert 1 >= shares[0] >= shares[1] >= 0
        assert (row["max_error_lsb"] > 1) == (shares[1] > 0)


@pytest.mark.real_data
@pytest.mark.parametrize("name", ["playbot", "st_peter", "donut"])
def test_hw_keeps_70_db_on_real_scenes(name, tmp_path, monkeypatch):
    data_file("scenes")
    given = {"width": 640, "height": 640}
    (view,) = views.choose_views(options("formats", tmp_path, name, **given), ())
    (row,) = formats.measure(view, {"hw": formats.FORMATS["hw"]})
    assert row["psnr_db"] > 70 and row["saturated_centres"] == row["saturated_accumulators"] == 0


# ---------------------------------------------------------------- stereo similarity


def test_pixels_moved_by_a_constant_leave_a_strip_at_the_right():
    for shift, points, squares in ((2.0, 2, 2), (2.4, 2, 2), (2.6, 3, 2), (0.0, 0, 0)):
        moved = np.full((3, 10), shift)
        assert (~hit(moved)).sum(axis=1).tolist() == [points] * 3
        assert (~touched(moved)).sum(axis=1).tolist() == [squares] * 3
        assert hit(moved)[:, : 10 - points].all()


def test_a_depth_edge_leaves_a_hole_and_a_slant_leaves_none():
    edge = np.array([[4.0] * 6 + [1.0] * 6])  # near on the left: it uncovers three pixels
    assert np.flatnonzero(~touched(edge)).tolist() == [2, 3, 4, 11]
    slant = (4 - 0.75 * np.arange(12.0))[None]
    assert not (~touched(slant))[0, :-1].any() and (~hit(slant))[0, :-1].any()


def test_marking_pixels_equals_a_loop_over_them():
    rng = np.random.default_rng(5)
    shift = rng.choice([0, 1, 2.5, 40, 0.3, np.inf], (4, 20)) * rng.uniform(0.5, 1.5, (4, 20))
    by_point, by_square = np.zeros((2, 4, 20), bool)
    for y in range(4):
        for x in range(20):
            for column in range(20):
                left = x - shift[y, x]
                by_point[y, column] |= column <= left + 0.5 < column + 1
                by_square[y, column] |= left < column + 1 and left + 1 > column
    assert np.array_equal(hit(shift), by_point) and np.array_equal(touched(shift), by_square)


def test_depth_is_compared_where_the_surface_was():
    left = np.array([[5.0, 5.0, 2.0, 2.0, np.inf]])
    right = np.array([[2.05, 2.2, 5.0, np.inf, np.inf]])
    back = np.array([[2.0, 2.0, -1.0, 1.0, 9.0]])
    assert same_depth(left, right, back).tolist() == [[True, False, True, True, False]]


def test_overlap_of_a_wall_with_a_post_before_it():
    """Three opaque splats: all of it is known by hand."""
    rig = small_rig(64, 32, focal=(64.0, 64.0), baseline_m=0.125)
    wall = Splat((0.0, 0.0, 8.0), (60.0, 60.0, 0.0), 1e5)  # disparity 1 px, alpha 0.99 throughout
    post = Splat(at_pixel(rig, 24.0, 16.0, 1.0), (0.02, 4.0, 0.0), 1e3)  # 8 px
    edge = Splat(at_pixel(rig, 70.0, 16.0, 1.0), (0.005, 4.0, 0.0), 0.9)  # in the right eye only
    scene = build_scene([wall, post, edge], rig, np.zeros((3, 1, 3)))
    splats = project(scene, rig)
    found = overlap(splats, row_spans(splats, TileGrid(64, 32, 4)), rig)
    assert found.covered == 1
    assert found.splats_right_only == pytest.approx(1 / 3)
    assert 0 < found.weight_right_only < found.pairs_right_only < 0.3
    strip, hole = 1 / 64, 7 / 64  # the wall's strip at the edge; the post uncovers 8 - 1 columns
    assert (
        found.unreached == found.unreached_of_covered == pytest.approx(strip + hole, abs=2.5 / 64)
    )
    assert found.unreached_right_edge >= strip
    assert found.other_depth >= found.unreached - 1e-9


def test_without_a_baseline_both_eyes_see_the_same(tmp_path):
    same = replace(options("stereo-similarity", tmp_path, **SMALL), baseline_m=0.0)
    (row,) = figure.run(same).data["rows"]
    shares = ("unreached", "unreached_by_points", "other_depth", "splats_right_only")
    assert [row[name] for name in shares] == [0, 0, 0, 0]
    assert row["paper_unreached_below"] == 0.01
