"""The header of a binary little-endian PLY file: its elements and their scalar properties."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from gaussians.errors import InputError
from gaussians.formats.files import shown

_NUMBER_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1"},
    **{"short": "<i2", "int16": "<i2", "ushort": "<u2", "uint16": "<u2"},
    **{"int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4"},
    **{"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8"},
}
_LINE_LIMIT = 1024
_HEADER_LINES_LIMIT = 4096
_COUNT_DIGITS = 18


class PlyElement(NamedTuple):
    """A table of ``rows`` rows; properties in file order."""

    name: str
    rows: int
    fields: dict[str, str]  # property name to NumPy type

    @property
    def dtype(self) -> np.dtype[np.void]:
        """One row."""
        return np.dtype(list(self.fields.items()))


def read_header(stream: BinaryIO, path: Path) -> list[PlyElement]:
    """The elements; the stream stands at the first row afterwards.

    Raises InputError for another PLY flavour, lists, and properties or elements declared twice.
    The counts are as declared: ``check_size`` compares them with the file.
    """
    flavour: list[str] = []
    elements: list[PlyElement] = []
    for words in _header_lines(stream, path):
        match words:
            case ["format", *rest] if not flavour:
                flavour = rest
            case ["element", name, number] if _is_count(number) and not find(elements, name):
                elements.append(PlyElement(name, int(number), {}))
            case ["element", *_]:
                raise InputError(
                    f"{path}: an element must be declared once with a count, not {_line(words)}"
                )
            case ["property", kind, name] if elements and kind in _NUMBER_TYPES:
                if name in elements[-1].fields:
                    raise InputError(f"{path}: property {shown(name)} must be declared once")
                elements[-1].fields[name] = _NUMBER_TYPES[kind]
            case _:
                raise InputError(f"{path}: unexpected header line {_line(words)}")
    if flavour != ["binary_little_endian", "1.0"]:
        raise InputError(
            f"{path}: PLY format must be 'binary_little_endian 1.0', not {_line(flavour)}"
        )
    return elements


def find(elements: list[PlyElement], name: str) -> PlyElement | None:
    """The element of this name, if there is one."""
    return next((e for e in elements if e.name == name), None)


def check_size(stream: BinaryIO, path: Path, elements: list[PlyElement]) -> None:
    """Raise InputError unless exactly the declared rows follow, so no count can exceed the file."""
    have = os.fstat(stream.fileno()).st_size - stream.tell()
    need = sum(e.rows * e.dtype.itemsize for e in elements)
    if have != need:
        rows = ", ".join(f"{e.rows} of {e.dtype.itemsize} bytes ({e.name})" for e in elements)
        raise InputError(
            f"{path}: {'truncated' if have < need else 'has trailing bytes'}: the header is "
            f"followed by {have} bytes, not by the declared rows: {rows}"
        )


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


def _is_count(text: str) -> bool:
    return text.isdecimal() and text.isascii() and len(text) <= _COUNT_DIGITS


def _line(words: list[str]) -> str:
    return shown(" ".join(words))
