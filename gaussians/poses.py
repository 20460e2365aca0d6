"""Head traces: where the head is and which way it looks, frame by frame.

A trace lives in its own level world; ``placement.anchor`` puts it into a scene.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gaussians.cameras import Pose
from gaussians.errors import InputError
from gaussians.formats import eyenavgs
from gaussians.head_motion import GENERATED_RATE_HZ, MOTIONS
from gaussians.rotations import (
    level_rotation,
    quaternions_from_rotations,
    rotations_from_angles,
    rotations_from_quaternions,
    slerp,
    up_vector,
)

Float64 = NDArray[np.float64]

_OPENXR_TO_OPENCV = np.diag([1.0, -1.0, -1.0])  # camera axes: y up, -z forward to y down, z forward


@dataclass(frozen=True)
class HeadTrace:
    """F head poses in a world whose vertical is ``up``. Owns no scene and no display.

    Raises InputError unless the shapes fit, all is finite, times increase and rotations are
    orthonormal and right-handed.
    """

    name: str
    times_s: Float64  # [F] increasing
    positions: Float64  # [F, 3] metres, midway between the eyes
    rotations: Float64  # [F, 3, 3] camera-to-world, columns right, down, forward
    half_angles: tuple[float, float, float, float] | None = None  # outer, inner, up, down, radians
    up: str = "+y"  # the vertical of the trace's world
    files: tuple[Path, ...] = ()  # what a recorded trace was read from

    def __post_init__(self) -> None:
        frames = len(self.times_s)
        if not frames:
            raise InputError(f"trace {self.name}: must hold at least one pose")
        shapes = {"times_s": (frames,), "positions": (frames, 3), "rotations": (frames, 3, 3)}
        for field, shape in shapes.items():
            array = getattr(self, field)
            if array.shape != shape or array.dtype != np.float64:
                raise InputError(
                    f"trace {self.name}: {field} must be float64 of shape {shape}, not "
                    f"{array.dtype} of {array.shape}"
                )
            if not np.isfinite(array).all():
                raise InputError(f"trace {self.name}: {field} must be finite")
        if frames > 1 and not (np.diff(self.times_s) > 0).all():
            bad = int(np.argmax(np.diff(self.times_s) <= 0)) + 1
            raise InputError(f"trace {self.name}: times must increase; frame {bad} does not")
        products = self.rotations @ self.rotations.transpose(0, 2, 1)
        proper = np.linalg.det(self.rotations) > 0
        if np.abs(products - np.eye(3)).max() > 1e-6 or not proper.all():
            raise InputError(f"trace {self.name}: rotations must be orthonormal and right-handed")
        up_vector(self.up)

    def __len__(self) -> int:
        return len(self.times_s)

    def pose(self, frame: int) -> Pose:
        """The pose of one frame, 0 to len - 1."""
        if not 0 <= frame < len(self):
            raise InputError(
                f"trace {self.name}: frame must lie in 0..{len(self) - 1}, not {frame}"
            )
        return Pose(self.positions[frame], self.rotations[frame])


def resample(trace: HeadTrace, rate_hz: float, frames: int) -> HeadTrace:
    """``frames`` poses at a display rate, from the trace's first instant on.

    Positions are interpolated linearly, orientations along the shorter great arc. A teleport
    between two samples is a straight, fast line for the frames that fall between them.

    Raises InputError when the trace is shorter than ``(frames - 1) / rate_hz`` seconds.
    """
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise InputError(f"display rate must be a positive number of Hz, not {rate_hz}")
    if frames < 1:
        raise InputError(f"number of frames must be at least 1, not {frames}")
    since_start = trace.times_s - trace.times_s[0]
    times = np.arange(frames) / rate_hz
    if times[-1] > since_start[-1] + 1e-9:
        available = int((since_start[-1] + 1e-9) * rate_hz) + 1
        raise InputError(
            f"trace {trace.name}: lasts {since_start[-1]:.3f} s, which gives at most {available} "
            f"frames at {rate_hz:g} Hz, not {frames}"
        )
    after = np.clip(np.searchsorted(since_start, times, side="right"), 1, max(1, len(trace) - 1))
    before = after - 1
    after = np.minimum(after, len(trace) - 1)
    span = since_start[after] - since_start[before]
    share = np.divide(times - since_start[before], span, out=np.zeros(frames), where=span > 0)
    share = np.clip(share, 0.0, 1.0)
    quaternions = quaternions_from_rotations(trace.rotations)
    return HeadTrace(
        name=trace.name,
        times_s=times,
        positions=(1 - share)[:, None] * trace.positions[before]
        + share[:, None] * trace.positions[after],
        rotations=rotations_from_quaternions(slerp(quaternions[before], quaternions[after], share)),
        half_angles=trace.half_angles,
        up=trace.up,
        files=trace.files,
    )


def read_eyenavgs(
    path: Path,
    scale: float | None = None,
    gravity_quaternion: tuple[float, float, float, float] | None = None,
) -> HeadTrace:
    """A recorded EyeNavGS trace in metres, gravity along -y.

    Metres are scene units / ``scale``; ``gravity_quaternion`` (x, y, z, w) turns positions and
    orientations so that +y is up. Both come from ``scene_setting.csv`` when not given. Poses are
    those of the left rows: the point midway between the eyes is the left eye plus half the baseline
    along the head's right axis, the baseline being the median distance to the right rows.

    The half-angles are those of the left eye. The recorded vertical pair is signed as OpenXR signs
    angles, upwards positive, so the negative one is taken as ``down``; the data set's own
    description names the columns in the other order.

    Raises InputError for damaged files, a missing setting, and views that differ between frames or
    are not mirrored between the eyes.
    """
    files: tuple[Path, ...] = (path,)
    left, right = eyenavgs.read_eye_rows(path)
    if scale is None or gravity_quaternion is None:
        settings = eyenavgs.find_scene_settings(path)
        setting = eyenavgs.read_scene_setting(settings, path)
        scale = setting.scale if scale is None else scale
        gravity_quaternion = gravity_quaternion or setting.gravity_quaternion
        files += (settings,)
    if not (math.isfinite(scale) and scale > 0):
        raise InputError(f"{path}: scale must be a positive number, not {scale}")
    gravity = rotations_from_quaternions(_wxyz(np.array([gravity_quaternion]), path))[0]
    heads = gravity @ rotations_from_quaternions(_wxyz(left.quaternions, path))
    rotations = heads @ _OPENXR_TO_OPENCV
    distances = np.linalg.norm(right.positions - left.positions, axis=1)
    half_baseline_m = 0.5 * float(np.median(distances)) / scale
    return HeadTrace(
        name=path.stem,
        times_s=(left.times_ms - left.times_ms[0]) / 1000.0,
        positions=left.positions @ gravity.T / scale + half_baseline_m * rotations[:, :, 0],
        rotations=rotations,
        half_angles=_half_angles(left, right, path),
        files=files,
    )


def _wxyz(quaternions: Float64, path: Path) -> Float64:
    """(x, y, z, w) rounded to a few decimals, to unit (w, x, y, z)."""
    norms = np.linalg.norm(quaternions, axis=1, keepdims=True)
    if not (np.abs(norms - 1) < 0.01).all():
        bad = int(np.argmax(np.abs(norms - 1)))
        raise InputError(
            f"{path}: quaternions must have length 1 within 0.01, not {norms[bad, 0]:g}"
        )
    return (quaternions / norms)[:, [3, 0, 1, 2]]


def _half_angles(
    left: eyenavgs.EyeRows, right: eyenavgs.EyeRows, path: Path
) -> tuple[float, float, float, float]:
    """Outer, inner, up, down of both eyes, positive radians."""
    mirrored = right.fov[:, [1, 0, 2, 3]] * [-1, -1, 1, 1]
    if (left.fov != left.fov[0]).any() or (mirrored != left.fov[0]).any():
        raise InputError(f"{path}: FOV1..4 must be constant, and mirrored between the eyes")
    outer, inner, first, second = (float(angle) for angle in left.fov[0])
    up, down = max(first, second), min(first, second)
    if not (outer < 0 < inner and down < 0 < up):
        raise InputError(f"{path}: FOV1, FOV2 and FOV3, FOV4 must have opposite signs")
    return -outer, inner, up, -down


def generate_trace(kind: str, frames: int, rng: np.random.Generator, up: str = "+y") -> HeadTrace:
    """A synthetic trace at 90 Hz: ``stand``, ``walk``, ``flight`` or ``teleport``.

    The first pose is at the origin and looks level along the ``up`` axis's standard front (see
    ``rotations.level_rotation``). Same ``rng`` state, same trace; head_motion.py describes the four
    models of motion.
    """
    if kind not in MOTIONS:
        raise InputError(f"trace kind must be one of {', '.join(MOTIONS)}, not {kind!r}")
    if frames < 1:
        raise InputError(f"number of frames must be at least 1, not {frames}")
    times = np.arange(frames) / GENERATED_RATE_HZ
    motion = MOTIONS[kind](times, rng)
    level = level_rotation(up)
    return HeadTrace(
        name=kind,
        times_s=times,
        positions=motion.offsets @ level.T,
        rotations=level @ rotations_from_angles(motion.yaw, motion.pitch, motion.roll),
        up=up,
    )
