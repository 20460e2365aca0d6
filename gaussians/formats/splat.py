"""``.splat`` files: 32-byte records without a header; spherical harmonics of degree 0 only."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gaussians.constants import SH_C0
from gaussians.errors import InputError
from gaussians.scene import Scene, normalised_quaternions

_RECORD = np.dtype(
    [
        ("mean", "<f4", 3),
        ("scale", "<f4", 3),  # linear
        ("rgba", "u1", 4),  # colour 0.5 + C0 f_dc and activated opacity, both times 255
        ("quaternion", "u1", 4),  # (w, x, y, z) as (byte - 128) / 128
    ]
)


def read_splat(path: Path) -> Scene:
    """The Gaussians of a ``.splat`` file, SH degree 0.

    Raises InputError unless the file holds one or more whole records of finite means, scales >= 0
    and quaternions of non-zero length.
    """
    try:
        size = path.stat().st_size
        if size == 0:
            raise InputError(f"{path}: empty: must hold at least one Gaussian")
        if size % _RECORD.itemsize:
            raise InputError(
                f"{path}: size must be a multiple of {_RECORD.itemsize} bytes, not {size}"
            )
        table = np.fromfile(path, _RECORD)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    colour = (table["rgba"][:, :3] / 255.0 - 0.5) / float(SH_C0)
    return Scene(
        means=np.ascontiguousarray(table["mean"], np.float32),
        quaternions=normalised_quaternions(table["quaternion"] - 128.0, str(path)),
        scales=np.ascontiguousarray(table["scale"], np.float32),
        opacities=(table["rgba"][:, 3] / 255.0).astype(np.float32),
        sh=colour[:, None, :].astype(np.float32),
    ).validate(str(path))
