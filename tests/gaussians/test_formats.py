"""Scene readers other than SOG: INRIA PLY, .splat, and the choice between formats."""

from __future__ import annotations

import hashlib
import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.errors import InputError
from gaussians.formats import load_scene, write_ply
from gaussians.scene import Scene, normalised_quaternions
from tests.gaussians.real_data import data_file, data_root

REQUIRED = [
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]


def ply_bytes(properties: list[tuple[str, str]], columns: dict[str, np.ndarray]) -> bytes:
    """A PLY file with these (type, name) properties; columns not given are 1."""
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1", "short": "<i2", "int": "<i4"}
    count = len(next(iter(columns.values())))
    table = np.ones(count, [(name, kinds[kind]) for kind, name in properties])
    for name, values in columns.items():
        table[name] = values
    lines = ["ply", "format binary_little_endian 1.0", "comment x", f"element vertex {count}"]
    lines += [f"property {kind} {name}" for kind, name in properties]
    return ("\n".join(lines) + "\nend_header\n").encode() + table.tobytes()


def simple_ply(count: int = 2) -> bytes:
    return ply_bytes([("float", name) for name in REQUIRED], {"x": np.arange(count)})


def scene_of(path: Path, content: bytes) -> Scene:
    path.write_bytes(content)
    scene, files = load_scene(path)
    assert files == [path]
    return scene


def test_ply_properties_are_found_by_name_and_others_skipped(tmp_path):
    names = [*REQUIRED[::-1], *(f"f_rest_{i}" for i in reversed(range(9)))]
    properties = [("uchar", "label"), *(("float", n) for n in names[:7]), ("int", "id")]
    properties += [("double", names[7]), *(("float", n) for n in names[8:]), ("short", "nx")]
    columns = {name: np.float32([i + 0.5, -i]) for i, name in enumerate(names)}
    scene = scene_of(tmp_path / "a.ply", ply_bytes(properties, columns))
    for g in range(2):
        value = {name: float(columns[name][g]) for name in names}
        assert scene.means[g].tolist() == [value["x"], value["y"], value["z"]]
        assert scene.opacities[g] == np.float32(1 / (1 + math.exp(-value["opacity"])))
        for axis in range(3):
            assert scene.scales[g, axis] == np.float32(math.exp(value[f"scale_{axis}"]))
        length = math.sqrt(sum(value[f"rot_{i}"] ** 2 for i in range(4)))
        for i in range(4):
            assert scene.quaternions[g, i] == np.float32(value[f"rot_{i}"] / length)
        for channel in range(3):
            assert scene.sh[g, 0, channel] == value[f"f_dc_{channel}"]
            for k in range(3):  # channel-major in the file
                assert scene.sh[g, 1 + k, channel] == value[f"f_rest_{channel * 3 + k}"]


def edit(old: bytes, new: bytes) -> bytes:
    content = simple_ply()
    assert content.count(old) == 1
    return content.replace(old, new)


ALL_FLOAT = [("float", name) for name in REQUIRED]
BAD_PLY = {
    "ascii": (edit(b"binary_little_endian", b"ascii"), "must be 'binary_little_endian 1.0'"),
    "big endian": (edit(b"little", b"big"), "must be 'binary_little_endian 1.0', not 'binary_big"),
    "missing": (edit(b"property float opacity\n", b""), "missing property opacity"),
    "duplicate": (edit(b"property float y\n", b"property float x\n"), "'x' must be declared once"),
    "truncated": (simple_ply()[:-1], "truncated: .* 111 bytes, .* rows: 2 of 56 bytes"),
    "trailing": (simple_ply() + b"\n", "trailing bytes: .* 113 bytes, .* rows: 2 of 56 bytes"),
    "no header end": (simple_ply()[:60], "must end with the line 'end_header'"),
    "not ply": (b"plx" + simple_ply(), "must begin with the line 'ply'"),
    "empty": (simple_ply(0), "empty"),
    "no vertices": (b"ply\nformat binary_little_endian 1.0\nend_header\n", "empty"),
    "nothing": (b"", "must begin with the line 'ply'"),
    "list": (edit(b"float opacity", b"list uchar int opacity"), "unexpected header line"),
    "count": (edit(b"vertex 2", b"vertex -2"), "not 'element vertex -2'"),
    "faces": (edit(b"end_header", b"element face 1\nend_header"), "not 'element face 1'"),
    "integer": (edit(b"float opacity", b"int opacity"), "'opacity' must be float or double"),
    "huge count": (edit(b"vertex 2", b"vertex 999999999999999"), "truncated"),
    "rest": (
        ply_bytes([*ALL_FLOAT, *(("float", f"f_rest_{i}") for i in range(8))], {"x": np.ones(1)}),
        "f_rest_\\* must be numbered from 0 and count 0, 9, 24 or 45, not 8",
    ),
    "rest numbers": (
        ply_bytes([*ALL_FLOAT, *(("float", f"f_rest_{i + 1}") for i in range(9))], {"x": [1]}),
        "f_rest_\\* must be numbered from 0",
    ),
    "NaN scale": (
        ply_bytes(ALL_FLOAT, {"scale_1": [0, np.nan]}),
        "'scale_1' .* Gaussian 1 has nan",
    ),
    "inf": (ply_bytes(ALL_FLOAT, {"opacity": [np.inf]}), "'opacity' must be finite"),
    "too large": (
        ply_bytes([("double", "x"), *ALL_FLOAT[1:]], {"x": [1e200]}),
        "'x' must be finite; Gaussian 0 has 1e\\+200",
    ),
    "huge scale": (ply_bytes(ALL_FLOAT, {"scale_0": [100.0]}), "scales must be finite"),
    "zero rotation": (
        ply_bytes(ALL_FLOAT, {name: np.zeros(1) for name in REQUIRED[-4:]}),
        "quaternion 0 must not have length 0",
    ),
}


@pytest.mark.parametrize("case", BAD_PLY)
def test_bad_ply_is_refused_in_one_clear_line(tmp_path, case):
    content, message = BAD_PLY[case]
    path = tmp_path / "bad.ply"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as raised:
        load_scene(path)
    assert "\n" not in str(raised.value)
    assert str(path) in str(raised.value)


float32 = st.floats(-1e6, 1e6, width=32)
unit = st.floats(0, 1, width=32)
positive = st.floats(0, 2.0**100, width=32)


@st.composite
def scenes(draw):
    count, coefficients = draw(st.integers(1, 4)), draw(st.sampled_from([1, 4, 9, 16]))

    def array(elements, *shape):
        size = math.prod(shape)
        values = draw(st.lists(elements, min_size=size, max_size=size))
        return np.array(values, np.float32).reshape(shape)

    quaternions = np.random.default_rng(draw(st.integers(0, 999))).normal(size=(count, 4))
    return Scene(
        array(float32, count, 3),
        normalised_quaternions(quaternions),
        array(positive, count, 3),
        array(unit, count),
        array(float32, count, coefficients, 3),
    )


@given(scenes())
@settings(max_examples=60, deadline=None)
def test_ply_round_trip_stays_within_the_stated_error(tmp_path_factory, scene):
    path = tmp_path_factory.mktemp("ply") / "scene.ply"
    write_ply(scene, path)
    back, _ = load_scene(path)
    assert [p.name for p in path.parent.iterdir()] == ["scene.ply"]
    assert np.array_equal(back.means, scene.means)
    assert np.array_equal(back.sh, scene.sh)
    assert np.abs(back.quaternions - scene.quaternions).max() <= 2e-7
    extreme = (scene.opacities == 0) | (scene.opacities == 1)
    assert np.array_equal(back.opacities[extreme], scene.opacities[extreme])
    assert np.abs(back.opacities - scene.opacities).max() <= 5e-8
    old, new = scene.scales.astype(np.float64), back.scales.astype(np.float64)
    assert not new[old == 0].any()
    normal = old >= np.finfo(np.float32).tiny
    bound = 6e-8 * (np.abs(np.log(old, where=normal, out=np.zeros_like(old))) + 2)
    assert (np.abs(new - old)[normal] <= (bound * old)[normal]).all()
    assert np.abs(new - old)[~normal].max(initial=0) <= 1e-42


def test_ply_round_trip_is_exact_at_the_limits(tmp_path):
    scene, _ = load_scene(tmp_ply(tmp_path))
    limits = Scene(
        *(scene.means, scene.quaternions, np.zeros((2, 3), np.float32)),
        *(np.float32([0, 1]), scene.sh),
    )
    write_ply(limits, tmp_path / "out.ply")
    back, _ = load_scene(tmp_path / "out.ply")
    assert back.opacities.tolist() == [0, 1]
    assert not back.scales.any()


def test_ply_writer_refuses_what_a_logit_cannot_hold(tmp_path):
    scene, _ = load_scene(tmp_ply(tmp_path))
    merged = Scene(scene.means, scene.quaternions, scene.scales, scene.opacities * 2, scene.sh)
    with pytest.raises(InputError, match=r"opacities must be at most 1 .* Gaussian 0 has 1\.46"):
        write_ply(merged, tmp_path / "out.ply")
    with pytest.raises(InputError, match="at least one Gaussian"):
        write_ply(scene.take(np.arange(0)), tmp_path / "out.ply")
    with pytest.raises(InputError, match="cannot be written"):
        write_ply(scene, tmp_path / "missing" / "out.ply")
    assert not (tmp_path / "out.ply").exists()


def tmp_ply(folder: Path) -> Path:
    path = folder / "scene.ply"
    path.write_bytes(simple_ply())
    return path


def test_splat_records(tmp_path):
    record = np.float32([1, -2, 3, 0.1, 0.2, 0.3]).tobytes() + bytes([255, 0, 51, 128])
    other = np.float32([0] * 6).tobytes() + bytes([1, 2, 3, 255])
    content = record + bytes([0, 128, 128, 128]) + other + bytes([128, 255, 1, 192])
    scene = scene_of(tmp_path / "a.splat", content)
    assert scene.means.tolist() == [[1, -2, 3], [0, 0, 0]]
    assert scene.scales[0].tolist() == np.float32([0.1, 0.2, 0.3]).tolist()
    assert scene.opacities.tolist() == [np.float32(128 / 255), 1]
    colour = 0.5 + 0.28209479177387814 * scene.sh[0, 0].astype(np.float64)
    assert np.allclose(colour, [1, 0, 0.2], atol=1e-6)
    assert scene.quaternions[0].tolist() == [-1, 0, 0, 0]
    length = math.sqrt(127**2 + 127**2 + 64**2)
    assert np.allclose(scene.quaternions[1], np.array([0, 127, -127, 64]) / length, atol=1e-7)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty"),
        (bytes(33), "multiple of 32 bytes, not 33"),
        (bytes([0] * 28 + [128] * 4), "quaternion 0 must not have length 0"),
        (np.float32([np.nan] * 8).tobytes(), "means must be finite"),
        (np.float32([0, 0, 0, -1, 0, 0, 0, 0]).tobytes(), "scales must be >= 0"),
    ],
)
def test_bad_splat_is_refused(tmp_path, content, message):
    path = tmp_path / "bad.splat"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        load_scene(path)


def test_format_is_chosen_by_extension_else_by_content(tmp_path):
    assert len(scene_of(tmp_path / "model", simple_ply(3))) == 3
    (tmp_path / "image.png").write_bytes(b"\x89PNG")
    with pytest.raises(InputError, match=r"one of the formats INRIA \.ply"):
        load_scene(tmp_path / "image.png")
    with pytest.raises(InputError, match="scene does not exist"):
        load_scene(tmp_path / "nowhere.ply")
    with pytest.raises(InputError, match="cannot be read"):
        load_scene(tmp_path / ("a" * 5000))
    with pytest.raises(InputError, match=r"either lod-meta\.json or meta\.json, not neither"):
        load_scene(tmp_path)
    with pytest.raises(InputError, match=r"level 0 was asked for, but only lod-meta\.json"):
        load_scene(tmp_ply(tmp_path), level=0)


PERCENTILES = {  # 1st and 99th of the means; 5th, 50th, 95th of the opacity (docs/data.md)
    "donut/fused.ply": (45_624, 0, (-0.098, -0.091, 0.001), (0.103, 0.106, 0.082), (2, 65, 99)),
    "train_1000/train-1000.ply": (1_000, 3, (-4.6, -1.0, -2.5), (5.3, 1.0, 6.7), (2, 18, 69)),
    "istanbul_tile/tile_x001_y000.splat": (
        *(33_620, 0, (33.9, -95.2, -2.8), (71.8, -60.8, 5.5), (4, 39, 98)),
    ),
    "st_peter/st-peter.sog": (
        *(133_618, 0, (-0.79, -2.18, -0.61), (0.84, 1.28, 0.71), (2, 30, 100)),
    ),
    "playbot_lod": (500_000, 2, (-1.01, -0.98, -1.01), (1.01, 0.02, 1.01), (17, 68, 100)),
}


@pytest.mark.real_data
@pytest.mark.parametrize("name", PERCENTILES)
def test_real_scene_has_its_known_statistics(name):
    count, degree, low, high, opacity = PERCENTILES[name]
    scene, files = load_scene(data_file(f"scenes/{name}"))
    assert (len(scene), scene.sh_degree) == (count, degree)
    assert len(files) == (9 if name == "playbot_lod" else 1)
    digits = 3 if name.startswith("donut") else 2 if abs(low[0]) < 2 else 1
    for expected, percent in ((low, 1), (high, 99)):
        measured = np.percentile(scene.means.astype(np.float64), percent, axis=0)
        assert np.abs(measured - expected).max() <= 0.51 * 10**-digits
    assert np.round(100 * np.percentile(scene.opacities, [5, 50, 95])).tolist() == list(opacity)


DATA_TABLE = Path(__file__).resolve().parents[2] / "docs" / "data.md"


@pytest.mark.real_data
def test_data_files_are_those_of_the_documentation():
    rows = re.findall(
        r"^\| `([^`]+)` \| `([0-9a-f]{64})` \|$", DATA_TABLE.read_text(), re.MULTILINE
    )
    assert len(rows) == len({name for name, _ in rows}) >= 66
    present = [(data_root() / name, digest) for name, digest in rows]
    present = [(path, digest) for path, digest in present if path.exists()]
    if not present:
        pytest.skip(f"needs files of docs/data.md below {data_root()}")
    for path, digest in present:
        assert hashlib.sha256(path.read_bytes()).hexdigest() == digest, path
