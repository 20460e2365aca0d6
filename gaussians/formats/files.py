"""Reading files with bounds, writing them whole or not at all, and typed fields of JSON."""

from __future__ import annotations

import json
import math
import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

from gaussians.errors import InputError

JSON_LIMIT_BYTES = 64 * 2**20
_SHOWN_CHARACTERS = 60
_NAME_CHARACTERS = 255  # of a file name inside a data set


def file_size(path: Path) -> int:
    """Bytes of a regular file (links are followed); InputError for anything else.

    Asked before a file is opened: opening a pipe would wait for ever.
    """
    try:
        status = path.stat()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: cannot be read: must be a regular file")
    return status.st_size


def read_bounded(path: Path, limit: int) -> bytes:
    """The whole file; InputError when it cannot be read or holds more than ``limit`` bytes."""
    size = file_size(path)
    if size > limit:
        raise InputError(f"{path}: must hold at most {limit} bytes")
    try:
        with path.open("rb") as stream:
            return stream.read(size)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def write_atomically(path: Path, blocks: Iterable[bytes]) -> None:
    """Write the blocks to a new file beside ``path`` and rename it onto ``path`` at the end.

    Nothing is left behind when a block or the disk fails. Raises InputError when it cannot be
    written.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as stream:
            for block in blocks:
                stream.write(block)
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        partial.unlink(missing_ok=True)


def shown(value: object) -> str:
    """A value from a file as it may stand in a message: one short line of printable characters."""
    text = ascii(value)
    return text if len(text) <= _SHOWN_CHARACTERS else text[:_SHOWN_CHARACTERS] + "..."


def parse_json_object(data: bytes, name: str) -> dict[str, Any]:
    """The JSON object in ``data``; InputError for anything else, NaN and Infinity included."""

    def refuse(constant: str) -> NoReturn:
        raise InputError(f"{name}: numbers must be finite, not {constant}")

    try:
        document = json.loads(data, parse_constant=refuse)
    except InputError:
        raise
    except UnicodeDecodeError as error:
        raise InputError(f"{name}: must be a JSON document in UTF-8") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{name}: must be a JSON document: {error}") from error
    if not isinstance(document, dict):
        raise InputError(f"{name}: must be a JSON object, not a {type(document).__name__}")
    return document


def member(document: Any, key: str, name: str) -> Any:
    """``document[key]``, or InputError: ``name`` says which object lacks it."""
    if not isinstance(document, dict) or key not in document:
        raise InputError(f"{name}: must have the key {key!r}")
    return document[key]


def integer(document: Any, key: str, name: str, low: int, high: int) -> int:
    """An integer member from ``low`` to ``high``."""
    value = member(document, key, name)
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise InputError(
            f"{name}: {key} must be an integer from {low} to {high}, not {shown(value)}"
        )
    return value


def numbers(document: Any, key: str, name: str, length: int) -> list[float]:
    """A list member of ``length`` finite numbers."""
    values = member(document, key, name)
    if isinstance(values, list) and len(values) == length and all(map(_is_finite, values)):
        return [float(v) for v in values]
    raise InputError(f"{name}: {key} must be a list of {length} finite numbers")


def _is_finite(value: object) -> bool:
    """Whether this is a number within the range of a float; JSON's integers have no bound."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def file_names(document: Any, key: str, name: str, length: int) -> list[str]:
    """A list member of ``length`` plain file names: no folder, no ``..``, no drive."""
    values = member(document, key, name)
    if not isinstance(values, list) or len(values) != length:
        raise InputError(f"{name}: {key} must be a list of {length} file names")
    for value in values:
        if not is_relative_name(value) or "/" in value:
            raise InputError(f"{name}: {key} must hold plain file names, not {shown(value)}")
    return values


def is_relative_name(value: object) -> bool:
    """Whether this is a short, printable, ``/``-separated path that cannot leave its folder."""
    if not isinstance(value, str) or not value.isprintable() or len(value) > _NAME_CHARACTERS:
        return False
    if any(c in value for c in "\\:"):
        return False
    return all(part not in ("", ".", "..") for part in value.split("/"))


def losses(lost: dict[str, int]) -> str:
    """``3 opacities above 1, 2 colours outside 0..1`` for a message."""
    return ", ".join(f"{count} {what}" for what, count in lost.items())
