"""V3DG layout JSON: what is read, what is refused, and where asset files are looked for."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gaussians.cameras import look_at
from gaussians.errors import InputError
from gaussians.formats import load_scene, write_ply
from gaussians.formats.layout import compose_layout, read_composition, read_layout
from gaussians.scene import FIELDS, Scene
from gaussians.transforms import transformed
from tests.gaussians.real_data import data_file

ANGLE_X = 0.785


def blob(count: int = 3, seed: int = 0, degree: int = 0) -> Scene:
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return Scene(
        rng.normal(size=(count, 3)).astype(np.float32),
        quaternions.astype(np.float32),
        rng.uniform(0.01, 0.2, (count, 3)).astype(np.float32),
        rng.uniform(0.1, 1.0, count).astype(np.float32),
        rng.normal(size=(count, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def camera(matrix: Any = None) -> dict[str, Any]:
    return {
        "camera_name": "camera_0",
        "camera_width": 192,
        "camera_height": 108,
        "camera_angle_x": ANGLE_X,
        "camera_angle_y": 2 * math.atan(math.tan(ANGLE_X / 2) * 108 / 192),
        "transform_matrix": np.eye(4).tolist() if matrix is None else matrix,
    }


def instance(position: list[float], scale: float = 1.0) -> dict[str, Any]:
    return {"scale": scale, "quaternions": [0.0, 0.0, 0.0, 2.0], "positions": position}


def document(*kinds: str) -> dict[str, Any]:
    """A layout with one asset per kind, two instances each, and one camera."""
    assets = [
        {
            "asset_kind": kind,
            "asset_name": "a",
            "ply_suffix": "cloud/fused.ply",
            "instances": [instance([1.0, 2.0, 3.0]), instance([0.0, 0.0, 5.0], 0.5)],
        }
        for kind in kinds or ("thing",)
    ]
    return {"layouts": [{"layout_name": "l", "assets": assets, "cameras": [camera()]}]}


def written(folder: Path, content: dict[str, Any]) -> Path:
    path = folder / "Layout.json"
    path.write_text(json.dumps(content))
    return path


def test_instances_and_cameras_are_read(tmp_path):
    eye, target, up = np.array([3.0, -2.0, 1.5]), np.zeros(3), np.array([0.0, 0.0, 1.0])
    wanted = look_at(eye, target, up)
    blender = np.eye(4)
    blender[:3, :3] = wanted.rotation @ np.diag([1.0, -1.0, -1.0])  # x right, y up, -z forward
    blender[:3, 3] = eye
    content = document()
    content["layouts"][0]["cameras"] = [camera(blender.tolist()), camera()]
    del content["layouts"][0]["cameras"][1]["camera_angle_y"]
    layout = read_layout(written(tmp_path, content))
    assert layout.instances.scales.tolist() == [1.0, 0.5]
    assert layout.instances.quaternions.tolist() == [[0, 0, 0, 1]] * 2  # normalised
    assert layout.instances.positions.tolist() == [[1, 2, 3], [0, 0, 5]]
    assert layout.instances.bases.tolist() == [0, 0]
    seen = layout.cameras[0]
    np.testing.assert_allclose(seen.pose.rotation, wanted.rotation, atol=1e-15)
    assert seen.pose.position.tolist() == eye.tolist()
    assert (seen.display.width, seen.display.height) == (192, 108)
    assert seen.display.fx == seen.display.fy == pytest.approx(96 / math.tan(ANGLE_X / 2))
    assert layout.cameras[1].pose.rotation[:, 2].tolist() == [0, 0, -1]  # identity looks along -z


CHANGES: dict[str, tuple[tuple[Any, ...], Any, str]] = {
    "two layouts": (("layouts",), [{}, {}], "exactly one layout, not 2"),
    "no layout": (("layouts",), [], "exactly one layout, not 0"),
    "layouts": (("layouts",), {}, "layouts must be a list"),
    "no assets": (("layouts", 0, "assets"), [], "empty: must hold at least one instance"),
    "asset": (("layouts", 0, "assets", 0), 3, "asset 0: must have the key 'asset_kind'"),
    "kind": (("layouts", 0, "assets", 0, "asset_kind"), "..", "asset_kind must be a path inside"),
    "suffix": (("layouts", 0, "assets", 0, "ply_suffix"), "/etc/passwd", "ply_suffix must be a pa"),
    "drive": (("layouts", 0, "assets", 0, "ply_suffix"), "C:\\a", "ply_suffix must be a path ins"),
    "name": (("layouts", 0, "assets", 0, "asset_name"), None, "asset_name must be a path inside"),
    "instances": (("layouts", 0, "assets", 0, "instances"), None, "instances must be a list"),
}
AT_INSTANCE = ("layouts", 0, "assets", 0, "instances", 1)
CHANGES |= {
    f"instance {key} {number}": ((*AT_INSTANCE, key), value, f"instance 1: {message}")
    for number, (key, value, message) in enumerate(
        [
            ("scale", 0, "scale must be a positive number, not 0"),
            ("scale", -1.0, "scale must be a positive number, not -1"),
            ("scale", "1", "scale must be a positive number, not '1'"),
            ("scale", True, "scale must be a positive number, not True"),
            ("scale", 10**400, "scale must be a positive number"),
            ("quaternions", [0, 0, 0, 0.0], "quaternions must not have length 0"),
            ("quaternions", [1e308] * 4, "quaternions must not have length"),
            ("quaternions", [1, 0, 0], "quaternions must be a list of 4 finite numbers"),
            ("quaternions", [1, 0, 0, 10**400], "quaternions must be a list of 4 finite numbers"),
            ("positions", [1, 0, None], "positions must be a list of 3 finite numbers"),
            ("positions", 7, "positions must be a list of 3 finite numbers"),
        ]
    )
}
AT_CAMERA = ("layouts", 0, "cameras", 0)
CHANGES |= {
    f"camera {key} {number}": ((*AT_CAMERA, key), value, f"camera 0: {message}")
    for number, (key, value, message) in enumerate(
        [
            ("camera_width", 0, "camera_width must be an integer from 1 to 16384, not 0"),
            ("camera_height", 1e3, "camera_height must be an integer"),
            ("camera_angle_x", 0.0, "camera_angle_x must be a positive number"),
            ("camera_angle_y", 0.5, "camera_angle_y must be 0.457.* .square pixels., not 0.5"),
            ("camera_name", 3, "camera_name must be text, not 3"),
            (
                "transform_matrix",
                np.diag([1, 1, 1, 2]).tolist(),
                "transform_matrix must be a rigid",
            ),
            ("transform_matrix", np.eye(3).tolist(), "transform_matrix must have 4 rows"),
            (
                "transform_matrix",
                np.eye(4)[:, :3].tolist(),
                "transform_matrix: row 0 must be a list of 4 finite",
            ),
            (
                "transform_matrix",
                (2 * np.eye(4)).tolist(),
                "transform_matrix must be a rigid motion",
            ),
            (
                "transform_matrix",
                np.diag([1, 1, -1, 1]).tolist(),
                "transform_matrix must be a rigid motion",
            ),
            (
                "transform_matrix",
                (1e300 * np.eye(4)).tolist(),
                "transform_matrix must be a rigid motion",
            ),
            (
                "transform_matrix",
                np.ones((4, 4)).tolist(),
                "transform_matrix must be a rigid motion",
            ),
        ]
    )
}


def parent_of(content: Any, place: tuple[Any, ...]) -> Any:
    for key in place[:-1]:
        content = content[key]
    return content


@pytest.mark.parametrize("case", CHANGES)
def test_a_wrong_layout_is_refused_in_one_line(tmp_path, case):
    place, value, message = CHANGES[case]
    content = document()
    parent_of(content, place)[place[-1]] = value
    path = written(tmp_path, content)
    with pytest.raises(InputError, match=message) as raised:
        read_layout(path)
    assert "\n" not in str(raised.value)
    assert str(raised.value).startswith(str(path))


@pytest.mark.parametrize("text", ["", "[]", "{", '{"layouts": [NaN]}', "{}", "\xff", "[" * 10**5])
def test_what_is_no_layout_is_refused(tmp_path, text):
    path = tmp_path / "Layout.json"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=str(path)):
        read_layout(path)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value)
    found = []
    for key, item in inner:
        found.append((*path, key))
        if isinstance(item, (dict, list)):
            found += places(item, (*path, key))
    return found


PLACES = places(document("one", "two"))
JUNK = st.one_of(
    st.none(),
    st.booleans(),
    st.sampled_from(
        [-1, 0, 1e-300, -1e308, 1e308, 10**400, "", "..", "x", "a" * 5000, [], {}, [[]], [1, 2]]
    ),
)


@given(st.sampled_from(PLACES), st.one_of(st.just("delete"), JUNK))
def test_any_key_may_be_missing_or_junk(tmp_path_factory, place, value):
    content = copy.deepcopy(document("one", "two"))
    parent = parent_of(content, place)
    if value == "delete":
        del parent[place[-1]]
    else:
        parent[place[-1]] = value
    folder = tmp_path_factory.mktemp("layout")
    path = written(folder, content)
    for kind in ("one", "two"):
        (folder / kind / "a" / "cloud").mkdir(parents=True)
        write_ply(blob(), folder / kind / "a" / "cloud" / "fused.ply")
    try:
        scene, _ = compose_layout(path)
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert np.isfinite(scene.means).all()


def test_load_scene_composes_a_layout_and_names_every_file(tmp_path):
    base = blob()
    path, ply = written(tmp_path, document()), tmp_path / "fused.ply"
    write_ply(base, ply)
    base = load_scene(ply)[0]
    scene, files = load_scene(path)
    assert files == [path, ply]
    half_turn = np.diag([-1.0, -1.0, 1.0])
    first = transformed(base, half_turn, 1.0, (1.0, 2.0, 3.0))
    second = transformed(base, half_turn, 0.5, (0.0, 0.0, 5.0))
    for field in FIELDS:
        joined = np.concatenate([getattr(first, field), getattr(second, field)])
        assert np.array_equal(getattr(scene, field), joined)
    with pytest.raises(InputError, match=r"only lod-meta.json has levels"):
        load_scene(path, level=1)


def test_assets_lie_in_the_folders_of_the_repository_first(tmp_path):
    path = written(tmp_path, document())
    where = r"asset 0: 'cloud/fused.ply' must lie in the folder 'thing/a' .*or 'fused.ply' right"
    with pytest.raises(InputError, match=where):
        compose_layout(path)
    write_ply(blob(2), tmp_path / "fused.ply")
    assert len(compose_layout(path)[0]) == 4
    (tmp_path / "thing" / "a" / "cloud").mkdir(parents=True)
    write_ply(blob(5), tmp_path / "thing" / "a" / "cloud" / "fused.ply")
    assert len(compose_layout(path)[0]) == 10


def test_several_assets_are_told_apart_and_share_no_file(tmp_path):
    path = written(tmp_path, document("one", "two"))
    write_ply(blob(2), tmp_path / "fused.ply")  # whose would it be?
    with pytest.raises(
        InputError, match=r"asset 0: 'cloud/fused.ply' .*'one/a' beside the layout$"
    ):
        compose_layout(path)
    for kind, count, degree in (("one", 2, 0), ("two", 3, 1)):
        (tmp_path / kind / "a" / "cloud").mkdir(parents=True)
        write_ply(blob(count, degree=degree), tmp_path / kind / "a" / "cloud" / "fused.ply")
    composition, layout, _ = read_composition(path)
    assert [a.kind for a in layout.assets] == ["one", "two"]
    assert layout.instances.bases.tolist() == [0, 0, 1, 1]
    scene = composition.compose()
    assert len(scene) == composition.count() == 10
    assert scene.sh.shape == (10, 4, 3)
    assert not scene.sh[:4, 1:].any()
    assert scene.sh[4:, 1:].any()


def test_a_small_file_that_composes_to_more_than_memory_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("gaussians.formats.layout.SCENE_LIMIT_BYTES", 335)
    path = written(tmp_path, document())
    write_ply(blob(), tmp_path / "fused.ply")
    with pytest.raises(InputError, match=r"composes to 6 Gaussians .*compose a part"):
        load_scene(path)
    monkeypatch.setattr("gaussians.formats.layout.SCENE_LIMIT_BYTES", 336)
    assert len(load_scene(path)[0]) == 6


@pytest.mark.real_data
def test_the_sea_of_donuts():
    path = data_file("scenes/donut/DonutSea.json")
    composition, layout, files = read_composition(path)
    assert [f.name for f in files] == ["DonutSea.json", "fused.ply"]
    assert len(layout.instances) == 2048
    assert composition.count() == 2048 * 45_624
    assert len(layout.cameras) == 400
    distances = [np.linalg.norm(c.pose.position) for c in layout.cameras]
    assert 0.449 < min(distances) < 0.451
    assert 8.99 < max(distances) < 9.01
    for published in layout.cameras:  # all look at the origin
        away = published.pose.position / np.linalg.norm(published.pose.position)
        assert published.pose.rotation[:, 2] @ away < -0.999
    with pytest.raises(InputError, match="composes to 93437952 Gaussians"):
        load_scene(path)
    flight = data_file("scenes/donut/DonutSea-blender-trajectory-zoominout.json")
    assert len(read_layout(flight).cameras) == 240
