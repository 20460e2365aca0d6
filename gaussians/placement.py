"""Where a scene's vertical points, how long its units are, and where the viewer starts.

Scenes and view strings are in the units of their file; traces, poses and everything rendered are in
metres: metres = units / ``units_per_metre``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from gaussians.cameras import Pose, look_at
from gaussians.errors import InputError
from gaussians.poses import HeadTrace
from gaussians.rotations import level_rotation, up_vector
from gaussians.scene import Scene

Point = tuple[float, float, float]
View = tuple[Point, Point]  # eye, look-at point

_FRAME_TANGENT = 0.8  # auto-framing puts the box within |x/z|, |y/z| <= this (77 degrees)
_ELEVATION_RAD = math.radians(20.0)
_BOX_PERCENTILES = (1.0, 99.0)


def point(coordinates: Iterable[float]) -> Point:
    """Three numbers, such as an array [3], as plain Python floats: what JSON and equality like."""
    x, y, z = (float(c) for c in coordinates)
    return x, y, z


@dataclass(frozen=True)
class Placement:
    """How a scene file stands in the world. ``view`` None means auto-framing."""

    up: str  # the scene's vertical: "+x", "-x", "+y", "-y", "+z" or "-z"
    units_per_metre: float = 1.0
    view: View | None = None  # eye and look-at point, file units
    near_m: float = 0.2

    def __post_init__(self) -> None:
        up_vector(self.up)
        for name in ("units_per_metre", "near_m"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"placement: {name} must be a positive number, not {value}")
        if self.view is not None:
            eye, target = (np.array(point, np.float64) for point in self.view)
            if eye.shape != (3,) or target.shape != (3,) or not np.isfinite([eye, target]).all():
                raise InputError(f"placement: view must be two finite points, not {self.view}")
            look_at(eye, target, up_vector(self.up))

    def view_pose(self, scene: Scene) -> Pose:
        """The first head pose in metres; ``scene``, in file units, serves auto-framing only."""
        eye, target = self.view or auto_view(scene, self.up)
        to_metres = 1.0 / self.units_per_metre
        return look_at(np.array(eye) * to_metres, np.array(target) * to_metres, up_vector(self.up))


def parse_view(text: str) -> View:
    """``EX,EY,EZ:LX,LY,LZ`` (eye : look-at point, file units); anything else is an InputError."""
    try:
        eye, target = (
            tuple(float(number) for number in part.split(",")) for part in text.split(":")
        )
        (ex, ey, ez), (lx, ly, lz) = eye, target
    except ValueError as error:
        raise InputError(f"view must be EX,EY,EZ:LX,LY,LZ, not {text!r}") from error
    if not all(math.isfinite(number) for number in (*eye, *target)):
        raise InputError(f"view must hold finite numbers, not {text!r}")
    if eye == target:
        raise InputError(f"view: eye and look-at point must not coincide, as in {text!r}")
    return (ex, ey, ez), (lx, ly, lz)


def auto_view(scene: Scene, up: str) -> View:
    """Eye and look-at point (units of the scene) that frame its bulk with a level horizon.

    The box from the 1st to the 99th percentile of the means, widened by three median standard
    deviations, is seen from the standard front (``rotations.level_rotation``) and 20 degrees above,
    from so far that it just fits into 77 degrees both ways. Raises InputError for an empty scene or
    one without any extent.
    """
    if not len(scene):
        raise InputError("view: an empty scene has no view")
    low, high = np.percentile(scene.means.astype(np.float64), _BOX_PERCENTILES, axis=0)
    margin = 3.0 * float(np.median(scene.scales.max(axis=1)))
    centre, half = (low + high) / 2, (high - low) / 2 + margin
    level = level_rotation(up)
    direction = math.cos(_ELEVATION_RAD) * level[:, 2] + math.sin(_ELEVATION_RAD) * level[:, 1]
    axes = look_at(centre - direction, centre, up_vector(up)).rotation
    corners = (np.array(list(product((-1, 1), repeat=3))) * half) @ axes
    distance = float((np.abs(corners[:, :2]).max(axis=1) / _FRAME_TANGENT - corners[:, 2]).max())
    if not distance > 0:
        raise InputError("view: the scene has no extent to frame; give a view")
    eye = centre - distance * direction
    return (float(eye[0]), float(eye[1]), float(eye[2])), (
        float(centre[0]),
        float(centre[1]),
        float(centre[2]),
    )


def anchor(trace: HeadTrace, view_pose: Pose, up: str) -> HeadTrace:
    """The trace moved into a scene whose vertical is ``up``, starting exactly at ``view_pose``.

    Let Y be the level frame (right, down, horizontal forward) of the trace's first pose in the
    trace's world, V that of the view in the scene, and M = V Y^T: M maps the trace's vertical onto
    ``up`` and the first heading onto the view's. With poses (p_i, R_i) and view (e, W):

        position_i = e + M (p_i - p_0)        rotation_i = M (R_i R_0^T) M^T W

    So the first pose is the view, vertical motion stays vertical, and turning the head about the
    vertical turns it about ``up``. The pitch of the view and of the first pose cancel against each
    other: a head that rises by some angle rises by that angle from the view. ``view_pose`` is in
    metres. Raises InputError when the view or the first pose looks straight up or down.
    """
    first = trace.pose(0)
    scene_frame = level_rotation(up, view_pose.rotation[:, 2])
    trace_frame = level_rotation(trace.up, first.rotation[:, 2])
    to_scene = scene_frame @ trace_frame.T
    turns = to_scene @ (trace.rotations @ first.rotation.T) @ to_scene.T
    return replace(
        trace,
        positions=view_pose.position + (trace.positions - first.position) @ to_scene.T,
        rotations=turns @ view_pose.rotation,
        up=up,
    )
