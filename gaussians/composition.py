"""Compositions: many placed copies (instances) of few scenes, composed only as far as needed.

An instance with scale s, rotation R and position t moves every Gaussian of its base scene as
`transforms.transformed` does: mean to s R mean + t, standard deviations times s, orientation and
spherical harmonics turned by R.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.cameras import StereoRig
from gaussians.constants import DILATION_PX2
from gaussians.errors import InputError
from gaussians.rotations import rotations_from_quaternions
from gaussians.scene import FIELDS, Scene
from gaussians.transforms import transformed

Float64 = NDArray[np.float64]
Indices = NDArray[np.int64]

_COUNT_LIMIT = 2**31 - 1  # ids are int32
_REACH_LIMIT = 1e12  # as for trees: squares of coordinates stay finite in float32
_UNIT_TOLERANCE = 1e-10  # rotations must be orthonormal within 1e-9
_ROUNDING = 1e-5  # relative slack of the culling, far above the projection's float32 rounding
# Footprints widen by rounding as the condition number of their image covariance grows: by this
# factor at 7e5, below the 1e6 from which `ill_conditioned` counts them (conventions.md).
_WIDENING = 1.25


@dataclass(frozen=True)
class Instances:
    """I placed copies of base scenes."""

    bases: NDArray[np.int64]  # [I] which base scene
    scales: Float64  # [I] > 0
    quaternions: Float64  # [I, 4] unit, (w, x, y, z)
    positions: Float64  # [I, 3] units of the composition

    def __len__(self) -> int:
        return len(self.scales)

    def validate(self, base_count: int, name: str = "composition") -> Instances:
        """Return self, or raise InputError naming the first instance that is wrong."""
        count = len(self)
        shapes = {"bases": (count,), "scales": (count,), "quaternions": (count, 4)}
        for field, shape in {**shapes, "positions": (count, 3)}.items():
            found = getattr(self, field).shape
            if found != shape:
                raise InputError(f"{name}: {field} must have shape {shape}, not {found}")
        lengths = np.linalg.norm(self.quaternions, axis=1)
        known = (self.bases >= 0) & (self.bases < base_count)
        positive = (self.scales > 0) & np.isfinite(self.scales)
        unit = np.abs(lengths - 1) <= _UNIT_TOLERANCE
        for good, values, rule in (
            (known, self.bases, f"base must lie in 0..{base_count - 1}"),
            (positive, self.scales, "scale must be a positive number"),
            (unit, lengths, "quaternion must have length 1"),
            (np.isfinite(self.positions).all(axis=1), self.positions, "position must be finite"),
        ):
            if not good.all():
                bad = int(np.argmin(good))
                raise InputError(f"{name}: instance {bad}: {rule}, not {values[bad]}")
        return self


@dataclass(frozen=True)
class VisibleInstances:
    """Which instances a stereo rig may see, and why the others are left out."""

    indices: Indices  # [V] ascending
    behind_near: int  # all their means lie before the near plane
    outside: int  # in front, but outside both eyes' windows

    @property
    def left_out(self) -> int:
        """Instances that need not be composed."""
        return self.behind_near + self.outside


@dataclass(frozen=True)
class _Bounds:
    """What culling knows of one base scene, in its units."""

    centre: Float64  # [3] middle of the means' box
    radius: float  # of the ball around it that holds all means
    reach: float  # largest distance, over the Gaussians, at which alpha falls to 1/255
    sigmas: float  # the same in standard deviations


class Composition:
    """Base scenes and their instances. Owns no composed Gaussians: these are made when asked for.

    Gaussian g of an instance's base follows Gaussian g - 1, instance after instance; so composing
    fewer instances keeps the relative order, and with it the drawing order of equal depths.

    Raises InputError for invalid bases or instances, and for a composition that reaches beyond 1e12
    units.
    """

    def __init__(
        self, bases: Sequence[Scene], instances: Instances, name: str = "composition"
    ) -> None:
        if not bases or not len(instances):
            raise InputError(f"{name}: must hold at least one base scene and one instance")
        for number, base in enumerate(bases):
            if not len(base):
                raise InputError(f"{name}: base scene {number} must hold at least one Gaussian")
            base.validate(f"{name}: base scene {number}")
        self.bases, self.name = tuple(bases), name
        self.instances = instances.validate(len(bases), name)
        self._coefficients = max(base.sh.shape[1] for base in self.bases)
        self._bounds = [_bounds(base) for base in bases]
        self._rotations = rotations_from_quaternions(instances.quaternions)
        centres, radii, reaches, _ = self._balls(np.arange(len(instances)))
        far = np.abs(centres).max(axis=1) + radii + reaches
        if not (far <= _REACH_LIMIT).all():
            bad = int(np.argmin(far <= _REACH_LIMIT))
            raise InputError(
                f"{name}: instance {bad} must stay within {_REACH_LIMIT:g} units, not {far[bad]:g}"
            )

    def __len__(self) -> int:
        """Gaussians of the whole composition."""
        return self.count()

    def count(self, indices: Indices | None = None) -> int:
        """Gaussians that ``compose(indices)`` makes."""
        sizes = np.array([len(base) for base in self.bases], np.int64)
        return int(sizes[self.instances.bases[self._chosen(indices)]].sum())

    def scene_bytes(self, indices: Indices | None = None) -> int:
        """Size of what ``compose(indices)`` makes: 56 bytes per Gaussian at SH degree 0."""
        return self.count(indices) * 4 * (3 + 4 + 3 + 1 + 3 * self._coefficients)

    def compose(self, indices: Indices | None = None) -> Scene:
        """The Gaussians of these instances (default: all), in this order.

        Takes `scene_bytes` of memory, and little beside it.

        Raises InputError for indices that do not exist and for more than 2^31 - 1 Gaussians.
        """
        chosen = self._chosen(indices)
        count = self.count(chosen)
        if count > _COUNT_LIMIT:
            raise InputError(
                f"{self.name}: at most {_COUNT_LIMIT} Gaussians can be composed, not {count}"
            )
        out = Scene(
            means=np.empty((count, 3), np.float32),
            quaternions=np.empty((count, 4), np.float32),
            scales=np.empty((count, 3), np.float32),
            opacities=np.empty(count, np.float32),
            sh=np.empty((count, self._coefficients, 3), np.float32),
        )
        begin = 0
        for index in chosen:
            end = begin + len(self.bases[self.instances.bases[index]])
            self._place(int(index), out, slice(begin, end))
            begin = end
        return out

    def iterate(
        self, instances_at_once: int, indices: Indices | None = None
    ) -> Iterator[tuple[Indices, Scene]]:
        """Compose in parts of so many instances: each part's indices and Gaussians, in order."""
        if instances_at_once < 1:
            raise InputError(
                f"{self.name}: instances at once must be >= 1, not {instances_at_once}"
            )
        chosen = self._chosen(indices)
        for begin in range(0, len(chosen), instances_at_once):
            part = chosen[begin : begin + instances_at_once]
            yield part, self.compose(part)

    def visible(self, rig: StereoRig) -> VisibleInstances:
        """The instances that may contribute to either eye's image.

        Conservative: rendering only these gives the same images, bit for bit, as long as no image
        covariance has a condition number above 7e5. A mean at camera depth z is drawn if z >= near;
        its footprint ends, in x / z, at most sqrt((e/z)^2 (1 + lim^2) + 0.3 (k/f)^2) from the mean
        (conventions.md: e its reach, k its threshold in standard deviations, lim the clamp of the
        Jacobian). With the ball of the means, each side of a window becomes one plane test.
        """
        everything = np.arange(len(self.instances))
        centres, radii, reaches, sigmas = self._balls(everything)
        rotation, left = rig.pose.rotation, rig.left_position
        seen = np.stack([(centres - left) @ rotation[:, axis] for axis in range(3)], axis=1)
        slack = _ROUNDING * (np.abs(centres).max(axis=1) + np.abs(left).max() + radii)
        behind = seen[:, 2] + radii + slack < rig.near_m
        limits = rig.jacobian_limits
        display = rig.display
        inside = np.zeros(len(everything), np.bool_)
        for shift, cx in ((0.0, display.cx_left), (rig.baseline_m, display.cx_right)):
            x, y, z = seen[:, 0] - shift, seen[:, 1], seen[:, 2]
            meets = np.ones(len(everything), np.bool_)
            sides = (
                (x, display.fx, display.width - cx, limits[0]),
                (-x, display.fx, cx, limits[0]),
                (y, display.fy, display.height - display.cy, limits[1]),
                (-y, display.fy, display.cy, limits[1]),
            )
            for distance, focal, edge_px, limit in sides:
                blur_px = math.sqrt(float(DILATION_PX2)) * sigmas * _WIDENING
                tangent = (edge_px + blur_px) / focal
                room = radii * np.hypot(1.0, tangent) + reaches * _WIDENING * math.hypot(1.0, limit)
                meets &= distance - tangent * z <= room + slack * (1.0 + np.abs(tangent))
            inside |= meets
        return VisibleInstances(
            np.flatnonzero(inside & ~behind), int(behind.sum()), int((~inside & ~behind).sum())
        )

    def depths(self, rig: StereoRig) -> Float64:
        """[I] camera depth of every instance's centre."""
        centres = self._balls(np.arange(len(self.instances)))[0]
        return np.asarray((centres - rig.left_position) @ rig.pose.rotation[:, 2])

    def _chosen(self, indices: Indices | None) -> Indices:
        if indices is None:
            return np.arange(len(self.instances))
        chosen = np.asarray(indices, np.int64)
        good = (chosen >= 0) & (chosen < len(self.instances))
        if chosen.ndim != 1 or not good.all():
            raise InputError(
                f"{self.name}: instance indices must be a list of numbers from 0 to "
                f"{len(self.instances) - 1}"
            )
        return chosen

    def _balls(self, indices: Indices) -> tuple[Float64, Float64, Float64, Float64]:
        """Of each instance: centre [I, 3] and radius of its means, reach, threshold in sigmas."""
        which, scales = self.instances.bases[indices], self.instances.scales[indices]
        centres = np.array([b.centre for b in self._bounds])[which]
        placed = (self._rotations[indices] * centres[:, None, :]).sum(axis=2)
        per_base = np.array([(b.radius, b.reach, b.sigmas) for b in self._bounds])[which]
        return (
            scales[:, None] * placed + self.instances.positions[indices],
            scales * per_base[:, 0],
            scales * per_base[:, 1],
            per_base[:, 2],
        )

    def _place(self, index: int, out: Scene, rows: slice) -> None:
        """Write one instance's Gaussians into rows of ``out``; missing harmonics become zeros."""
        x, y, z = (float(coordinate) for coordinate in self.instances.positions[index])
        placed = transformed(
            self.bases[self.instances.bases[index]],
            self._rotations[index],
            float(self.instances.scales[index]),
            (x, y, z),
        )
        for field in FIELDS[:-1]:
            getattr(out, field)[rows] = getattr(placed, field)
        coefficients = placed.sh.shape[1]
        out.sh[rows, :coefficients] = placed.sh
        out.sh[rows, coefficients:] = 0


def _bounds(base: Scene) -> _Bounds:
    means = base.means.astype(np.float64)
    centre = (means.min(axis=0) + means.max(axis=0)) / 2
    radius = float(np.linalg.norm(means - centre, axis=1).max())
    opaque = np.maximum(255.0 * base.opacities.astype(np.float64), 1.0)
    sigmas = np.sqrt(2.0 * np.log(opaque))
    reach = float((sigmas * base.scales.max(axis=1)).max())
    return _Bounds(centre, radius, reach, float(sigmas.max()))
