"""Scenes moved, turned, cropped and simplified.

Turning a scene turns its view-dependent colour with it. The spherical harmonics of one degree span
all their turned copies, so each degree l has a matrix of (2l+1)^2 numbers that turns coefficients:
with f(d) = sum_j c_j B_j(d), the turned colour f(R^T d) = sum_i c'_i B_i(d) has

    c' = M c        M_ij = <B_i(d), B_j(R^T d)> / <B_i(d), B_i(d)>

where B is the project's own basis (conventions.md, ``constants``) and <,> the integral over the
sphere. Products of two harmonics of degree <= 3 are polynomials of degree <= 6 in d; the quadrature
below (Gauss-Legendre in z, equal angles about z: https://dlmf.nist.gov/3.5#v) integrates them
exactly, so M is right to float64 rounding and nothing has to be solved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.constants import SH_C1, SH_C2, SH_C3
from gaussians.errors import InputError
from gaussians.rotations import level_rotation, quaternions_from_rotations
from gaussians.scene import Scene, normalised_quaternions

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Point = tuple[float, float, float]

ORIGIN: Point = (0.0, 0.0, 0.0)
_ORTHONORMAL_TOLERANCE = 1e-9
_NEGLIGIBLE = 1e-14  # quadrature leaves this much where M is 0; keeps absent harmonics absent
_Z_NODES, _ANGLES = 4, 8  # exact to degree 7 in z, to order 7 about z
_BLOCK = 1 << 18  # Gaussians whose harmonics are widened to float64 at a time


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, faces included. Raises InputError unless finite and low <= high."""

    low: Point
    high: Point

    def __post_init__(self) -> None:
        corners = np.array([self.low, self.high], np.float64)
        if corners.shape != (2, 3) or not np.isfinite(corners).all():
            raise InputError(f"box must have two corners of three finite numbers, not {self}")
        if (corners[0] > corners[1]).any():
            raise InputError(f"box: no coordinate of {self.low} may exceed that of {self.high}")

    def ids(self, points: NDArray[np.floating]) -> NDArray[np.intp]:
        """Which of the points [N, 3] lie in the box, ascending; compared in float64."""
        wide = points.astype(np.float64)
        return np.flatnonzero(((wide >= self.low) & (wide <= self.high)).all(axis=1))


def parse_box(text: str) -> Box:
    """``X0,Y0,Z0:X1,Y1,Z1``, least corner first; anything else is an InputError."""
    try:
        low, high = (tuple(float(number) for number in part.split(",")) for part in text.split(":"))
        (x0, y0, z0), (x1, y1, z1) = low, high
    except ValueError as error:
        raise InputError(f"box must be X0,Y0,Z0:X1,Y1,Z1, not {text!r}") from error
    return Box((x0, y0, z0), (x1, y1, z1))


def crop(scene: Scene, box: Box) -> Scene:
    """The Gaussians whose means lie in the box, in their order; may be none."""
    return scene.take(box.ids(scene.means))


def with_sh_degree(scene: Scene, degree: int) -> Scene:
    """The scene without the harmonics above ``degree``; a higher degree than it has: InputError."""
    if not 0 <= degree <= scene.sh_degree:
        raise InputError(f"SH degree must lie in 0..{scene.sh_degree} of the scene, not {degree}")
    harmonics = np.ascontiguousarray(scene.sh[:, : (degree + 1) ** 2])
    return Scene(scene.means, scene.quaternions, scene.scales, scene.opacities, harmonics)


def up_rotation(old: str, new: str) -> Float64:
    """[3, 3] exact rotation that makes ``new`` the vertical of a scene whose vertical is ``old``.

    Both are ``+x`` to ``-z``. It takes the level frame of one axis to that of the other
    (``rotations.level_rotation``), so the scene's front stays its front, changing back restores
    the scene, and a change by way of a third axis is the same as a direct one.
    """
    return level_rotation(new) @ level_rotation(old).T


def transformed(
    scene: Scene, rotation: Float64, scale: float = 1.0, translation: Point = ORIGIN
) -> Scene:
    """The scene with every point x at ``scale * rotation @ x + translation``.

    Means, standard deviations, orientations and view-dependent colours all follow; float64, each
    stored number rounded once. Raises InputError unless ``rotation`` [3, 3] is orthonormal within
    1e-9 and right-handed, ``scale`` positive and all is finite, and where a mean or scale leaves
    the range of float32.
    """
    rotation = _checked_rotation(rotation)
    if not (math.isfinite(scale) and scale > 0):
        raise InputError(f"scale must be a positive number, not {scale}")
    offset = np.asarray(translation, np.float64)
    if offset.shape != (3,) or not np.isfinite(offset).all():
        raise InputError(f"translation must be three finite numbers, not {translation}")
    with np.errstate(over="ignore"):  # inf is refused by validate()
        means = (scene.means.astype(np.float64) @ rotation.T * scale + offset).astype(np.float32)
        scales = (scene.scales.astype(np.float64) * scale).astype(np.float32)
    return Scene(
        means,
        _turned_quaternions(scene.quaternions, rotation),
        scales,
        scene.opacities,
        _turned_harmonics(scene.sh, sh_rotation(rotation, scene.sh_degree)),
    ).validate("transformed scene")


def sh_rotation(rotation: Float64, degree: int) -> list[Float64]:
    """The matrices M [2l+1, 2l+1] of degree l = 1 .. ``degree`` (<= 3) for a rotation [3, 3].

    Coefficients k_{l^2} .. k_{l^2+2l} of one channel, as a column, are turned by ``M @ k``. Entries
    are right to 1e-14. Raises InputError for what is not a rotation.
    """
    rotation = _checked_rotation(rotation)
    directions, weights = _quadrature()
    fixed, turned = _basis(directions), _basis(directions @ rotation)  # rows: R^T d
    blocks = []
    for order in range(1, degree + 1):
        part = slice(order**2 - 1, (order + 1) ** 2 - 1)
        products = (weights[:, None] * fixed[:, part]).T @ turned[:, part]
        norms = (weights[:, None] * fixed[:, part] ** 2).sum(axis=0)
        block = products / norms[:, None]
        block[np.abs(block) < _NEGLIGIBLE] = 0.0
        blocks.append(block)
    return blocks


def _checked_rotation(rotation: Float64) -> Float64:
    rotation = np.asarray(rotation, np.float64)
    if rotation.shape != (3, 3) or not np.isfinite(rotation).all():
        raise InputError(f"rotation must be a finite 3 x 3 matrix, not of shape {rotation.shape}")
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > _ORTHONORMAL_TOLERANCE or np.linalg.det(rotation) < 0:
        raise InputError(
            "rotation must be orthonormal and right-handed: "
            f"off by {error:g}, determinant {np.linalg.det(rotation):g}"
        )
    return rotation


def _turned_quaternions(quaternions: Float32, rotation: Float64) -> Float32:
    """Hamilton product (rotation's quaternion) (each quaternion), normalised."""
    a, b, c, d = quaternions_from_rotations(rotation[None])[0]
    product = np.array([[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]])
    return normalised_quaternions(quaternions.astype(np.float64) @ product.T)


def _turned_harmonics(sh: Float32, blocks: list[Float64]) -> Float32:
    """Each degree's coefficients times its matrix, a block of Gaussians at a time."""
    result = sh.copy()
    for begin in range(0, len(sh), _BLOCK):
        rows = slice(begin, begin + _BLOCK)
        for order, block in enumerate(blocks, start=1):
            part = slice(order**2, (order + 1) ** 2)
            result[rows, part] = np.matmul(block, sh[rows, part].astype(np.float64))
    return result


def _quadrature() -> tuple[Float64, Float64]:
    """Directions [Q, 3] and weights [Q] that integrate polynomials of degree 7 on the sphere."""
    nodes, node_weights = np.polynomial.legendre.leggauss(_Z_NODES)
    angles = 2 * np.pi * (np.arange(_ANGLES) + 0.5) / _ANGLES
    z, angle = (grid.reshape(-1) for grid in np.meshgrid(nodes, angles, indexing="ij"))
    across = np.sqrt(1 - z * z)
    directions = np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
    return directions, np.repeat(node_weights, _ANGLES) * (2 * np.pi / _ANGLES)


def _basis(directions: Float64) -> Float64:
    """[Q, 15] values of the project's basis, degree 1 to 3, in float64."""
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    c1, c2, c3 = float(SH_C1), SH_C2.astype(np.float64), SH_C3.astype(np.float64)
    first = [-c1 * y, c1 * z, -c1 * x]
    second = [x * y, y * z, 2 * zz - xx - yy, x * z, xx - yy]
    third = [
        y * (3 * xx - yy),
        x * y * z,
        y * (4 * zz - xx - yy),
        z * (2 * zz - 3 * xx - 3 * yy),
        x * (4 * zz - xx - yy),
        z * (xx - yy),
        x * (xx - 3 * yy),
    ]
    return np.stack([*first, *(c2[:, None] * second), *(c3[:, None] * third)], axis=1)
