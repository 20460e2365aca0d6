"""Small valid scenes for ``fuzz_formats`` as named parts (header, body, images), and attacks."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from PIL import Image

Parts = dict[str, bytes]
READERS = ("ply", "compressed_ply", "splat", "spz", "sog", "lod_meta", "layout")


@dataclass(frozen=True)
class Target:
    """One reader's valid scene, as parts, and the file to load once they are packed."""

    entry: str
    parts: Parts
    pack: Callable[[Parts], Parts]  # parts to files by relative name
    bombs: list[Parts] = field(default_factory=list)  # files of ready-made attacks


def _ply() -> Target:
    names = ["x", "y", "z", "nx", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(9))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    body = np.random.default_rng(1).normal(size=(3, len(names))).astype("<f4").tobytes()
    header = _ply_header([("vertex", 3, [("float", name) for name in names])])
    return Target("a.ply", {"header": header, "body": body}, _joined("a.ply"))


def _compressed_ply() -> Target:
    ends = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"]
    limits = [("float", f"{end}_{name}") for end in ("min", "max") for name in ends]
    packed = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    elements = [("chunk", 2, limits), ("vertex", 257, [("uint", name) for name in packed])]
    elements.append(("sh", 257, [("uchar", f"f_rest_{i}") for i in range(9)]))
    rng = np.random.default_rng(2)
    chunks = np.repeat([[-1.0] * 9 + [1.0] * 9], 2, axis=0).astype("<f4").tobytes()
    words = rng.integers(0, 2**32, (257, 4)).astype("<u4")
    words[:, 1] = rng.integers(0, 4, 257) << 30 | 500 << 20 | 510 << 10 | 520
    parts = {"header": _ply_header(elements), "chunks": chunks, "words": words.tobytes()}
    return Target("a.ply", {**parts, "sh": rng.bytes(257 * 9)}, _joined("a.ply"))


def _ply_header(elements: list[tuple[str, int, list[tuple[str, str]]]]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", "comment x"]
    for name, count, properties in elements:
        lines.append(f"element {name} {count}")
        lines += [f"property {kind} {column}" for kind, column in properties]
    return "\n".join([*lines, "end_header", ""]).encode()


def _splat() -> Target:
    records = [
        np.float32([1, 2, 3, 0.1, 0.2, 0.3]).tobytes() + bytes([9, 8, 7, 6, 255, 0, 128, 128])
        for _ in range(4)
    ]
    return Target("a.splat", {"body": b"".join(records)}, _joined("a.splat"))


def _spz() -> Target:
    rng = np.random.default_rng(3)
    count = 5
    rotations = (np.arange(count, dtype="<u4") % 4 << 30 | 99 << 20 | 600 << 10 | 50).tobytes()
    body = {"fixed": rng.bytes(16 * count), "rotations": rotations, "sh": rng.bytes(9 * count)}

    def header(version: int = 3, points: int = count, degree: int = 1) -> bytes:
        return struct.pack("<IIIBBBB", 0x5053474E, version, points, degree, 12, 1, 0)

    def packed(parts: Parts) -> Parts:
        packer = zlib.compressobj(1, wbits=31)
        return {"a.spz": packer.compress(b"".join(parts.values())) + packer.flush()}

    bombs = [
        packed({"header": header(points=points, degree=degree), "zeros": bytes(size)})
        for points, degree, size in (
            *((2**32 - 1, 0, 2**24), (2**32 - 1, 3, 10), (2**20, 0, 20 * 2**20)),
            *((2**24, 0, 2**24), (3, 0, 2**25), (0, 0, 0)),
        )
    ]
    bombs.append(packed({"header": header(version=2), "body": bytes([127]) * 28 * count}))
    return Target("a.spz", {"header": header(), **body}, packed, bombs)


def _sog() -> Target:
    parts = _sog_parts(6, 1, seed=4)

    def packed(files: Parts) -> Parts:
        return {"a.sog": _zip(files)}

    zeros = bytes(2**25)
    spaces = _zip({**parts, "meta.json": b"{}" + b" " * 2**25})
    flat = {name: _webp(np.zeros((4000, 4000, 4), np.uint8)) for name in parts if "webp" in name}
    huge = {
        **parts,
        **flat,
        "meta.json": parts["meta.json"].replace(b'"count": 6', b'"count": 16000000'),
    }
    bombs: list[Parts] = [
        {"a.sog": _understated(spaces, "meta.json")},
        {"a.sog": _zip({**parts, "meta.json": b"{}" + b" " * 2**23})},
        packed(huge),
    ]
    for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        bombs.append(
            {"a.sog": _understated(_zip({**parts, "meta.json": zeros}, method), "meta.json")}
        )
    bombs += [packed({**parts, "meta.json": start * 10**6}) for start in (b"[", b'{"a":', b"9")]
    bombs.append(packed({**parts, "../evil": b"x", "/abs": b"x", "meta.json/": b""}))
    return Target("a.sog", parts, packed, bombs)


def _lod_meta() -> Target:
    levels = {"0_0": (6, 1), "0_1": (4, 0), "1_0": (3, 0)}
    parts = {
        f"{folder}/{name}": content
        for seed, (folder, (count, degree)) in enumerate(levels.items())
        for name, content in _sog_parts(count, degree, seed).items()
    }
    box = {"min": [-9, -9, -9], "max": [9.5, 9, 9]}

    def leaf(*entries: tuple[str, int, int, int]) -> dict[str, object]:
        lods = {lv: {"file": f, "offset": o, "count": c} for lv, f, o, c in entries}
        return {"bound": box, "lods": lods}

    leaves = [
        leaf(("0", 0, 0, 4), ("1", 2, 0, 2)),
        leaf(("0", 0, 4, 2)),
        leaf(("0", 1, 0, 4), ("1", 2, 2, 1)),
    ]
    meta = {"version": 1, "counts": [10, 3], "lodLevels": 2, "environment": None}
    meta["filenames"] = [f"{folder}/meta.json" for folder in levels]
    meta["tree"] = {"bound": box, "children": [{"bound": box, "children": leaves[:2]}, leaves[2]]}
    parts["lod-meta.json"] = json.dumps(meta).encode()
    deep = b'{"children":[' * 300_000
    many = {**meta, "filenames": ["0_0/meta.json"] * 10_000}
    wide = {**meta, "tree": {"children": [leaf(("0", 0, 0, 0)) for _ in range(2_000)]}}
    bombs = [
        {**parts, "lod-meta.json": content}
        for content in (deep, *(json.dumps(m).encode() for m in (many, wide)))
    ]
    return Target("lod-meta.json", parts, dict, bombs)


def _layout() -> Target:
    instances = [
        {"scale": 0.5 + i, "quaternions": [1.0, 0.0, 0.5, 0.0], "positions": [float(i), 2.0, 3.0]}
        for i in range(3)
    ]
    asset = {"asset_kind": "a", "asset_name": "b", "ply_suffix": "fused.ply"}
    camera = {
        "camera_name": "c",
        "camera_width": 192,
        "camera_height": 108,
        "camera_angle_x": 0.785,
        "transform_matrix": np.eye(4).tolist(),
    }
    layout = {
        "layout_name": "l",
        "assets": [{**asset, "instances": instances}],
        "cameras": [camera],
    }
    ply = b"".join(_ply().parts.values())
    parts = {"Layout.json": json.dumps({"layouts": [layout]}).encode(), "fused.ply": ply}
    deep = {**parts, "Layout.json": b'{"layouts":[' * 200_000}
    return Target("Layout.json", parts, dict, [deep])


def _sog_parts(count: int, degree: int, seed: int) -> Parts:
    """A small SOG data set: images of 3 columns, integer code books."""
    rng = np.random.default_rng(seed)
    side = (-(-count // 3), 3)
    images = {n: rng.integers(0, 256, (*side, 4)) for n in ("means_l", "means_u", "scales", "sh0")}
    quats = rng.integers(90, 166, (*side, 4))
    quats[..., 3] = rng.integers(252, 256, side)
    images["quats"] = quats
    codebook = [i // 64 - 2 for i in range(256)]
    meta: dict[str, object] = {
        "version": 2,
        "count": count,
        "means": {
            "mins": [-2, -1, 0],
            "maxs": [2, 3, 0],
            "files": ["means_l.webp", "means_u.webp"],
        },
        **{n: {"codebook": codebook, "files": [f"{n}.webp"]} for n in ("scales", "sh0")},
        "quats": {"files": ["quats.webp"]},
    }
    if degree:
        images["centroids"] = rng.integers(0, 4, (1, 64 * 3, 4)) * 64
        images["labels"] = np.zeros((*side, 4), int)
        files = ["centroids.webp", "labels.webp"]
        meta["shN"] = {"count": 64, "bands": 1, "codebook": codebook, "files": files}
    parts = {f"{name}.webp": _webp(pixels.astype(np.uint8)) for name, pixels in images.items()}
    return {**parts, "meta.json": json.dumps(meta).encode()}


def _joined(name: str) -> Callable[[Parts], Parts]:
    return lambda parts: {name: b"".join(parts.values())}


def _webp(pixels: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "WEBP", lossless=True, exact=True, method=0)
    return stream.getvalue()


def _zip(files: Parts, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content, method)
    return stream.getvalue()


def _understated(archive: bytes, member: str) -> bytes:
    """The archive with a directory that claims 100 bytes for one member."""
    data = bytearray(archive)
    for signature, size_at, name_at in ((b"PK\x01\x02", 24, 46), (b"PK\x03\x04", 22, 30)):
        at = data.find(signature)
        while at >= 0:
            if data[at + name_at : at + name_at + len(member)] == member.encode():
                data[at + size_at : at + size_at + 4] = struct.pack("<I", 100)
            at = data.find(signature, at + 4)
    return bytes(data)


TARGETS: dict[str, Callable[[], Target]] = dict(
    zip(READERS, (_ply, _compressed_ply, _splat, _spz, _sog, _lod_meta, _layout), strict=True)
)
