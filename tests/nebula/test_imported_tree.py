"""``nebula build-tree --structure``: trees of levels, of copies, of voxels, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gaussians.formats import load_lod_set, write_ply
from lod_cloud import load_tree
from nebula.program import main
from tests.gaussians.test_formats_lod_meta import pyramid
from tests.lod_cloud.trees import random_scene


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(["build-tree", *arguments])
    return int(end.value.code or 0)


def layout(folder: Path) -> Path:
    """Three copies of a scene of 30, the second one turned and moved."""
    folder.mkdir()
    scene = random_scene(30, 1)
    scene.opacities[:] = np.clip(scene.opacities, 0.01, 0.99)
    scene.scales[:] = np.maximum(scene.scales, 1e-3)
    write_ply(scene, folder / "base.ply")
    instances = [
        {"scale": 1.0, "quaternions": [1, 0, 0, 0], "positions": [0, 0, 0]},
        {"scale": 0.5, "quaternions": [0, 1, 0, 0], "positions": [30, 0, 0]},
        {"scale": 2.0, "quaternions": [1, 0, 0, 0], "positions": [0, 90, 0]},
    ]
    asset = {"asset_kind": "a", "asset_name": "b", "ply_suffix": "base.ply", "instances": instances}
    document = {"layouts": [{"assets": [asset], "cameras": []}]}
    (folder / "layout.json").write_text(json.dumps(document))
    return folder / "layout.json"


def test_levels_become_blocks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    pyramid(folder)
    out, report = tmp_path / "tree", tmp_path / "report.json"
    line = ("--scene", str(folder), "--structure", "blocks", "--units-per-metre", "2")
    assert run(*line, "--out", str(out), "--json", str(report)) == 0
    data = json.loads(report.read_text())
    # leaf 1 lists nothing at level 1: it keeps its finest level alone
    assert data["build"]["left_out"] == [[1, 1]] and data["leaves"] == 14
    tree = load_tree(out)
    finest = load_lod_set(folder / "lod-meta.json").levels[0]
    means = tree.gaussians.means[tree.leaf_nodes()]
    assert np.array_equal(means, finest.means * np.float32(0.5))
    assert tree.metadata.start is not None and "14 leaves" in capsys.readouterr().out


def test_copies_become_instances(tmp_path: Path) -> None:
    out = tmp_path / "tree"
    path = layout(tmp_path / "scene")
    assert (
        run("--scene", str(path), "--structure", "instances", "--up", "+z", "--out", str(out)) == 0
    )
    tree = load_tree(out)
    assert tree.leaves == 90 and tree.metadata.up == (0.0, 0.0, 1.0)
    assert tree.metadata.start is None  # no camera in the layout


def test_a_scene_becomes_an_octree(tmp_path: Path) -> None:
    out = tmp_path / "tree"
    assert run("--city-leaves", "2000", "--structure", "octree", "--out", str(out)) == 0
    assert load_tree(out).metadata.build["structure"] == "octree"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--structure", "blocks"), "--structure blocks needs a file: --scene must be given"),
        (("--structure", "instances"), "--structure instances needs a file"),
        (
            ("--scene", "x.json", "--structure", "blocks", "--level", "1"),
            "--structure blocks takes every level; --level: not of use",
        ),
        (
            ("--structure", "octree", "--fan-out-ratio", "0.7"),
            "--pair-within and --fan-out-ratio: not of use",
        ),
        (("--structure", "octree", "--tiled", "city"), "--structure: not of use"),
    ],
)
def test_what_has_no_such_structure_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], message: str
) -> None:
    assert run(*arguments, "--out", str(tmp_path / "tree")) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_hier_file_is_refused_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "merged.hier"
    path.write_bytes(b"\x00" * 64)
    assert run("--scene", str(path), "--out", str(tmp_path / "tree")) == 2
    error = capsys.readouterr().err
    assert "merged.hier: must be a scene, not a .hier hierarchy" in error and error.count("\n") == 1
