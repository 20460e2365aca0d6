"""Every script in examples/ runs on tiny input and prints what it promises."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussians.formats import write_ply
from tests.gaussians.real_data import data_file
from tests.gaussians.test_layout import blob, document, instance, written

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def main_of(name: str) -> Callable[[list[str]], None]:
    """``main`` of a script, without running it as one."""
    specification = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module.main


def assert_eyes(left: Path, right: Path, size: tuple[int, int]) -> None:
    """Two pictures of this size, neither black nor equal."""
    images = [np.asarray(Image.open(path)) for path in (left, right)]
    assert all(image.shape == (size[1], size[0], 3) for image in images)
    assert all(image.any() for image in images)
    assert not np.array_equal(*images)


def test_every_example_is_tested_and_short():
    scripts = {path.stem for path in EXAMPLES.glob("*.py")}
    tested = set(re.findall(r'main_of\("(\w+)"\)', Path(__file__).read_text()))
    assert scripts == tested
    for name in scripts - {"compose_donut_sea"}:
        assert len((EXAMPLES / f"{name}.py").read_text().splitlines()) <= 60


def test_render_scene(tmp_path, capsys):
    main = main_of("render_scene")
    write_ply(blob(20), tmp_path / "scene.ply")
    out = tmp_path / "a" / "b"
    main([str(tmp_path / "scene.ply"), "--up=+z", "--width", "64", "--out", str(out)])
    assert capsys.readouterr().out.startswith("20 Gaussians; ")
    assert_eyes(out / "left.png", out / "right.png", (64, 64))
    for arguments, message in (
        ([str(tmp_path / "none.ply")], "scene does not exist"),
        ([str(tmp_path / "scene.ply"), "--view", "1,2"], "view must be EX,EY,EZ:LX,LY,LZ"),
        ([str(tmp_path / "scene.ply"), "--units-per-metre", "0"], "must be a positive number"),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(arguments)
        assert stopped.value.code == 2
        assert message in capsys.readouterr().err


def test_stream_a_walk(capsys):
    main_of("stream_a_walk")(["--leaves", "2000", "--frames", "12", "--tau", "40"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("3999 nodes for 2000 leaves")
    rows = [[int(word) for word in line.split()] for line in lines[2:-1]]
    assert [row[0] for row in rows] == [0, 4, 8]
    assert rows[0][1] > rows[1][1]
    later = sum(row[1] for row in rows[1:])
    assert lines[-1] == f"after the first message: {later * 8e-6 * 90 / 12:.2f} Mbps over 0.13 s"


def test_compare_accelerators(capsys):
    main_of("compare_accelerators")(["--leaves", "2000", "--size", "96"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split("  ")[-1].strip() == "mJ"
    shared, alone = (line.split() for line in lines[1:])
    assert (shared[0], alone[0]) == ("nebula", "gscore_nebula")
    assert float(shared[1]) != float(alone[1])
    assert all(float(row[-1]) > 0 for row in (shared, alone))


def sea(folder: Path) -> Path:
    """Thirty copies before the camera, one behind it, and one far beside."""
    places = [[0.1 * i - 1.5, 0.0, -4.0] for i in range(30)] + [[0.0, 0.0, 40.0], [90.0, 0.0, -4.0]]
    content = document()
    content["layouts"][0]["assets"][0]["instances"] = [instance(p, 0.1) for p in places]
    write_ply(blob(20), folder / "fused.ply")
    return written(folder, content)


def test_compose_donut_sea(tmp_path, capsys):
    main = main_of("compose_donut_sea")
    path = str(sea(tmp_path))
    arguments = ["--camera", "0", "--baseline", "0.1", "--out", str(tmp_path / "out")]
    left, right = (tmp_path / "out" / f"camera_0_{eye}.png" for eye in ("left", "right"))
    main([path, *arguments])
    text = capsys.readouterr().out
    assert "32 instances, 640 Gaussians in the layout" in text
    assert "out of view: 1 behind, 1 beside; view: camera_0" in text
    assert "composed: 30 instances, 600 Gaussians" in text
    assert_eyes(left, right, (192, 108))
    culled = left.read_bytes()
    main([path, *arguments, "--no-cull"])
    assert "composed: 32 instances, 640 Gaussians" in capsys.readouterr().out
    assert left.read_bytes() == culled
    main([path, *arguments, "--instances", "3", "--width", "48"])
    assert "composed: 3 instances, 60 Gaussians" in capsys.readouterr().out
    assert_eyes(left, right, (48, 27))
    with pytest.raises(SystemExit):
        main([path, "--camera", "1"])
    assert "--camera must lie in 0..0" in capsys.readouterr().err


@pytest.mark.real_data
def test_compose_a_few_real_donuts(tmp_path, capsys):
    path = data_file("scenes/donut/DonutSea.json")
    arguments = ["--camera", "45", "--instances", "30", "--width", "96", "--out", str(tmp_path)]
    main_of("compose_donut_sea")([str(path), *arguments])
    assert "composed: 30 instances, 1368720 Gaussians" in capsys.readouterr().out
    assert_eyes(tmp_path / "camera_45_left.png", tmp_path / "camera_45_right.png", (96, 54))


def test_an_example_runs_as_a_script_from_anywhere(tmp_path):
    layout = sea(tmp_path)
    command = [sys.executable, str(EXAMPLES / "compose_donut_sea.py"), layout.name, "--camera", "0"]
    environment = {**os.environ, "PYTHONPATH": str(EXAMPLES.parent)}
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "sea" / "camera_0_right.png").exists()
    assert json.loads(layout.read_text())["layouts"]
