"""SPZ: the reader against a decoder that goes value by value, axes, errors per field, bombs."""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.errors import InputError
from gaussians.formats import fit_scene, load_scene, save_scene, write_spz
from gaussians.formats.spz import fit_spz
from gaussians.scene import Scene, normalised_quaternions
from gaussians.spherical_harmonics import fill_colours
from tests.gaussians.real_data import data_file

HIGHER = (0, 3, 8, 15)
REAL = ["donut/fused.ply", "st_peter/st-peter.sog", "istanbul_tile/tile_x001_y000.splat"]


def payload(version: int, degree: int, count: int = 4, seed: int = 0, /, **header: int) -> bytes:
    """A valid uncompressed SPZ; ``header`` replaces fields of the header."""
    rng = np.random.default_rng(seed)
    fields = {"magic": 0x5053474E, "version": version, "count": count, "degree": degree}
    fields |= {"bits": 12, "flags": 1, "reserved": 0, **header}
    rotations = rng.integers(60, 196, (count, 3)).astype(np.uint8).tobytes()
    if version == 3:
        three = rng.integers(0, 512, (count, 3)) * 2 // 3 | rng.integers(0, 2, (count, 3)) << 9
        word = np.arange(count) % 4 << 30 | three[:, 0] << 20 | three[:, 1] << 10 | three[:, 2]
        rotations = word.astype("<u4").tobytes()
    start = struct.pack("<IIIBBBB", *fields.values())
    return start + rng.bytes(16 * count) + rotations + rng.bytes(3 * HIGHER[degree] * count)


def packed(content: bytes) -> bytes:
    packer = zlib.compressobj(wbits=31)
    return packer.compress(content) + packer.flush()


def load(folder: Path, content: bytes) -> Scene:
    path = folder / "a.spz"
    path.write_bytes(content)
    scene, files = load_scene(path)
    assert files == [path]
    return scene


def naive_gaussian(content: bytes, i: int) -> dict[str, list[float]]:
    """Gaussian i in the axes of the file, straight from the format's description."""
    _, version, count, degree, bits, _, _ = struct.unpack("<IIIBBBB", content[:16])
    sizes = [9, 1, 3, 3, 3 if version == 2 else 4, 3 * HIGHER[degree]]
    starts = [16 + count * sum(sizes[:k]) for k in range(6)]
    row = [content[s + i * n : s + (i + 1) * n] for s, n in zip(starts, sizes, strict=True)]
    mean = [int.from_bytes(row[0][k : k + 3], "little", signed=True) / 2**bits for k in (0, 3, 6)]
    if version == 2:
        x, y, z = (b / 127.5 - 1 for b in row[4])
        quaternion = [math.sqrt(1 - x * x - y * y - z * z), x, y, z]
    else:
        word = int.from_bytes(row[4], "little")
        kept = []
        for shift in (20, 10, 0):
            magnitude = (word >> shift & 511) / 511 * math.sqrt(0.5)
            kept.append(-magnitude if word >> shift & 512 else magnitude)
        kept.insert(word >> 30, math.sqrt(1 - sum(v * v for v in kept)))
        quaternion = [kept[3], *kept[:3]]
    return {
        "means": mean,
        "opacities": [row[1][0] / 255],
        "sh": [(b / 255 - 0.5) / 0.15 for b in row[2]] + [(b - 128) / 128 for b in row[5]],
        "scales": [math.exp(b / 16 - 10) for b in row[3]],
        "quaternions": quaternion,
    }


def turned(scene: Scene) -> Scene:
    """The scene after half a turn about x, by its definition: matrices, not sign tables.

    The harmonics are left out.
    """
    return replace(
        scene,
        means=scene.means * np.float32([1, -1, -1]),
        quaternions=scene.quaternions * np.float32([1, 1, -1, -1]),
    )


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_equals_a_value_by_value_decoder(tmp_path, version, degree):
    content = payload(version, degree, 23)
    scene = load(tmp_path, packed(content))
    assert (len(scene), scene.sh_degree) == (23, degree)
    as_stored = turned(scene)
    for i in range(23):
        expected = naive_gaussian(content, i)
        for field in ("means", "quaternions", "scales", "opacities"):
            found = np.ravel(getattr(as_stored, field)[i])
            assert np.allclose(found, expected[field], rtol=2e-7, atol=2e-7), (field, i)
        # the sign of each coefficient is the next test's matter
        assert np.allclose(np.abs(np.ravel(scene.sh[i])), np.abs(expected["sh"]), atol=1e-6)
        assert np.allclose(scene.sh[i, 0], expected["sh"][:3], atol=1e-6)


def colours(scene: Scene, eye: np.ndarray) -> np.ndarray:
    features = np.zeros((1, len(scene), 10), np.float32)
    ids, needed = np.arange(len(scene), dtype=np.int32), np.ones(len(scene), bool)
    fill_colours(features, ids, needed, scene.means, scene.sh, eye[None])
    return features[0, :, 7:]


def test_the_half_turn_keeps_every_colour_and_covariance(tmp_path):
    content = payload(3, 3, 40)
    scene = load(tmp_path, packed(content))
    stored = turned(scene)
    raw = np.array([naive_gaussian(content, i)["sh"] for i in range(40)], np.float32)
    stored = replace(stored, sh=raw.reshape(40, 16, 3) + np.float32([3] + [0] * 15)[None, :, None])
    scene = replace(scene, sh=scene.sh + np.float32([3] + [0] * 15)[None, :, None])
    half_turn = np.diag([1.0, -1.0, -1.0])
    for eye in np.random.default_rng(1).normal(size=(5, 3)) * 3000:
        seen = colours(scene, half_turn @ eye)
        assert seen.max() > 1
        assert np.allclose(seen, colours(stored, eye), atol=1e-5)
    from gaussians.rotations import rotations_from_quaternions

    for one, other in zip(
        *(rotations_from_quaternions(s.quaternions.astype(np.float64)) for s in (scene, stored)),
        strict=True,
    ):
        spread = np.diag([1.0, 4.0, 9.0])
        turned_back = half_turn @ (other @ spread @ other.T) @ half_turn
        assert np.allclose(one @ spread @ one.T, turned_back, atol=1e-6)


BAD = {
    "magic": (packed(payload(3, 0, magic=1)), "must begin with the SPZ header"),
    "version 1": (packed(payload(3, 0, version=1)), "SPZ version must be 2 or 3, not 1"),
    "version 4": (packed(payload(3, 0, version=4)), "SPZ version must be 2 or 3, not 4"),
    "degree 4": (packed(payload(3, 0, degree=4)), "SH degree must be 0 to 3, not 4"),
    "bits": (packed(payload(3, 0, bits=24)), "fractional bits must be 0 to 23, not 24"),
    "extensions": (packed(payload(3, 0, flags=2)), "extensions are not supported"),
    "reserved": (packed(payload(3, 0, reserved=9)), "reserved byte 0, not 1 and 9"),
    "empty": (packed(payload(3, 0, 0)), "empty"),
    "too many": (packed(payload(3, 0, count=5)), "truncated: 5 Gaussians must have 100 bytes"),
    "too few": (packed(payload(3, 0, count=3)), "trailing bytes after 3 Gaussians"),
    "header": (packed(bytes(15)), "an SPZ header must have 16 bytes"),
    "nothing": (b"", "an SPZ header must have 16 bytes"),
    "not gzip": (payload(3, 0), "must be an intact gzip stream"),
    "checksum": (packed(payload(3, 0))[:-8] + bytes(8), "must be an intact gzip stream"),
    "no checksum": (packed(payload(3, 0))[:-8], "truncated: 4 Gaussians .* and a checksum"),
    "second stream": (packed(payload(3, 0)) * 2, "trailing bytes"),
    "bomb": (
        packed(payload(3, 0, 1, count=2**21) + bytes(20 * (2**21 - 1))),
        "bytes must not expand to 2097152 Gaussians",
    ),
    "rotation": (
        packed(payload(3, 0, 1)[:32] + struct.pack("<I", 0x3FFFFFFF)),
        "rotation of Gaussian 0 must be a unit quaternion",
    ),
    "first three": (
        packed(payload(2, 0, 1)[:32] + bytes([255, 255, 0])),
        "rotation of Gaussian 0 must be a unit quaternion",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_spz_is_refused_in_one_clear_line(tmp_path, case):
    content, message = BAD[case]
    with pytest.raises(InputError, match=message) as raised:
        load(tmp_path, content)
    assert "\n" not in str(raised.value)


def test_rounding_beyond_length_one_is_not_damage(tmp_path):
    scene = load(tmp_path, packed(payload(2, 0, 1)[:32] + bytes([255, 128, 128])))
    assert np.allclose(scene.quaternions[0], [0, 1, -1 / 255, -1 / 255], atol=1e-4)


def test_an_spz_without_extension_is_known_by_its_first_bytes(tmp_path):
    (tmp_path / "model").write_bytes(packed(payload(3, 1)))
    assert load_scene(str(tmp_path / "model"))[0].sh_degree == 1


def random_scene(seed: int, extent: float, degree: int = 3, count: int = 200) -> Scene:
    """Gaussians that an SPZ can hold, up to and including the limits."""
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(count, 4)) * rng.choice([1e-3, 1, 30], size=(count, 4))
    sh = np.concatenate(
        [rng.uniform(-10 / 3, 10 / 3, (count, 1, 3)), rng.uniform(-1, 1, (count, 15, 3))], axis=1
    )
    sh[:, 1:] = sh[:, 1:].clip(-0.992, 0.992)
    return Scene(
        rng.uniform(-extent, extent, (count, 3)).astype(np.float32),
        normalised_quaternions(quaternions),
        np.exp(rng.uniform(-10, 5.93, (count, 3))).astype(np.float32),
        rng.choice([0, 1, 0.5, 0.123], size=count).astype(np.float32),
        sh[:, : (degree + 1) ** 2].astype(np.float32),
    )


@given(st.integers(0, 10**6), st.sampled_from([1e-6, 0.3, 8, 4095.9, 1e6]), st.integers(0, 3))
@settings(max_examples=30, deadline=None)
def test_spz_round_trip_stays_within_the_stated_errors(tmp_path_factory, seed, extent, degree):
    scene = random_scene(seed, extent, degree)
    path = tmp_path_factory.mktemp("spz") / "a.spz"
    save_scene(scene, path)
    assert [p.name for p in path.parent.iterdir()] == ["a.spz"]
    back = load_scene(path)[0]
    assert_within_stated_errors(scene, back)
    write_spz(back, path)
    assert_equal_after_second_trip(back, load_scene(path)[0])


def assert_within_stated_errors(scene: Scene, back: Scene) -> None:
    farthest = float(np.abs(scene.means).max())
    wide = {f: getattr(scene, f).astype(np.float64) for f in ("means", "scales", "opacities", "sh")}
    off = {f: np.abs(getattr(back, f) - values) for f, values in wide.items()}
    assert off["means"].max() <= max(farthest / 8e6, 6e-8)
    assert off["opacities"].max() <= 0.00197
    assert off["sh"][:, 0].max() <= 0.0131
    assert off["sh"][:, 1:].max(initial=0) <= 1 / 256 + 1e-7
    assert np.abs(np.log(back.scales / wide["scales"])).max() <= 1 / 32 + 1e-6
    sign = np.sign((scene.quaternions * back.quaternions).sum(axis=1, keepdims=True))
    assert np.abs(back.quaternions * sign - scene.quaternions).max() <= 0.0022


def assert_equal_after_second_trip(first: Scene, second: Scene) -> None:
    """What was rounded once is not rounded again."""
    for field in ("means", "scales", "opacities", "sh"):
        assert np.array_equal(getattr(first, field), getattr(second, field)), field
    sign = np.sign((first.quaternions * second.quaternions).sum(axis=1, keepdims=True))
    assert np.abs(first.quaternions - sign * second.quaternions).max() <= 0.0022


def test_spz_writer_names_what_would_be_lost_and_fit_drops_it(tmp_path):
    scene = random_scene(5, 1.0, count=5)
    opacities = np.float32([0.5, 2, 1, 1, 0])
    scales = scene.scales.copy()
    scales[0], scales[1, 0] = 0, 500
    sh = scene.sh.copy()
    sh[2, 0, 1], sh[3, 4, 0], sh[3, 5, 0] = 4, 1.5, -1.5
    wild = replace(scene, opacities=opacities, scales=scales, sh=sh)
    path = tmp_path / "a.spz"
    message = (
        r"SPZ cannot hold 1 opacities above 1, 4 scales outside 4\.5e-5\.\.379, "
        r"1 base colours f_dc outside -3\.33\.\.3\.33, 2 harmonics outside -1\.\.0\.992"
    )
    with pytest.raises(InputError, match=message):
        save_scene(wild, path)
    assert not list(tmp_path.iterdir())
    fitted, lost = fit_scene(wild, path)
    assert list(lost.values()) == [1, 4, 1, 2]
    save_scene(fitted, path)
    assert_within_stated_errors(fitted, load_scene(path)[0])
    changed = np.abs(fitted.sh - wild.sh) > 0
    assert changed.sum() == 3
    assert fit_scene(fitted, path)[1] == {}
    same, nothing = fit_spz(scene)
    assert nothing == {}
    assert all(np.array_equal(getattr(same, f), getattr(scene, f)) for f in ("scales", "sh"))


def test_spz_means_may_be_far_but_not_too_far(tmp_path):
    scene = random_scene(1, 1.0, 0, 2)
    far = replace(scene, means=np.float32([[2**23 - 1, 0, 0], [1, -(2**23 - 1), 5]]))
    save_scene(far, tmp_path / "a.spz")
    assert np.array_equal(load_scene(tmp_path / "a.spz")[0].means, far.means)
    with pytest.raises(InputError, match="SPZ means must lie within 8388607 units"):
        save_scene(replace(far, means=far.means * 2), tmp_path / "a.spz")
    with pytest.raises(InputError, match="at least one Gaussian"):
        save_scene(scene.take(np.arange(0)), tmp_path / "b.spz")


@pytest.mark.real_data
@pytest.mark.parametrize("name", REAL)
def test_real_scenes_survive_an_spz(tmp_path, name):
    scene = load_scene(data_file(f"scenes/{name}"))[0]
    fitted, lost = fit_scene(scene, "a.spz")
    assert sum(lost.values()) < 0.35 * scene.scales.size, lost
    save_scene(fitted, tmp_path / "a.spz")
    back = load_scene(tmp_path / "a.spz")[0]
    assert_within_stated_errors(fitted, back)
