"""SOG version 2, against a decoder that goes value by value."""

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
from gaussians.formats import load_scene

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
