"""SOG version 2 and lod-meta.json, against a decoder that goes value by value."""

from __future__ import annotations

import io
import json
import math
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussians.errors import InputError
from gaussians.formats import load_lod_set, load_scene
from tests.gaussians.real_data import data_file

BANDS_OF_DEGREE = {1: 3, 2: 8, 3: 15}
Files = dict[str, bytes]


def webp(pixels: np.ndarray, lossless: bool = True) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "WEBP", lossless=lossless, exact=True)
    return stream.getvalue()


def random_sog(count: int, degree: int, seed: int = 0) -> Files:
    """The files of a random, valid SOG data set in images of 5 columns with padding."""
    rng = np.random.default_rng(seed)
    side = (-(-count // 5) + 1, 5)
    images = {
        name: rng.integers(0, 256, (*side, 4)).astype(np.uint8)
        for name in ("means_l", "means_u", "scales", "sh0", "quats")
    }
    images["quats"][..., :3] = rng.integers(60, 196, (*side, 3))  # inside the unit sphere
    images["quats"][..., 3] = rng.integers(252, 256, side)
    codebook = sorted(rng.normal(size=256))
    meta = {
        "version": 2,
        "count": count,
        "means": {
            "mins": [-2, -1, 0],
            "maxs": [2, 3, 0],
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"codebook": codebook, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": codebook, "files": ["sh0.webp"]},
    }
    if degree:
        entries = 300  # five rows of 64, the last one not full
        images["centroids"] = rng.integers(0, 256, (5, 64 * BANDS_OF_DEGREE[degree], 4), np.uint8)
        labels = rng.integers(0, entries, side)
        images["labels"] = np.stack([labels % 256, labels // 256, labels, labels], axis=-1).astype(
            np.uint8
        )
        files = ["centroids.webp", "labels.webp"]
        meta["shN"] = {"count": entries, "bands": degree, "codebook": codebook, "files": files}
    result = {f"{name}.webp": webp(pixels) for name, pixels in images.items()}
    result["meta.json"] = json.dumps(meta).encode()
    return result


def as_folder(folder: Path, files: Files) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder


def as_archive(path: Path, files: Files) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def with_meta(files: Files, **changes: object) -> Files:
    """The files with members of meta.json replaced; ``group__key`` reaches into a group."""
    meta = json.loads(files["meta.json"])
    for path, value in changes.items():
        group, _, key = path.rpartition("__")
        (meta[group] if group else meta)[key] = value
    return {**files, "meta.json": json.dumps(meta).encode()}


def naive_gaussian(files: Files, i: int) -> dict[str, list[float]]:
    """Gaussian i, straight from the format's description."""
    meta = json.loads(files["meta.json"])

    def pixel(name: str, at: tuple[int, int] | None = None) -> tuple[int, ...]:
        image = Image.open(io.BytesIO(files[name])).convert("RGBA")
        return image.getpixel(at or (i % image.width, i // image.width))

    low, high = (pixel(name) for name in meta["means"]["files"])
    mean = []
    for axis in range(3):
        least, most = meta["means"]["mins"][axis], meta["means"]["maxs"][axis]
        t = least + (most - least) * (low[axis] + 256 * high[axis]) / 65535
        mean.append(math.copysign(math.exp(abs(t)) - 1, t))
    r, g, b, a = pixel("quats.webp")
    quaternion = [(v / 255 * 2 - 1) / math.sqrt(2) for v in (r, g, b)]
    quaternion.insert(a - 252, math.sqrt(1 - sum(v * v for v in quaternion)))
    *colour, alpha = pixel("sh0.webp")
    harmonics = [meta["sh0"]["codebook"][byte] for byte in colour]
    if "shN" in meta:
        red, green, *_ = pixel("labels.webp")
        label, bands = red + 256 * green, BANDS_OF_DEGREE[meta["shN"]["bands"]]
        for k in range(bands):
            entry = pixel("centroids.webp", (label % 64 * bands + k, label // 64))
            harmonics += [meta["shN"]["codebook"][byte] for byte in entry[:3]]
    scale = [math.exp(meta["scales"]["codebook"][byte]) for byte in pixel("scales.webp")[:3]]
    return {
        "means": mean,
        "quaternions": quaternion,
        "scales": scale,
        "opacities": [alpha / 255],
        "sh": harmonics,
    }


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sog_equals_a_value_by_value_decoder(tmp_path, degree):
    files = random_sog(23, degree)
    scene, read = load_scene(as_folder(tmp_path / "sog", files))
    assert sorted(p.name for p in read) == sorted(files)
    assert (len(scene), scene.sh_degree) == (23, degree)
    for i in range(23):
        for field, expected in naive_gaussian(files, i).items():
            assert np.allclose(
                np.ravel(getattr(scene, field)[i]), expected, rtol=2e-7, atol=1e-7
            ), (field, i)


def test_archive_folder_and_meta_path_hold_the_same_gaussians(tmp_path):
    files = random_sog(9, 2)
    folder = as_folder(tmp_path / "sog", files)
    archive = as_archive(tmp_path / "a.sog", {**files, "../evil.webp": b"never read"})
    reference, _ = load_scene(folder)
    for path in (archive, folder / "meta.json", archive.rename(tmp_path / "no_extension")):
        if not path.exists():
            path = as_archive(path, files)
        scene, read = load_scene(path)
        assert read[0] == path
        for field in ("means", "quaternions", "scales", "opacities", "sh"):
            assert np.array_equal(getattr(scene, field), getattr(reference, field))
    assert not (tmp_path / "evil.webp").exists()


GOOD = random_sog(9, 1)
TINY_IMAGE = webp(np.zeros((2, 2, 4), np.uint8))
BAD_QUATERNION = np.full((3, 5, 4), 255, np.uint8)
BAD_INDEX = np.full((3, 5, 4), 128, np.uint8)
HIGH_LABEL = np.full((3, 5, 4), 200, np.uint8)
BAD_SOG = {
    "version 1": (with_meta(GOOD, version=1), "SOG version must be 2, not 1"),
    "no version": ({**GOOD, "meta.json": b"{}"}, "SOG version must be 2, not None"),
    "not json": ({**GOOD, "meta.json": b"{"}, "must be a JSON document"),
    "deep json": ({**GOOD, "meta.json": b"[" * 100_000}, "must be a JSON document"),
    "list": ({**GOOD, "meta.json": b"[]"}, "must be a JSON object, not a list"),
    "empty": (with_meta(GOOD, count=0), "empty"),
    "float count": (with_meta(GOOD, count=9.0), "count must be an integer"),
    "true count": (with_meta(GOOD, count=True), "count must be an integer"),
    "large count": (with_meta(GOOD, count=16), "webp: must have 16 to .* not 5 x 3 = 15"),
    "infinite": ({**GOOD, "meta.json": b'{"count": Infinity}'}, "must be finite, not Infinity"),
    "codebook": (with_meta(GOOD, scales__codebook=[1.0] * 255), "list of 256 finite numbers"),
    "missing group": (with_meta(GOOD, sh0={}), "must have the key 'files'"),
    "mins": (with_meta(GOOD, means__mins=[3, 9, 9]), "mins must not exceed maxs"),
    "path": (with_meta(GOOD, sh0__files=["../sh0.webp"]), "plain file names, not '../sh0.webp'"),
    "absolute": (with_meta(GOOD, sh0__files=["/etc/passwd"]), "plain file names"),
    "folder": (with_meta(GOOD, sh0__files=["a/sh0.webp"]), "plain file names, not 'a/sh0.webp'"),
    "drive": (with_meta(GOOD, sh0__files=["C:\\x.webp"]), "plain file names"),
    "surrogate": (with_meta(GOOD, sh0__files=["\ud800"]), "plain file names, not '.ud800'"),
    "newline": (with_meta(GOOD, sh0__files=["a\nb"]), "plain file names, not 'a.nb'"),
    "long name": (with_meta(GOOD, sh0__files=["a" * 300]), "plain file names, not 'a+[.]{3}"),
    "number": (with_meta(GOOD, sh0__files=[3]), "plain file names, not 3"),
    "missing file": (
        with_meta(GOOD, sh0__files=["x.webp"]),
        "x.webp.* (exactly once|cannot be read)",
    ),
    "small image": ({**GOOD, "sh0.webp": TINY_IMAGE}, "must have 9 to .* not 2 x 2 = 4"),
    "bomb": (
        {**GOOD, "sh0.webp": webp(np.zeros((300, 300, 4), np.uint8))},
        "must have 9 to 65572 pixels, not 300 x 300",
    ),
    "file size": ({**GOOD, "sh0.webp": bytes(2**21)}, "must hold at most 1573152 bytes"),
    "lossy": (
        {**GOOD, "sh0.webp": webp(np.zeros((3, 5, 3), np.uint8), lossless=False)},
        "must be a still, lossless WebP image",
    ),
    "not webp": ({**GOOD, "sh0.webp": b"GIF89a"}, "must be a WebP image"),
    "truncated": ({**GOOD, "sh0.webp": GOOD["sh0.webp"][:-9]}, "truncated"),
    "damaged": (
        {**GOOD, "sh0.webp": GOOD["sh0.webp"][:40] + bytes(len(GOOD["sh0.webp"]) - 40)},
        "must be an intact WebP image",
    ),
    "omitted index": ({**GOOD, "quats.webp": webp(BAD_INDEX)}, "alpha must be 252 to 255"),
    "not unit": (
        {**GOOD, "quats.webp": webp(BAD_QUATERNION)},
        "Gaussian 0 must be a unit quaternion",
    ),
    "label": ({**GOOD, "labels.webp": webp(HIGH_LABEL)}, "labels must be below count 300"),
    "bands": (with_meta(GOOD, shN__bands=4), "bands must be an integer from 1 to 3"),
    "centroids": (with_meta(GOOD, shN__bands=2), "centroids.webp: must have"),
}


@pytest.mark.parametrize("case", BAD_SOG)
def test_bad_sog_is_refused_in_one_clear_line(tmp_path, case):
    files, message = BAD_SOG[case]
    for path in (as_folder(tmp_path / "f", files), as_archive(tmp_path / "a.sog", files)):
        with pytest.raises(InputError, match=message) as raised:
            load_scene(path)
        assert "\n" not in str(raised.value)


def test_an_archive_cannot_inflate_beyond_what_its_directory_says(tmp_path):
    path = as_archive(tmp_path / "a.sog", {**GOOD, "meta.json": b"{}" + b" " * 2**25})
    content = bytearray(path.read_bytes())
    for signature, size_at in ((b"PK\x01\x02", 24), (b"PK\x03\x04", 22)):
        at = content.rindex(signature)  # meta.json is the last member
        assert b"meta.json" in content[at : at + 80]
        content[at + size_at : at + size_at + 4] = (100).to_bytes(4, "little")
    path.write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="must be an intact, unencrypted zip archive"):
            load_scene(path)
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_methods_that_inflate_without_bound_are_refused(tmp_path, method):
    with zipfile.ZipFile(tmp_path / "a.sog", "w", method) as archive:
        archive.writestr("meta.json", bytes(10**6))
    with pytest.raises(InputError, match=r"meta\.json must be stored or deflated"):
        load_scene(tmp_path / "a.sog")


def test_a_small_file_cannot_claim_millions_of_gaussians(tmp_path):
    flat = webp(np.zeros((1000, 1000, 4), np.uint8))
    files = {**with_meta(GOOD, count=10**6), "means_l.webp": flat}
    with pytest.raises(InputError, match=r"bytes must not expand to 1000000 Gaussians"):
        load_scene(as_folder(tmp_path, files))


def test_numbers_beyond_floats_are_refused(tmp_path):
    huge = with_meta(GOOD, means__mins=[10**400, 0, 0])
    with pytest.raises(InputError, match="mins must be a list of 3 finite numbers"):
        load_scene(as_folder(tmp_path, huge))
    wide = with_meta(GOOD, sh0__codebook=[1e300] * 256)
    with pytest.raises(InputError, match="sh must be finite"):
        load_scene(as_folder(tmp_path, wide))


def test_damaged_archives_are_refused(tmp_path):
    path = as_archive(tmp_path / "a.sog", GOOD)
    content = bytearray(path.read_bytes())
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="intact, unencrypted zip archive"):
        load_scene(path)
    at = content.index(b"means_l.webp") + 200
    content[at : at + 8] = b"\xff" * 8
    path.write_bytes(content)
    with pytest.raises(InputError, match="intact, unencrypted zip archive"):
        load_scene(path)
    with pytest.warns(UserWarning, match="Duplicate name"), zipfile.ZipFile(path, "w") as archive:
        for _ in range(2):
            archive.writestr("meta.json", GOOD["meta.json"])
    with pytest.raises(InputError, match=r"'meta\.json' exactly once, not 2 times"):
        load_scene(path)


BOX = {"min": [-9, -9, -9], "max": [99, 99, 99]}


def pyramid(folder: Path, **changes: object) -> Path:
    """Two levels: level 0 has 9 + 5 Gaussians in two files, level 1 has 4 in one, with a gap."""
    as_folder(folder / "0_0", random_sog(9, 1, seed=1))
    as_folder(folder / "0_1", random_sog(5, 1, seed=2))
    as_archive(folder / "1_0.sog", random_sog(6, 0, seed=3))

    def leaf(**lods: tuple[int, int, int]) -> dict[str, object]:
        keys = ("file", "offset", "count")
        return {
            "bound": BOX,
            "lods": {level[1:]: dict(zip(keys, v, strict=True)) for level, v in lods.items()},
        }

    leaves = [
        leaf(L0=(2, 0, 5), L1=(1, 4, 2)),
        leaf(L0=(0, 6, 3)),
        leaf(L0=(0, 0, 6), L1=(1, 0, 2)),
    ]
    meta = {
        "lodLevels": 2,
        "environment": None,
        "filenames": ["0_0/meta.json", "1_0.sog", "0_1/meta.json"],
        "tree": {"children": [{"children": leaves[:2]}, leaves[2]]},
        **changes,
    }
    (folder / "lod-meta.json").write_text(json.dumps(meta))
    return folder


def test_one_level_is_the_union_of_its_leaf_ranges(tmp_path):
    folder = pyramid(tmp_path)
    first, second = load_scene(tmp_path / "0_0")[0], load_scene(tmp_path / "0_1")[0]
    coarse = load_scene(tmp_path / "1_0.sog")[0]
    scene, files = load_scene(folder)
    expected = [second.means, first.means[6:9], first.means[:6]]
    assert np.array_equal(scene.means, np.concatenate(expected))
    assert tmp_path / "1_0.sog" not in files
    assert files[0] == tmp_path / "lod-meta.json"
    assert len(files) == 1 + 2 * 8
    scene, files = load_scene(folder / "lod-meta.json", level=1)
    assert np.array_equal(scene.means, coarse.means[[4, 5, 0, 1]])
    assert files == [tmp_path / "lod-meta.json", tmp_path / "1_0.sog"]


def lone(level: str, **entry: object) -> dict[str, object]:
    lods = {level: {"file": 0, "offset": 0, "count": 1, **entry}}
    return {"tree": {"bound": BOX, "lods": lods}}


TWO_RANGES = {"children": [lone("0", count=5)["tree"], lone("0", offset=4)["tree"]]}
BAD_PYRAMID = {
    "environment": ({"environment": "env.sog"}, 0, "environment must be null, not 'env.sog'"),
    "names": ({"filenames": ["../x", "b", "c"]}, 0, "relative paths inside the folder"),
    "names absolute": ({"filenames": ["/x", "b", "c"]}, 0, "relative paths inside the folder"),
    "level 2": ({}, 2, r"level must be one of 0 \(finest\) to 1, not 2"),
    "level -1": ({}, -1, r"level must be one of 0 \(finest\) to 1, not -1"),
    "end": (lone("0", count=10), 0, "must end within its 9 Gaussians, not at 10"),
    "overlap": ({"tree": TWO_RANGES}, 0, "ranges of 0_0/meta.json must not overlap"),
    "file": (lone("0", file=3), 0, "file must be an integer from 0 to 2, not 3"),
    "offset": (lone("0", offset=-1), 0, "offset must be an integer"),
    "version": ({"version": 2}, 0, "version must be 1, not 2"),
    "counts": ({"counts": [13, 4]}, 0, r"the 14 Gaussians .* level 0, not \[13, 4\]"),
    "repeated": ({"filenames": ["a", "b", "a"]}, 0, "filenames must not repeat"),
    "no bound": ({"tree": {"lods": {}}}, 0, "must have the key 'bound'"),
    "bound": (
        {"tree": {"lods": {}, "bound": {"min": [0, 1, 0], "max": [0, 0, 0]}}},
        *(0, "min must not exceed max"),
    ),
    "no lods": ({"tree": {}}, 0, "must have the key 'lods'"),
    "no range": (lone("1"), 0, "level 0 is empty"),
    "empty range": (lone("0", count=0), 0, "level 0 is empty"),
    "file left out": (
        {"filenames": ["9_9/meta.json", "b", "c"]},
        0,
        "9_9/meta.json: cannot be read",
    ),
}


@pytest.mark.parametrize("case", BAD_PYRAMID)
def test_bad_levels_are_refused(tmp_path, case):
    changes, level, message = BAD_PYRAMID[case]
    folder = pyramid(tmp_path, **changes)
    with pytest.raises(InputError, match=message):
        load_scene(folder, level=level)

    with pytest.raises(InputError, match=message):
        load_lod_set(folder / "lod-meta.json", [level])


def test_all_levels_that_are_present_with_their_leaves(tmp_path):
    path = pyramid(tmp_path) / "lod-meta.json"
    lod_set = load_lod_set(str(path))
    assert (lod_set.level_count, sorted(lod_set.levels)) == (2, [0, 1])
    assert lod_set.leaf_boxes.tolist() == [[[-9] * 3, [99] * 3]] * 3
    assert lod_set.leaf_ranges[0].tolist() == [[0, 5], [5, 3], [8, 6]]
    assert lod_set.leaf_ranges[1].tolist() == [[0, 2], [2, 0], [2, 2]]
    assert len(lod_set.files) == len(set(lod_set.files)) == 1 + 2 * 8 + 1
    for level in (0, 1):
        scene, _ = load_scene(path, level)
        leaves = [lod_set.leaf(leaf, level) for leaf in range(3)]
        assert [len(leaf) for leaf in leaves] == lod_set.leaf_ranges[level][:, 1].tolist()
        assert np.array_equal(np.concatenate([leaf.means for leaf in leaves]), scene.means)
    stored = load_scene(tmp_path / "0_0")[0]
    assert np.array_equal(lod_set.leaf(1, 0).means, stored.means[6:9])


def test_levels_without_files_are_left_out_but_not_levels_that_lack_some(tmp_path):
    path = pyramid(tmp_path) / "lod-meta.json"
    (tmp_path / "1_0.sog").unlink()
    assert sorted(load_lod_set(path).levels) == [0]
    with pytest.raises(InputError, match=r"1_0\.sog: cannot be read"):
        load_lod_set(path, [1])
    (tmp_path / "0_1" / "meta.json").unlink()
    with pytest.raises(InputError, match=r"0_1/meta\.json: cannot be read"):
        load_lod_set(path)
    (tmp_path / "0_0" / "meta.json").unlink()
    with pytest.raises(InputError, match="no level of the scene is present"):
        load_lod_set(path)


def test_a_folder_with_two_scenes_must_be_named_by_file(tmp_path):
    pyramid(tmp_path)
    as_folder(tmp_path, GOOD)
    with pytest.raises(InputError, match="not both"):
        load_scene(tmp_path)


@pytest.mark.real_data
def test_playbot_levels_have_their_known_counts():
    folder = data_file("scenes/playbot_lod")
    counts = [500_000, 250_000, 125_000, 31_000, 8_406, 3_000, 1_873]
    for level in range(1, 7):
        scene, files = load_scene(folder, level)
        assert (len(scene), scene.sh_degree, len(files)) == (counts[level], 2, 9)
    lod_set = load_lod_set(folder / "lod-meta.json", range(2, 7))
    assert {level: len(scene) for level, scene in lod_set.levels.items()} == dict(
        zip(range(2, 7), counts[2:], strict=True)
    )
    for level, ranges in lod_set.leaf_ranges.items():
        assert ranges[:, 1].sum() == counts[level]
        for leaf, (low, high) in enumerate(lod_set.leaf_boxes):
            means = lod_set.leaf(leaf, level).means
            assert (means >= low).all()
            assert (means <= high).all()
    with pytest.raises(InputError, match=r"0 \(finest\) to 6, not 7"):
        load_scene(folder, 7)
