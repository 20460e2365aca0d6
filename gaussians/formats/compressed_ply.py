"""PlayCanvas compressed PLY: Gaussians quantised in chunks of 256, four 32-bit words each.

Elements ``chunk`` (limits per 256 Gaussians), ``vertex`` (packed words) and optionally ``sh``
(``f_rest_*`` as bytes, channel by channel), found by name. Written by SuperSplat and
splat-transform; layout as in https://github.com/playcanvas/splat-transform
(``src/readers/decompress-ply.ts``). Older files have no colour limits: colours then lie in 0..1.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gaussians.constants import SH_C0
from gaussians.errors import InputError
from gaussians.formats.files import file_size, shown
from gaussians.formats.ply_header import PlyElement, check_size, find, read_header
from gaussians.formats.smallest_three import join_smallest_three
from gaussians.scene import Float32, Scene

_CHUNK = 256
_POSITION, _SCALE, _COLOUR = ("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_REST_COUNTS = (9, 24, 45)
_SH_RANGE = 4.0  # coefficients lie in -4..4
# Bytes 0 and 255 are the ends of the range, the others the middles of their 256 intervals.
_UNIT_OF_BYTE = np.concatenate([[0.0], (np.arange(1, 255) + 0.5) / 256, [1.0]])
_SH_OF_BYTE = ((_UNIT_OF_BYTE - 0.5) * 2 * _SH_RANGE).astype(np.float32)


def is_compressed_ply(path: Path) -> bool:
    """Whether a PLY has chunks; InputError when its header cannot be read."""
    file_size(path)
    try:
        with path.open("rb") as stream:
            return find(read_header(stream, path), "chunk") is not None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def read_compressed_ply(path: Path) -> Scene:
    """The Gaussians of a compressed PLY, SH degree 0 to 3, decoded in float64 and rounded once.

    Raises InputError for other elements, missing, additional or wrongly typed properties, row
    counts that do not belong together, truncation, trailing bytes, limits that are not finite or
    the wrong way round, and rotations that are not of unit length.
    """
    file_size(path)
    try:
        with path.open("rb") as stream:
            elements = read_header(stream, path)
            _check(elements, path)
            check_size(stream, path, elements)
            tables = {e.name: np.fromfile(stream, e.dtype, e.rows) for e in elements}
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if any(len(tables[e.name]) != e.rows for e in elements):
        raise InputError(f"{path}: truncated while it was read")
    return _decode(tables, str(path))


def _check(elements: list[PlyElement], path: Path) -> None:
    """Raise InputError unless these are the elements of a compressed PLY."""
    for element in elements:
        if element.name not in ("chunk", "vertex", "sh"):
            raise InputError(
                f"{path}: elements must be chunk, vertex and sh, not {shown(element.name)}"
            )
    chunk, vertex, harmonics = (find(elements, name) for name in ("chunk", "vertex", "sh"))
    if chunk is None or vertex is None:
        raise InputError(f"{path}: a compressed PLY must have the elements chunk and vertex")
    if not vertex.rows:
        raise InputError(f"{path}: empty: must hold at least one Gaussian")
    coloured = any(name in chunk.fields for name in _limits(_COLOUR))
    limits = _limits(_POSITION) + _limits(_SCALE) + (_limits(_COLOUR) if coloured else ())
    _check_fields(chunk, limits, "<f4", path)
    _check_fields(vertex, _PACKED, "<u4", path)
    if chunk.rows != -(-vertex.rows // _CHUNK):
        raise InputError(
            f"{path}: {vertex.rows} Gaussians must have {-(-vertex.rows // _CHUNK)} chunks, "
            f"not {chunk.rows}"
        )
    if harmonics is not None:
        count = len(harmonics.fields)
        if count not in _REST_COUNTS:
            raise InputError(f"{path}: element sh must have 9, 24 or 45 properties, not {count}")
        _check_fields(harmonics, tuple(f"f_rest_{i}" for i in range(count)), "u1", path)
        if harmonics.rows != vertex.rows:
            raise InputError(
                f"{path}: {vertex.rows} Gaussians must have as many rows of sh, "
                f"not {harmonics.rows}"
            )


def _check_fields(element: PlyElement, names: tuple[str, ...], kind: str, path: Path) -> None:
    """Raise InputError unless the element has exactly these properties, all of this type."""
    for name in names:
        if element.fields.get(name) != kind:
            what = "missing" if name not in element.fields else f"not of type {np.dtype(kind)}"
            raise InputError(f"{path}: property {name!r} of element {element.name} is {what}")
    for name in element.fields:
        if name not in names:
            raise InputError(
                f"{path}: element {element.name} must not have the property {shown(name)}"
            )


def _limits(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{end}_{name}" for end in ("min", "max") for name in names)


def _decode(tables: dict[str, NDArray[np.void]], name: str) -> Scene:
    packed = {column: tables["vertex"][column] for column in _PACKED}
    chunk_of = np.arange(len(tables["vertex"])) // _CHUNK

    def between(names: tuple[str, ...], shares: NDArray[np.float64]) -> NDArray[np.float64]:
        """[N, 3] values at these shares of the way from the chunk's least to its most."""
        ends = [np.stack([tables["chunk"][f"{e}_{n}"] for n in names], 1) for e in ("min", "max")]
        low, high = (end.astype(np.float64) for end in ends)
        good = np.isfinite(low) & np.isfinite(high) & (low <= high)
        if not good.all():
            bad = int(np.argmin(good.all(axis=1)))
            raise InputError(
                f"{name}: limits of {', '.join(names)} must be finite, least before most; "
                f"those of chunk {bad} are not"
            )
        return low[chunk_of] * (1 - shares) + high[chunk_of] * shares

    colours = _shares(packed["packed_color"], (24, 16, 8, 0), (8, 8, 8, 8))
    rgb = colours[:, :3]
    if "min_r" in (tables["chunk"].dtype.names or ()):
        rgb = between(_COLOUR, rgb)
    base = ((rgb - 0.5) / float(SH_C0)).astype(np.float32)
    logarithms = between(_SCALE, _shares(packed["packed_scale"], (21, 11, 0), (11, 10, 11)))
    with np.errstate(over="ignore"):  # inf is refused by validate()
        scales = np.exp(logarithms).astype(np.float32)
    position_shares = _shares(packed["packed_position"], (21, 11, 0), (11, 10, 11))
    return Scene(
        means=between(_POSITION, position_shares).astype(np.float32),
        quaternions=_rotations(packed["packed_rotation"], name),
        scales=scales,
        opacities=colours[:, 3].astype(np.float32),
        sh=np.concatenate([base[:, None], _higher_harmonics(tables)], axis=1),
    ).validate(name)


def _shares(
    words: NDArray[np.uint32], shifts: tuple[int, ...], bits: tuple[int, ...]
) -> NDArray[np.float64]:
    """[N, fields] of 0..1: unsigned fields of each word over their largest value."""
    most = (1 << np.array(bits, np.uint32)) - 1
    return (words[:, None] >> np.array(shifts, np.uint32) & most) / most.astype(np.float64)


def _rotations(words: NDArray[np.uint32], name: str) -> Float32:
    """[N, 4] (w, x, y, z): index of the omitted component, then 10 bits for each other."""
    kept = (_shares(words, (20, 10, 0), (10, 10, 10)) - 0.5) * np.sqrt(2.0)
    return join_smallest_three(kept, (words >> 30).astype(np.intp), name)


def _higher_harmonics(tables: dict[str, NDArray[np.void]]) -> Float32:
    """[N, 0 | 3 | 8 | 15, 3] coefficients above degree 0."""
    table = tables.get("sh")
    if table is None:
        return np.zeros((len(tables["vertex"]), 0, 3), np.float32)
    count = len(table.dtype.names or ())
    stored = np.stack([table[f"f_rest_{i}"] for i in range(count)], axis=1)
    return _SH_OF_BYTE[stored].reshape(len(table), 3, count // 3).transpose(0, 2, 1)
