"""INRIA point-cloud files: binary little-endian PLY with one ``vertex`` element.

Properties are found by name, in any order: ``x y z``, ``f_dc_0..2``, optionally ``f_rest_*``
(channel by channel), ``opacity`` (logit), ``scale_0..2`` (natural logarithm), ``rot_0..3``
(w, x, y, z). Other scalar properties, such as the normals, are passed over by their size.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from gaussians.formats.files import file_size, shown, write_atomically
from gaussians.formats.ply_header import PlyElement, check_size, read_header
from gaussians.scene import FIELDS, Scene, normalised_quaternions

_POSITION = ("x", "y", "z")
_BASE_COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALE = ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_REQUIRED = (*_POSITION, *_BASE_COLOUR, "opacity", *_SCALE, *_ROTATION)
_BLOCK = 2**16  # rows written at a time
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
    (table,) = _tables(path, None)
    return _activate(table, str(path))


def iterate_ply(path: Path, chunk: int = 2**18) -> Iterator[Scene]:
    """The Gaussians of an INRIA PLY of any size, ``chunk`` at a time, in file order.

    Together the scenes are what ``read_ply`` returns, bit for bit, in memory that depends on
    ``chunk`` alone. Errors are those of ``read_ply``, raised when the chunk is reached; a header or
    size that is wrong is found before the first scene.
    """
    if chunk < 1:
        raise InputError(f"chunk must be a positive number of Gaussians, not {chunk}")
    first = 0
    for table in _tables(path, chunk):
        yield _activate(table, str(path) if first == 0 else f"{path} from Gaussian {first} on")
        first += len(table)


def _tables(path: Path, chunk: int | None) -> Iterator[NDArray[np.void]]:
    """The rows, ``chunk`` at a time (None: all at once), after the checks of header and size."""
    file_size(path)
    try:
        with path.open("rb") as stream:
            vertex = _vertex(read_header(stream, path), path)
            check_size(stream, path, [vertex])
            step = vertex.rows if chunk is None else chunk
            for first in range(0, vertex.rows, step):
                count = min(step, vertex.rows - first)
                table = np.fromfile(stream, vertex.dtype, count)
                if len(table) != count:
                    raise InputError(f"{path}: truncated while it was read")
                yield table
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def _vertex(elements: list[PlyElement], path: Path) -> PlyElement:
    """The one element of an INRIA PLY, checked."""
    for element in elements:
        if element.name != "vertex":
            line = f"element {element.name} {element.rows}"
            raise InputError(f"{path}: must hold one element 'vertex', not {shown(line)}")
    if not elements or not elements[0].rows:
        raise InputError(f"{path}: empty: must hold at least one Gaussian")
    _check_properties(elements[0].fields, path)
    return elements[0]


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


def _activate(table: NDArray[np.void], name: str) -> Scene:
    """Stored parameters to a scene; every stored value must be finite in float32."""

    def columns(names: tuple[str, ...]) -> NDArray[np.float32]:
        result = np.empty((len(table), len(names)), np.float32)
        for i, column in enumerate(names):
            with np.errstate(over="ignore"):  # a double beyond float32 becomes inf: refused below
                result[:, i] = table[column]
            finite = np.isfinite(result[:, i])
            if not finite.all():
                bad = int(np.argmin(finite))
                raise InputError(
                    f"{name}: property {column!r} must be finite; Gaussian {bad} has "
                    f"{table[column][bad]}"
                )
        return result

    rest_count = sum(column.startswith("f_rest_") for column in table.dtype.names or ())
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
    quaternions = normalised_quaternions(columns(_ROTATION), name)
    return Scene(columns(_POSITION), quaternions, scales, opacities, harmonics).validate(name)


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
    write_atomically(path, _blocks(scene))


def fit_ply(scene: Scene) -> tuple[Scene, dict[str, int]]:
    """The scene as a PLY can hold it (opacities above 1 become 1), and how many values changed."""
    above = int((scene.opacities > 1).sum())
    if not above:
        return scene, {}
    fitted = replace(scene, opacities=np.minimum(scene.opacities, np.float32(1)))
    return fitted, {"opacities above 1": above}


def _blocks(scene: Scene) -> Iterator[bytes]:
    """Header, then the rows."""
    rest_count = 3 * (scene.sh.shape[1] - 1)
    names = (*_POSITION, "nx", "ny", "nz", *_BASE_COLOUR, *_rest_names(rest_count))
    names += ("opacity", *_SCALE, *_ROTATION)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(scene)}"]
    header += [f"property float {name}" for name in names]
    yield "\n".join([*header, "end_header", ""]).encode("ascii")
    for first in range(0, len(scene), _BLOCK):
        part = Scene(*(getattr(scene, field)[first : first + _BLOCK] for field in FIELDS))
        rest = part.sh[:, 1:].transpose(0, 2, 1).reshape(len(part), -1)
        logits, normals = _logit(part.opacities)[:, None], np.zeros((len(part), 3), np.float32)
        columns = [part.means, normals, part.sh[:, 0], rest, logits, _log(part.scales)]
        yield np.concatenate([*columns, part.quaternions], axis=1).astype("<f4").tobytes()


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
