"""`render` and `build-tree` as a user runs them, on small cities."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussians.cameras import Display, StereoRig
from gaussians.errors import InputError
from gaussians.quality import to_8bit
from gaussians.render import render_stereo
from gaussians.stereo_method import PRESETS
from gaussians.synthetic import generate_city
from lod_cloud import load_tree
from nebula import build_tree, render
from nebula.options import (
    BuildTreeOptions,
    GeneratedCity,
    RenderOptions,
    SceneOptions,
)

DISPLAY = Display.from_fov(80, 64, 96.0)


def scene(view: str | None = None, trace: str = "walk") -> SceneOptions:
    return SceneOptions(GeneratedCity(2000), None, None, 1.0, view, 0.2, DISPLAY, trace)


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("trees") / "city"
    result = build_tree.run(BuildTreeOptions(scene(), 3, out))
    assert result.data["nesting_violations"] == 0 and result.data["leaves"] == 2000
    return out


def test_render_writes_what_the_renderer_returns(tmp_path):
    result = render.run(RenderOptions(scene(), 3, "exact", 0.06, tmp_path))
    city = generate_city(2000, 3)
    frame = render_stereo(city.scene, StereoRig(DISPLAY, city.start), PRESETS["exact"])
    for name in ("left", "right"):
        shown = np.asarray(Image.open(tmp_path / f"{name}.png"))
        assert np.array_equal(shown, to_8bit(getattr(frame, name)))
    assert json.loads((tmp_path / "render.json").read_text()) == result.data
    assert result.data["right_mismatching_pixels"] == 0 and result.data["psnr_db"] is None
    assert np.asarray(Image.open(tmp_path / "difference.png")).max() == 0


def test_render_shows_where_the_paper_method_differs(tmp_path):
    data = render.run(RenderOptions(scene(), 3, "paper", 0.06, tmp_path)).data
    difference = np.asarray(Image.open(tmp_path / "difference.png"))
    assert (difference.max(axis=2) > 0).sum() == data["right_mismatching_pixels"] > 0


def test_a_stored_tree_is_the_tree_that_was_built(tree):
    loaded = load_tree(tree)
    assert loaded.leaves == 2000 and len(loaded) == 3999
    assert np.array_equal(
        loaded.gaussians.means[loaded.leaf_nodes()], generate_city(2000, 3).scene.means
    )
    assert len(loaded.metadata.path) > 2


def test_another_directory_is_not_replaced_by_a_tree(tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(InputError):
        build_tree.run(BuildTreeOptions(scene(), 3, tmp_path))
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]
