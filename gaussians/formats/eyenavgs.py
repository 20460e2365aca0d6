"""EyeNavGS recordings: head and eye poses of people walking through trained scenes (CSV).

Each frame is a left-eye row (``ViewIndex`` 0) followed by a right-eye row (1). Axes are OpenXR's
(x right, y up, -z forward), positions are in scene units, quaternions (x, y, z, w), times in ms.
``scene_setting.csv`` holds each scene's scale and the rotation that turns y to the vertical.
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from gaussians.formats.files import read_bounded

SETTINGS_NAME = "scene_setting.csv"

Float64 = NDArray[np.float64]

_SIZE_LIMIT_BYTES = 2**30
_FOV = ("FOV1", "FOV2", "FOV3", "FOV4")
_POSITION = ("PositionX", "PositionY", "PositionZ")
_QUATERNION = ("QuaternionX", "QuaternionY", "QuaternionZ", "QuaternionW")
_COLUMNS = ("ViewIndex", *_FOV, *_POSITION, *_QUATERNION, "Timestamp")


@dataclass(frozen=True)
class EyeRows:
    """One eye's rows of a recording, as stored."""

    fov: Float64  # [F, 4] signed half-angles in radians: horizontal pair, vertical pair
    positions: Float64  # [F, 3] scene units
    quaternions: Float64  # [F, 4] (x, y, z, w)
    times_ms: Float64  # [F]


@dataclass(frozen=True)
class SceneSetting:
    """What turns a recording's numbers into metres with y up."""

    scale: float  # scene units per metre
    gravity_quaternion: tuple[float, float, float, float]  # (x, y, z, w)


def read_eye_rows(path: Path) -> tuple[EyeRows, EyeRows]:
    """Left and right rows of a recording.

    Raises InputError for missing columns, values that are not finite numbers, and rows that do not
    alternate between left and right.
    """
    rows = _read_csv(path, _COLUMNS)
    if not rows:
        raise InputError(f"{path}: empty: must hold at least one frame")
    table = np.empty((len(rows), len(_COLUMNS)))
    for number, row in enumerate(rows):
        for column, key in enumerate(_COLUMNS):
            table[number, column] = _number(row[key], f"{path}: row {number + 1}: {key}")
    if len(rows) % 2 or not np.array_equal(table[:, 0], np.arange(len(rows)) % 2):
        raise InputError(f"{path}: ViewIndex must alternate between 0 (left) and 1 (right)")
    left, right = (
        EyeRows(eye[:, 1:5], eye[:, 5:8], eye[:, 8:12], eye[:, 12])
        for eye in (table[0::2], table[1::2])
    )
    return left, right


def find_scene_settings(trace: Path) -> Path:
    """The ``scene_setting.csv`` in the recording's folder, or else in the folder above it."""
    candidates = [trace.parent / SETTINGS_NAME, trace.parent.parent / SETTINGS_NAME]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise InputError(
        f"{trace}: needs the scene's scale and gravity quaternion: put {SETTINGS_NAME} of the data "
        f"set beside it"
    )


def read_scene_setting(settings: Path, trace: Path) -> SceneSetting:
    """The setting of the scene that the recording's file name ends in (``user110_london.csv``)."""
    rows = _read_csv(settings, ("Scene_Name", "Quaternion", "Scale"))
    _, underscore, scene = trace.stem.rpartition("_")
    found = [row for row in rows if row["Scene_Name"] == scene]
    if not underscore or len(found) != 1:
        raise InputError(
            f"{trace}: needs a scale and a gravity quaternion: {settings} must have one row for "
            f"the scene {scene!r}, not {len(found)}; the file name must end in _SCENE.csv"
        )
    where = f"{settings}: scene {scene!r}"
    components = found[0]["Quaternion"].split(",")
    if len(components) != 4:
        raise InputError(f"{where}: Quaternion must be four numbers, not {len(components)}")
    x, y, z, w = (_number(text, f"{where}: Quaternion") for text in components)
    return SceneSetting(_number(found[0]["Scale"], f"{where}: Scale"), (x, y, z, w))


def _read_csv(path: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    """All rows by column name; every row must be complete."""
    try:
        text = read_bounded(path, _SIZE_LIMIT_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: must be a UTF-8 text file") from error
    reader = csv.DictReader(io.StringIO(text, newline=""))
    missing = [name for name in columns if name not in (reader.fieldnames or ())]
    if missing:
        raise InputError(f"{path}: missing column {', '.join(missing)}")
    try:
        rows = list(reader)
    except csv.Error as error:
        raise InputError(f"{path}: must be a CSV file: {error}") from error
    for number, row in enumerate(rows):
        if None in row or None in row.values():
            raise InputError(
                f"{path}: row {number + 1} must have {len(reader.fieldnames or ())} cells"
            )
    return rows


def _number(text: str, name: str) -> float:
    """A finite number."""
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"{name} must be a finite number, not {text!r}")
    return value
