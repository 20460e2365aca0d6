"""INRIA point-cloud files: binary little-endian PLY with one ``vertex`` element.

Properties are found by name, in any order: ``x y z``, ``f_dc_0..2``, optionally ``f_rest_*``
(channel by channel), ``opacity`` (logit), ``scale_0..2`` (natural logarithm), ``rot_0..3``
(w, x, y, z). Other scalar properties, such as the normals, are passed over by their size.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from gaussians.scene import Scene, normalised_quaternions

_NUMBER_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1"},
    **{"short": "<i2", "int16": "<i2", "ushort": "<u2", "uint16": "<u2"},
    **{"int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4"},
    **{"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8"},
}
_LINE_LIMIT = 1024
_HEADER_LINES_LIMIT = 4096
_POSITION = ("x", "y", "z")
_BASE_COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALE = ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_REQUIRED = (*_POSITION, *_BASE_COLOUR, "opacity", *_SCALE, *_ROTATION)
_REST_COUNTS = (0, 9, 24, 45)  # three channels of 0, 3, 8 or 15 coefficients: degree 0 to 3
# Finite stand-ins whose float64 activation rounds to exactly these float32 values.
_LOGIT_OF_ONE = 20.0  # 1 - 2.1e-9 is nearer to 1 than to the float32 below it
_LOGIT_OF_ZERO = _LOG_OF_ZERO = -110.0  # 1.7e-48 is nearer to 0 than to the least float32


def read_ply(path: Path) -> Scene:
    """The Gaussians of an INRIA PLY, activated in float64 and rounded once to float32.

    Raises InputError for any other PLY flavour, missing, repeated or non-float properties, a wrong
    number of ``f_rest_*``, no Gaussians, truncation, trailing bytes and values that are not finite.
    Double properties are rounded to float32.
    """
    try:
        with path.open("rb") as stream:
            count, fields = _parse_header(_header_lines(stream, path), path)
            dtype = np.dtype(fields)
            have = os.fstat(stream.fileno()).st_size - stream.tell()
            if have != count * dtype.itemsize:
                kind = "truncated" if have < count * dtype.itemsize else "has trailing bytes"
                raise InputError(
                    f"{path}: {kind}: {count} Gaussians of {dtype.itemsize} bytes must be "
                    f"followed by the end of the file, but the header is followed by {have} bytes"
                )
            table = np.fromfile(stream, dtype, count)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    return _activate(table, path)


def _header_lines(stream: BinaryIO, path: Path) -> Iterator[list[str]]:
    """The words of each header line; the stream stands behind ``end_header`` afterwards."""
    if stream.readline(_LINE_LIMIT).rstrip(b"\r\n") != b"ply":
        raise InputError(f"{path}: must begin with the line 'ply'")
    for _ in range(_HEADER_LINES_LIMIT):
        line = stream.readline(_LINE_LIMIT)
        if not line.endswith(b"\n"):
            break
        words = line.decode("ascii", "replace").split()
        if words == ["end_header"]:
            return
        if words and words[0] not in ("comment", "obj_info"):
            yield words
    raise InputError(f"{path}: the PLY header must end with the line 'end_header'")


def _parse_header(lines: Iterator[list[str]], path: Path) -> tuple[int, list[tuple[str, str]]]:
    """Number of Gaussians and (name, NumPy type) of each property in file order."""
    count: int | None = None
    fields: dict[str, str] = {}
    flavour: list[str] = []
    for words in lines:
        match words:
            case ["format", *rest]:
                flavour = rest
            case ["element", "vertex", number] if count is None and number.isdecimal():
                count = int(number)
            case ["element", *_]:
                raise InputError(
                    f"{path}: must hold one element 'vertex' with a count, not '{' '.join(words)}'"
                )
            case ["property", kind, name] if count is not None and kind in _NUMBER_TYPES:
                if name in fields:
                    raise InputError(f"{path}: property {name!r} must be declared once")
                fields[name] = _NUMBER_TYPES[kind]
            case _:
                raise InputError(f"{path}: unexpected header line '{' '.join(words)}'")
    if flavour != ["binary_little_endian", "1.0"]:
        raise InputError(
            f"{path}: PLY format must be 'binary_little_endian 1.0', not '{' '.join(flavour)}'"
        )
    if not count:
        raise InputError(f"{path}: empty: must hold at least one Gaussian")
    _check_properties(fields, path)
    return count, list(fields.items())


def _check_properties(fields: dict[str, str], path: Path) -> None:
    """Raise InputError unless these are the properties of Gaussians of degree 0 to 3."""
    missing = [name for name in _REQUIRED if name not in fields]
    if missing:
        raise InputError(f"{path}: missing property {', '.join(missing)}")
    rest = [name for name in fields if name.startswith("f_rest_")]
    if len(rest) not in _REST_COUNTS or set(rest) != set(_rest_names(len(rest))):
        raise InputError(
            f"{path}: properties f_rest_* must be numbered from 0 and count 0, 9, 24 or 45, "
            f"not {len(rest)}"
        )
    for name in (*_REQUIRED, *rest):
        if not fields[name].startswith("<f"):
            raise InputError(f"{path}: property {name!r} must be float or double")


def _rest_names(count: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(count))


def _activate(table: NDArray[np.void], path: Path) -> Scene:
    """Stored parameters to a scene; every stored value must be finite in float32."""

    def columns(names: tuple[str, ...]) -> NDArray[np.float32]:
        result = np.empty((len(table), len(names)), np.float32)
        for i, name in enumerate(names):
            with np.errstate(over="ignore"):  # a double beyond float32 becomes inf: refused below
                result[:, i] = table[name]
            finite = np.isfinite(result[:, i])
            if not finite.all():
                raise InputError(
                    f"{path}: property {name!r} must be finite; Gaussian {int(np.argmin(finite))} "
                    f"has {table[name][np.argmin(finite)]}"
                )
        return result

    rest_count = sum(name.startswith("f_rest_") for name in table.dtype.names or ())
    harmonics = np.empty((len(table), 1 + rest_count // 3, 3), np.float32)
    harmonics[:, 0] = columns(_BASE_COLOUR)
    if rest_count:
        rest = columns(_rest_names(rest_count))
        harmonics[:, 1:] = rest.reshape(len(table), 3, rest_count // 3).transpose(0, 2, 1)
    logits = columns(("opacity",))[:, 0].astype(np.float64)
    logarithms = columns(_SCALE).astype(np.float64)
    with np.errstate(over="ignore"):  # exp(-logit) may be inf: opacity 0; an inf scale is refused
        opacities = (1.0 / (1.0 + np.exp(-logits))).astype(np.float32)
        scales = np.exp(logarithms).astype(np.float32)
    quaternions = normalised_quaternions(columns(_ROTATION), str(path))
    return Scene(columns(_POSITION), quaternions, scales, opacities, harmonics).validate(str(path))


def write_ply(scene: Scene, path: Path) -> None:
    """Write a scene as INRIA PLY (normals 0, all float32); the file is replaced in one step.

    Read back, means and harmonics have the same bits; so have opacity 0 and 1 and scale 0, which
    are stored as logit -110 and 20 and logarithm -110. Otherwise rounding the stored logarithm
    changes an opacity by at most 5e-8, and a scale s relatively by at most
    ``6e-8 * (|ln s| + 2)``; normalising again changes a quaternion component by at most 2e-7.

    Raises InputError for an invalid or empty scene, and for opacities above 1, which a logit cannot
    hold.
    """
    scene.validate(str(path))
    if not len(scene):
        raise InputError(f"{path}: a PLY scene must hold at least one Gaussian")
    if (scene.opacities > 1).any():
        bad = int(np.argmax(scene.opacities > 1))
        raise InputError(
            f"{path}: opacities must be at most 1 to be stored as logits; "
            f"Gaussian {bad} has {scene.opacities[bad]}"
        )
    rest = scene.sh[:, 1:].transpose(0, 2, 1).reshape(len(scene), -1)
    names = (*_POSITION, "nx", "ny", "nz", *_BASE_COLOUR, *_rest_names(rest.shape[1]))
    names += ("opacity", *_SCALE, *_ROTATION)
    normals = np.zeros((len(scene), 3), np.float32)
    logits = _logit(scene.opacities)[:, None]
    blocks = [scene.means, normals, scene.sh[:, 0], rest, logits, _log(scene.scales)]
    table = np.concatenate([*blocks, scene.quaternions], axis=1).astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(scene)}"]
    header += [f"property float {name}" for name in names]
    content = "\n".join([*header, "end_header", ""]).encode("ascii") + table.tobytes()
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error


def _logit(opacities: NDArray[np.float32]) -> NDArray[np.float32]:
    """ln(o / (1 - o)) in float64, rounded to float32; the limits get finite stand-ins."""
    wide = opacities.astype(np.float64)
    inside = (wide > 0) & (wide < 1)
    logits = np.where(wide > 0, _LOGIT_OF_ONE, _LOGIT_OF_ZERO)
    logits[inside] = np.log(wide[inside]) - np.log1p(-wide[inside])
    return logits.astype(np.float32)


def _log(scales: NDArray[np.float32]) -> NDArray[np.float32]:
    """ln in float64, rounded to float32; 0 gets a finite stand-in."""
    wide = scales.astype(np.float64)
    logarithms = np.full(wide.shape, _LOG_OF_ZERO)
    np.log(wide, out=logarithms, where=wide > 0)
    return logarithms.astype(np.float32)
