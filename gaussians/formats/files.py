"""Reading scene files with bounds, and taking typed fields out of their JSON documents."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NoReturn

from gaussians.errors import InputError

JSON_LIMIT_BYTES = 64 * 2**20


def read_bounded(path: Path, limit: int) -> bytes:
    """The whole file; InputError when it cannot be read or holds more than ``limit`` bytes."""
    try:
        with path.open("rb") as stream:
            data = stream.read(limit + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if len(data) > limit:
        raise InputError(f"{path}: must hold at most {limit} bytes")
    return data


def parse_json_object(data: bytes, name: str) -> dict[str, Any]:
    """The JSON object in ``data``; InputError for anything else, NaN and Infinity included."""

    def refuse(constant: str) -> NoReturn:
        raise InputError(f"{name}: numbers must be finite, not {constant}")

    try:
        document = json.loads(data, parse_constant=refuse)
    except InputError:
        raise
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
        raise InputError(f"{name}: {key} must be an integer from {low} to {high}, not {value!r}")
    return value


def numbers(document: Any, key: str, name: str, length: int) -> list[float]:
    """A list member of ``length`` finite numbers."""
    values = member(document, key, name)
    plain = isinstance(values, list) and all(
        isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in values
    )
    if not plain or len(values) != length:
        raise InputError(f"{name}: {key} must be a list of {length} finite numbers")
    return [float(v) for v in values]


def file_names(document: Any, key: str, name: str, length: int) -> list[str]:
    """A list member of ``length`` plain file names: no folder, no ``..``, no drive."""
    values = member(document, key, name)
    if not isinstance(values, list) or len(values) != length:
        raise InputError(f"{name}: {key} must be a list of {length} file names")
    for value in values:
        if not is_relative_name(value) or "/" in value:
            raise InputError(f"{name}: {key} must hold plain file names, not {value!r}")
    return values


def is_relative_name(value: object) -> bool:
    """Whether this is a ``/``-separated relative path that cannot leave its folder."""
    if not isinstance(value, str) or not value or any(c in value for c in "\\:\0"):
        return False
    return all(part not in ("", ".", "..") for part in value.split("/"))
