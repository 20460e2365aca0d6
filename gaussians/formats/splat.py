"""``.splat`` files: 32-byte records without a header; spherical harmonics of degree 0 only.

The layout comes from a viewer, https://github.com/antimatter15/splat.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gaussians.constants import SH_C0
from gaussians.errors import InputError
from gaussians.formats.files import file_size, losses, write_atomically
from gaussians.scene import Scene, normalised_quaternions

_RECORD = np.dtype(
    [
        ("mean", "<f4", 3),
        ("scale", "<f4", 3),  # linear
        ("rgba", "u1", 4),  # colour 0.5 + C0 f_dc and activated opacity, both times 255
        ("quaternion", "u1", 4),  # (w, x, y, z) as (byte - 128) / 128
    ]
)
_C0 = float(SH_C0)
_MARGIN = 0.5 / 255  # values this far outside 0..1 still round to a byte


def read_splat(path: Path) -> Scene:
    """The Gaussians of a ``.splat`` file, SH degree 0.

    Raises InputError unless the file holds one or more whole records of finite means, scales >= 0
    and quaternions of non-zero length.
    """
    (table,) = _tables(path, None)
    return _decode(table, str(path))


def iterate_splat(path: Path, chunk: int = 2**18) -> Iterator[Scene]:
    """The Gaussians of a ``.splat`` file of any size, ``chunk`` at a time, in file order.

    Together the scenes are what ``read_splat`` returns, bit for bit, in memory that depends on
    ``chunk`` alone. Errors are those of ``read_splat``, raised when the chunk is reached.
    """
    if chunk < 1:
        raise InputError(f"chunk must be a positive number of Gaussians, not {chunk}")
    first = 0
    for table in _tables(path, chunk):
        yield _decode(table, str(path) if first == 0 else f"{path} from Gaussian {first} on")
        first += len(table)


def _tables(path: Path, chunk: int | None) -> Iterator[NDArray[np.void]]:
    """The records, ``chunk`` at a time (None: all at once)."""
    size = file_size(path)
    if size == 0:
        raise InputError(f"{path}: empty: must hold at least one Gaussian")
    if size % _RECORD.itemsize:
        raise InputError(f"{path}: size must be a multiple of {_RECORD.itemsize} bytes, not {size}")
    total = size // _RECORD.itemsize
    step = total if chunk is None else chunk
    try:
        with path.open("rb") as stream:
            for first in range(0, total, step):
                count = min(step, total - first)
                table = np.fromfile(stream, _RECORD, count)
                if len(table) != count:
                    raise InputError(f"{path}: truncated while it was read")
                yield table
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def _decode(table: NDArray[np.void], name: str) -> Scene:
    colour = (table["rgba"][:, :3] / 255.0 - 0.5) / _C0
    return Scene(
        means=np.ascontiguousarray(table["mean"], np.float32),
        quaternions=normalised_quaternions(table["quaternion"] - 128.0, name),
        scales=np.ascontiguousarray(table["scale"], np.float32),
        opacities=(table["rgba"][:, 3] / 255.0).astype(np.float32),
        sh=colour[:, None, :].astype(np.float32),
    ).validate(name)


def write_splat(scene: Scene, path: Path) -> None:
    """Write a scene of SH degree 0 as ``.splat``; the file is replaced in one step.

    Read back, means and scales have the same bits. An opacity and a colour 0.5 + C0 f_dc change by
    at most 0.00197 (half a step of 1/255); a component of a quaternion by at most 0.008 (four bytes
    of step 1/128, then normalised).

    Raises InputError for an invalid or empty scene, and for what the format cannot hold: see
    ``fit_splat``.
    """
    scene.validate(str(path))
    if not len(scene):
        raise InputError(f"{path}: a .splat scene must hold at least one Gaussian")
    lost = fit_splat(scene)[1]
    if lost:
        raise InputError(f"{path}: .splat cannot hold {losses(lost)}; drop them first")
    table = np.zeros(len(scene), _RECORD)
    table["mean"], table["scale"] = scene.means, scene.scales
    table["rgba"][:, :3] = np.rint(_colours(scene) * 255).clip(0, 255)
    table["rgba"][:, 3] = np.rint(scene.opacities * 255.0)
    # 1 would be byte 256; the 255 in its place is shorter, which normalising makes good
    table["quaternion"] = np.rint(scene.quaternions * 128.0 + 128.0).clip(0, 255)
    write_atomically(path, [table.tobytes()])


def fit_splat(scene: Scene) -> tuple[Scene, dict[str, int]]:
    """The scene as a ``.splat`` can hold it, and how many values changed, by what they were.

    Harmonics above degree 0 are dropped; opacities above 1 become 1; colours 0.5 + C0 f_dc beyond
    0..1 (by more than half a step of 1/255) become 0 or 1.
    """
    lost: dict[str, int] = {}
    colours = _colours(scene)
    if scene.sh_degree:
        lost["harmonics above degree 0"] = scene.sh[:, 1:].size
        scene = replace(scene, sh=scene.sh[:, :1])
    if (scene.opacities > 1).any():
        lost["opacities above 1"] = int((scene.opacities > 1).sum())
        scene = replace(scene, opacities=np.minimum(scene.opacities, np.float32(1)))
    outside = (colours < -_MARGIN) | (colours > 1 + _MARGIN)
    if outside.any():
        lost["colours outside 0..1"] = int(outside.sum())
        fitted = np.where(outside, (colours.clip(0, 1) - 0.5) / _C0, scene.sh[:, 0])
        scene = replace(scene, sh=fitted[:, None, :].astype(np.float32))
    return scene, lost


def _colours(scene: Scene) -> NDArray[np.float64]:
    """[N, 3] base colours, 0..1 where a display can show them."""
    return 0.5 + _C0 * scene.sh[:, 0].astype(np.float64)
