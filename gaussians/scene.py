"""The scene container: a structure of arrays of 3D Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.constants import OPACITY_LIMIT
from gaussians.errors import InputError

Float32 = NDArray[np.float32]

SH_DEGREE_OF_COUNT = {1: 0, 4: 1, 9: 2, 16: 3}
_UNIT_ROUNDING = 2.0**-23  # rounding components to float32 moves a length of 1 by half of this


@dataclass(frozen=True)
class Scene:
    """N Gaussians, splat-major. Owns values only: no camera, no level of detail.

    The row number of a Gaussian is its *id*; equal depths are drawn in the order of ids.
    """

    means: Float32  # [N, 3] metres, world
    quaternions: Float32  # [N, 4] unit, (w, x, y, z), local axes to world
    scales: Float32  # [N, 3] standard deviations along the local axes, linear, metres, >= 0
    opacities: Float32  # [N] after activation; 0..1, merged level-of-detail parents may exceed 1
    sh: Float32  # [N, K, 3] spherical-harmonic coefficients, K = (degree + 1)**2, INRIA signs

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree 0 to 3 of the spherical harmonics."""
        return SH_DEGREE_OF_COUNT[self.sh.shape[1]]

    def validate(self, name: str = "scene") -> Scene:
        """Return self, or raise InputError naming the first property that is wrong.

        Checks shapes, dtypes, finiteness, unit quaternions (1e-3), scales >= 0, opacities in
        0..1e6. ``name`` starts the message.
        """
        count = len(self.means)
        shapes = {
            "means": (count, 3),
            "quaternions": (count, 4),
            "scales": (count, 3),
            "opacities": (count,),
        }
        for field, shape in shapes.items():
            array = getattr(self, field)
            if array.shape != shape:
                raise InputError(f"{name}: {field} must have shape {shape}, not {array.shape}")
        if self.sh.ndim != 3 or self.sh.shape[0] != count or self.sh.shape[2] != 3:
            raise InputError(f"{name}: sh must have shape ({count}, K, 3), not {self.sh.shape}")
        if self.sh.shape[1] not in SH_DEGREE_OF_COUNT:
            raise InputError(
                f"{name}: sh must hold 1, 4, 9 or 16 coefficients, not {self.sh.shape[1]}"
            )
        for field in (*shapes, "sh"):
            array = getattr(self, field)
            if array.dtype != np.float32:
                raise InputError(f"{name}: {field} must be float32, not {array.dtype}")
            finite = np.isfinite(array)
            if not finite.all():
                finite = finite.all(axis=tuple(range(1, array.ndim)))
                bad = int(np.argmin(finite))
                raise InputError(
                    f"{name}: {field} must be finite; {int((~finite).sum())} of {count} Gaussians "
                    f"are not, the first is number {bad}"
                )
        if (self.scales < 0).any():
            bad = int(np.argmax((self.scales < 0).any(axis=1)))
            raise InputError(f"{name}: scales must be >= 0; Gaussian {bad} has {self.scales[bad]}")
        outside = (self.opacities < 0) | (self.opacities > OPACITY_LIMIT)
        if outside.any():
            bad = int(np.argmax(outside))
            raise InputError(
                f"{name}: opacities must lie in 0..{OPACITY_LIMIT:g}; "
                f"Gaussian {bad} has {self.opacities[bad]}"
            )
        quaternions = self.quaternions.astype(np.float64)
        norms = np.sqrt(np.einsum("ij,ij->i", quaternions, quaternions))
        if count and np.abs(norms - 1).max() > 1e-3:
            bad = int(np.argmax(np.abs(norms - 1)))
            raise InputError(
                f"{name}: quaternions must have length 1; Gaussian {bad} has {norms[bad]:g}"
            )
        return self

    def take(self, ids: NDArray[np.integer]) -> Scene:
        """The Gaussians with these ids, in this order (copied)."""
        return Scene(*(getattr(self, field)[ids] for field in FIELDS))

    def scaled(self, factor: float) -> Scene:
        """The same scene with every length multiplied by ``factor`` (unit conversion)."""
        if not (np.isfinite(factor) and factor > 0):
            raise InputError(f"scale factor must be a positive number, not {factor}")
        f = np.float32(factor)
        return Scene(self.means * f, self.quaternions, self.scales * f, self.opacities, self.sh)


FIELDS = ("means", "quaternions", "scales", "opacities", "sh")


def concatenate(scenes: list[Scene]) -> Scene:
    """All Gaussians of the scenes in order; missing SH degrees are filled with zeros."""
    if not scenes:
        raise InputError("concatenate needs at least one scene")
    coefficients = max(s.sh.shape[1] for s in scenes)
    harmonics = [np.pad(s.sh, ((0, 0), (0, coefficients - s.sh.shape[1]), (0, 0))) for s in scenes]
    joined = {f: np.concatenate([getattr(s, f) for s in scenes]) for f in FIELDS[:-1]}
    return Scene(**joined, sh=np.concatenate(harmonics))


def normalised_quaternions(quaternions: NDArray[np.floating], name: str = "scene") -> Float32:
    """Unit quaternions [N, 4] float32; normalised in float64. Zero length raises InputError.

    Rows that rounding to float32 may have left off length 1 keep their bits, so that normalising
    again, as reading a written file does, changes nothing.
    """
    wide = np.asarray(quaternions, np.float64)
    norms = np.linalg.norm(wide, axis=1, keepdims=True)
    norms[np.abs(norms - 1.0) <= _UNIT_ROUNDING] = 1.0
    if len(wide) and not (norms > 0).all():
        bad = int(np.argmin(norms[:, 0] > 0))
        raise InputError(f"{name}: quaternion {bad} must not have length {norms[bad, 0]:g}")
    return (wide / norms).astype(np.float32)
