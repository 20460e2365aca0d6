"""How a head moves while standing, walking, flying and teleporting: generated traces.

Amplitudes and frequencies are round numbers of ordinary human movement, not fitted to a recording;
recorded traces are there for that.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

GENERATED_RATE_HZ = 90.0
WALKING_SPEED_M_S = 1.4
FLIGHT_SPEED_M_S = 30.0
TELEPORT_PERIOD_FRAMES = 450

_STEPS_HZ = 1.9


@dataclass(frozen=True)
class Motion:
    """A movement in the level axes of its start; every row 0 is zero."""

    offsets: Float64  # [F, 3] metres along right, down, forward
    yaw: Float64  # [F] radians, right positive
    pitch: Float64  # [F] radians, up positive
    roll: Float64  # [F] radians, clockwise positive


def _wander(
    rng: np.random.Generator, times: Float64, amplitude: float, slowest_hz: float, fastest_hz: float
) -> Float64:
    """A smooth random function, 0 at time 0, within twice the amplitude: three random sinusoids."""
    frequencies = rng.uniform(slowest_hz, fastest_hz, 3)
    phases = rng.uniform(0.0, 2 * math.pi, 3)
    waves = np.sin(2 * math.pi * frequencies * times[:, None] + phases) - np.sin(phases)
    return amplitude / 3 * waves.sum(axis=1)


def _stand(times: Float64, rng: np.random.Generator) -> Motion:
    """Standing: the head sways by about a centimetre, below 0.6 Hz, and turns by some degrees."""
    offsets = np.stack(
        [
            _wander(rng, times, 0.008, 0.1, 0.6),
            _wander(rng, times, 0.002, 0.1, 0.6),
            _wander(rng, times, 0.008, 0.1, 0.6),
        ],
        axis=1,
    )
    yaw = _wander(rng, times, math.radians(8), 0.1, 0.4)
    pitch = _wander(rng, times, math.radians(4), 0.1, 0.4)
    return Motion(offsets, yaw, pitch, _wander(rng, times, math.radians(1), 0.1, 0.4))


def _walk(times: Float64, rng: np.random.Generator) -> Motion:
    """Walking at 1.4 m/s along a gently curving path, 1.9 steps per second.

    Each step bobs the head by 4 cm from lowest to highest, each pair of steps sways it sideways by
    4 cm; the head turns up to some 45 degrees away from the path to look around, and nods.
    """
    heading = _wander(rng, times, math.radians(20), 0.02, 0.08)
    path = _horizontal_path(times, heading, WALKING_SPEED_M_S)
    phase = rng.uniform(0.0, 2 * math.pi)
    bob = 0.02 * (np.cos(2 * math.pi * _STEPS_HZ * times + phase) - math.cos(phase))
    sway = 0.02 * (np.sin(math.pi * _STEPS_HZ * times + phase / 2) - math.sin(phase / 2))
    sideways = np.stack([np.cos(heading), np.zeros_like(times), -np.sin(heading)], axis=1)
    offsets = path + sway[:, None] * sideways + bob[:, None] * np.array([0.0, 1.0, 0.0])
    yaw = heading + _wander(rng, times, math.radians(22), 0.1, 0.4)
    pitch = _wander(rng, times, math.radians(5), 0.1, 0.5)
    return Motion(offsets, yaw, pitch, _wander(rng, times, math.radians(1), 0.5, 1.0))


def _flight(times: Float64, rng: np.random.Generator) -> Motion:
    """Flying at 30 m/s over ground, as behind a levelled drone camera.

    Wide random turns, and a climb of 20 m and back every minute that never goes below the start.
    """
    heading = _wander(rng, times, math.radians(30), 0.01, 0.05)
    offsets = _horizontal_path(times, heading, FLIGHT_SPEED_M_S)
    offsets[:, 1] = -10.0 * (1.0 - np.cos(2 * math.pi * times / 60.0))
    yaw = heading + _wander(rng, times, math.radians(10), 0.05, 0.2)
    pitch = _wander(rng, times, math.radians(5), 0.05, 0.2)
    return Motion(offsets, yaw, pitch, np.zeros_like(times))


def _teleport(times: Float64, rng: np.random.Generator) -> Motion:
    """Walking, with a jump of 150 to 250 m in a random horizontal direction every 5 s.

    A trace too short for that jumps once, in its middle.
    """
    walk = _walk(times, rng)
    frames = len(times)
    jumps = np.arange(TELEPORT_PERIOD_FRAMES, frames, TELEPORT_PERIOD_FRAMES)
    if not len(jumps) and frames > 1:
        jumps = np.array([frames // 2])
    offsets = walk.offsets.copy()
    for frame in jumps:
        distance, direction = rng.uniform(150.0, 250.0), rng.uniform(0.0, 2 * math.pi)
        offsets[frame:] += distance * np.array([math.sin(direction), 0.0, math.cos(direction)])
    return Motion(offsets, walk.yaw, walk.pitch, walk.roll)


def _horizontal_path(times: Float64, heading: Float64, speed_m_s: float) -> Float64:
    """[F, 3] positions of a point that moves along ``heading`` at constant speed."""
    steps = (
        speed_m_s
        / GENERATED_RATE_HZ
        * np.stack([np.sin(heading), np.zeros_like(times), np.cos(heading)], axis=1)
    )
    return np.cumsum(steps, axis=0) - steps[0]


MOTIONS: dict[str, Callable[[Float64, np.random.Generator], Motion]] = {
    "stand": _stand,
    "walk": _walk,
    "flight": _flight,
    "teleport": _teleport,
}
