"""Rotations in float64: unit quaternions (w, x, y, z), matrices, angles, and level frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError

Float64 = NDArray[np.float64]

UP_AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
# Where a level camera looks by default, by the axis that points up. Captures that follow the usual
# conventions then show their front: y-up (or y-down) objects face +z, z-up ones face -y.
_FRONT = {"x": (0.0, 0.0, -1.0), "y": (0.0, 0.0, -1.0), "z": (0.0, 1.0, 0.0)}


def up_vector(up: str) -> Float64:
    """[3] unit vector of ``+x``, ``-x``, ``+y``, ``-y``, ``+z`` or ``-z``."""
    if up not in UP_AXES:
        raise InputError(f"up axis must be one of {', '.join(UP_AXES)}, not {up!r}")
    vector = np.zeros(3)
    vector["xyz".index(up[1])] = -1.0 if up[0] == "-" else 1.0
    return vector


def level_rotation(up: str, forward: Float64 | None = None) -> Float64:
    """[3, 3] camera-to-world of a level camera: columns right, down (= -up), horizontal forward.

    The view runs along the horizontal part of ``forward`` (default: -z for an x or y axis as up, +y
    for a z axis). Raises InputError when ``forward`` is vertical.
    """
    vertical = up_vector(up)
    wanted = np.array(_FRONT[up[1]]) if forward is None else np.asarray(forward, np.float64)
    horizontal = wanted - (wanted @ vertical) * vertical
    length = float(np.linalg.norm(horizontal))
    if not length > 1e-6 * float(np.linalg.norm(wanted)):
        raise InputError("view: the direction of view must not be parallel to the up axis")
    horizontal = horizontal / length
    return np.stack([np.cross(horizontal, vertical), -vertical, horizontal], axis=1)


def rotations_from_angles(yaw: Float64, pitch: Float64, roll: Float64) -> Float64:
    """[F, 3, 3] turns of an OpenCV camera: yaw right, pitch up, roll clockwise (radians)."""
    zero, one = np.zeros_like(yaw), np.ones_like(yaw)

    def matrices(rows: list[list[Float64]]) -> Float64:
        return np.moveaxis(np.array(rows), 2, 0)

    c, s = np.cos(yaw), np.sin(yaw)
    about_down = matrices([[c, zero, s], [zero, one, zero], [-s, zero, c]])
    c, s = np.cos(pitch), np.sin(pitch)
    about_right = matrices([[one, zero, zero], [zero, c, -s], [zero, s, c]])
    c, s = np.cos(roll), np.sin(roll)
    about_forward = matrices([[c, -s, zero], [s, c, zero], [zero, zero, one]])
    return about_down @ about_right @ about_forward


def rotations_from_quaternions(quaternions: Float64) -> Float64:
    """[F, 3, 3] from unit quaternions [F, 4]."""
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def quaternions_from_rotations(rotations: Float64) -> Float64:
    """[F, 4] unit quaternions of rotation matrices [F, 3, 3]; the sign is arbitrary.

    Row k of the symmetric matrix 4 q q^T is computed for the largest component k, which keeps the
    division well conditioned (Shepperd's method, doi:10.2514/3.55767b).
    """
    r = rotations
    trace = np.trace(r, axis1=1, axis2=2)
    products = np.empty((len(r), 4, 4))
    products[:, 0, 0] = 1 + trace
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        products[:, i + 1, i + 1] = 1 + 2 * r[:, i, i] - trace
        products[:, 0, i + 1] = products[:, i + 1, 0] = r[:, k, j] - r[:, j, k]
        products[:, i + 1, j + 1] = products[:, j + 1, i + 1] = r[:, j, i] + r[:, i, j]
    largest = np.argmax(np.diagonal(products, axis1=1, axis2=2), axis=1)
    rows = products[np.arange(len(r)), largest]
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def slerp(first: Float64, second: Float64, share: Float64) -> Float64:
    """[F, 4] unit quaternions on the shorter arc: ``first`` at share 0, ``second`` at share 1."""
    cosine = (first * second).sum(axis=1)
    second = np.where(cosine < 0, -1.0, 1.0)[:, None] * second
    angle = 2 * np.arctan2(
        np.linalg.norm(first - second, axis=1), np.linalg.norm(first + second, axis=1)
    )
    near = angle < 1e-6  # sin(a t) / sin(a) = t there, within float64
    sine = np.where(near, 1.0, np.sin(angle))
    a = np.where(near, 1 - share, np.sin((1 - share) * angle) / sine)
    b = np.where(near, share, np.sin(share * angle) / sine)
    mixed = a[:, None] * first + b[:, None] * second
    return mixed / np.linalg.norm(mixed, axis=1, keepdims=True)
