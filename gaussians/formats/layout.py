"""V3DG layout descriptions (JSON): instances of trained assets, and published cameras.

Format of https://github.com/city-super/V3DG (doi:10.1145/3721238.3730602). ``layouts`` holds one
layout: ``assets``, each with ``instances`` of ``scale``, ``quaternions`` (w, x, y, z) and
``positions``, and ``cameras`` with a camera-to-world matrix in the axes of OpenGL and Blender
(x right, y up, looking along -z).

Where an asset's Gaussians lie: its ``ply_suffix``, under ``asset_kind/asset_name/`` beside the
layout (the folders of that repository); or, for a layout of a single asset, a file of the suffix's
last name right beside the layout. The first that exists is taken.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.cameras import Display, Pose
from gaussians.composition import Composition, Instances
from gaussians.errors import InputError
from gaussians.formats.files import (
    JSON_LIMIT_BYTES,
    integer,
    is_relative_name,
    member,
    numbers,
    parse_json_object,
    read_bounded,
    shown,
)
from gaussians.formats.ply import read_ply
from gaussians.scene import Scene

SCENE_LIMIT_BYTES = 2 * 2**30  # 38 million Gaussians of SH degree 0
_OPENGL_TO_OPENCV = np.array([1.0, -1.0, -1.0])  # per column of a camera-to-world rotation
_ROTATION_TOLERANCE = 1e-4
_ANGLE_TOLERANCE = 1e-3  # relative; a camera_angle_y that contradicts square pixels


@dataclass(frozen=True)
class PublishedCamera:
    """One of a layout's cameras."""

    name: str
    display: Display  # on axis, square pixels; its field of view is the horizontal one
    pose: Pose  # OpenCV axes, units of the layout; of a stereo rig: midway between the eyes


@dataclass(frozen=True)
class Asset:
    """What the layout says about one base scene."""

    kind: str
    name: str
    ply_suffix: str


@dataclass(frozen=True)
class Layout:
    """A layout as written. Owns no Gaussians."""

    path: Path
    assets: tuple[Asset, ...]
    instances: Instances  # of all assets, in the order of the file
    cameras: tuple[PublishedCamera, ...]

    def asset_file(self, number: int) -> Path:
        """The file of one asset by the rule above; InputError when it does not exist."""
        asset, folder = self.assets[number], self.path.parent
        places = [folder / asset.kind / asset.name / asset.ply_suffix]
        if len(self.assets) == 1:
            places.append(folder / PurePosixPath(asset.ply_suffix).name)
        for place in places:
            if os.path.isfile(place):  # False, too, for names no file can have
                return place
        last = shown(PurePosixPath(asset.ply_suffix).name)
        raise InputError(
            f"{self.path}: asset {number}: {shown(asset.ply_suffix)} must lie in the folder "
            f"{shown(f'{asset.kind}/{asset.name}')} beside the layout"
            + (f", or {last} right beside it" if len(self.assets) == 1 else "")
        )


def read_layout(path: Path) -> Layout:
    """The instances and cameras of a layout; asset files are not opened.

    Quaternions are normalised. Raises InputError for anything but one layout with at least one
    instance, for missing keys, numbers that are not finite, quaternions whose length is not within
    1e-12 to 1e12, scales that are not positive, names that leave the folder, and cameras that are
    no rigid motion or whose two fields of view contradict square pixels.
    """
    document = parse_json_object(read_bounded(path, JSON_LIMIT_BYTES), str(path))
    layouts = _list(document, "layouts", str(path))
    if len(layouts) != 1:
        raise InputError(f"{path}: layouts must hold exactly one layout, not {len(layouts)}")
    (layout,) = layouts
    assets: list[Asset] = []
    rows: list[list[float]] = []  # base, scale, quaternion, position
    for number, entry in enumerate(_list(layout, "assets", f"{path}: layout")):
        where = f"{path}: asset {number}"
        names = [_relative(entry, k, where) for k in ("asset_kind", "asset_name", "ply_suffix")]
        assets.append(Asset(*names))
        for index, instance in enumerate(_list(entry, "instances", where)):
            rows.append([number, *_instance(instance, f"{where}, instance {index}")])
    if not rows:
        raise InputError(f"{path}: empty: must hold at least one instance")
    table = np.array(rows)
    cameras = _list(layout, "cameras", f"{path}: layout")
    return Layout(
        path=path,
        assets=tuple(assets),
        instances=Instances(table[:, 0].astype(np.int64), table[:, 1], table[:, 2:6], table[:, 6:]),
        cameras=tuple(_camera(c, f"{path}: camera {i}") for i, c in enumerate(cameras)),
    )


def read_composition(path: Path) -> tuple[Composition, Layout, list[Path]]:
    """A layout with the Gaussians of its assets, not composed yet, and every file that was read."""
    layout = read_layout(path)
    files = [layout.asset_file(number) for number in range(len(layout.assets))]
    composition = Composition([read_ply(file) for file in files], layout.instances, str(path))
    return composition, layout, [path, *files]


def compose_layout(path: Path) -> tuple[Scene, list[Path]]:
    """All Gaussians of a layout as one scene, and every file that was read.

    Raises InputError for a composition of more than 2 GiB; `read_composition` lets one compose only
    what a view needs.
    """
    composition, _layout, files = read_composition(path)
    size = composition.scene_bytes()
    if size > SCENE_LIMIT_BYTES:
        raise InputError(
            f"{path}: composes to {composition.count()} Gaussians ({size / 1e9:.1f} GB), which is "
            f"more than {SCENE_LIMIT_BYTES / 1e9:.1f} GB: compose a part of its instances"
        )
    return composition.compose(), files


def _list(document: Any, key: str, name: str) -> list[Any]:
    values = member(document, key, name)
    if not isinstance(values, list):
        raise InputError(f"{name}: {key} must be a list")
    return values


def _relative(document: Any, key: str, name: str) -> str:
    value = member(document, key, name)
    if not is_relative_name(value):
        raise InputError(f"{name}: {key} must be a path inside the folder, not {shown(value)}")
    return str(value)


def _number(document: Any, key: str, name: str, most: float) -> float:
    """A member above 0 and up to ``most``."""
    value = member(document, key, name)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value <= most:
        raise InputError(f"{name}: {key} must be a positive number, not {shown(value)}")
    return float(value)


def _instance(document: Any, name: str) -> list[float]:
    """Scale, unit quaternion, position."""
    scale = _number(document, "scale", name, 1e12)
    quaternion = numbers(document, "quaternions", name, 4)
    length = math.hypot(*quaternion)
    if not 1e-12 < length < 1e12:
        raise InputError(f"{name}: quaternions must not have length {length:g}")
    quaternion = [component / length for component in quaternion]
    return [scale, *quaternion, *numbers(document, "positions", name, 3)]


def _camera(document: Any, name: str) -> PublishedCamera:
    width = integer(document, "camera_width", name, 1, 16384)
    height = integer(document, "camera_height", name, 1, 16384)
    angle = _number(document, "camera_angle_x", name, math.pi)
    display = Display.from_fov(width, height, math.degrees(angle))
    if "camera_angle_y" in document:
        stated = _number(document, "camera_angle_y", name, math.pi)
        square = 2.0 * math.atan(0.5 * height / display.fy)
        if abs(stated - square) > _ANGLE_TOLERANCE * square:
            raise InputError(
                f"{name}: camera_angle_y must be {square:.6g} (square pixels), not {stated:.6g}"
            )
    matrix = _matrix(document, name)
    rotation = matrix[:3, :3] * _OPENGL_TO_OPENCV
    label = member(document, "camera_name", name)
    if not isinstance(label, str):
        raise InputError(f"{name}: camera_name must be text, not {shown(label)}")
    return PublishedCamera(label, display, Pose(matrix[:3, 3], rotation))


def _matrix(document: Any, name: str) -> NDArray[np.float64]:
    """[4, 4] camera-to-world, checked to be a rigid motion."""
    rows = member(document, "transform_matrix", name)
    if not isinstance(rows, list) or len(rows) != 4:
        raise InputError(f"{name}: transform_matrix must have 4 rows")
    where = f"{name}: transform_matrix"
    named = {f"row {number}": row for number, row in enumerate(rows)}
    matrix = np.array([numbers(named, row, where, 4) for row in named])
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotation.T @ rotation - np.eye(3)).max()
        rigid = error <= _ROTATION_TOLERANCE and np.linalg.det(rotation) > 0
    if not rigid or matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise InputError(f"{where} must be a rigid motion (rotation and position)")
    return matrix
