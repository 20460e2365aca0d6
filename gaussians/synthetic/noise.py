"""Random numbers whose bits depend on no mathematical library.

NumPy's sin, exp, log and pow, and the distributions built on them, may differ in the last bit
between processors. Everything here uses +, -, *, /, sqrt, integers and table look-up only, so that
a seed gives the same scene on every machine.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Integers = NDArray[np.integer]

# Quantiles of Beta(0.8, 2.8) at 0, 1/16, ..., 15/16, then at the tail points of _BETA_LEVELS.
_BETA_LEVELS = np.array([*(i / 16 for i in range(16)), 0.97, 0.99, 1.0])
_BETA_QUANTILES = np.array(
    [
        0.0,
        0.01068,
        0.0258,
        0.0436,
        0.06376,
        0.08623,
        0.1111,
        0.1386,
        0.16907,
        0.203,
        0.24115,
        0.28462,
        0.33519,
        0.39599,
        0.47338,
        0.58489,
        0.67835,
        0.78122,
        0.95,
    ]
)

_HALF_ROOT = 0.7071067811865476
# sine of 0, 45, ..., 315 degrees
_EIGHTHS = np.array([0.0, _HALF_ROOT, 1.0, _HALF_ROOT, 0.0, -_HALF_ROOT, -1.0, -_HALF_ROOT])


def beta_like(rng: np.random.Generator, count: int) -> Float64:
    """[count] samples that follow Beta(0.8, 2.8), piecewise linear between tabulated quantiles."""
    return np.interp(rng.random(count), _BETA_LEVELS, _BETA_QUANTILES)


def near_normal(rng: np.random.Generator, shape: tuple[int, ...]) -> Float32:
    """Zero mean, unit variance, bell-shaped, within +-3.5: the sum of four uniforms."""
    total = rng.random(shape, np.float32)
    for _ in range(3):
        total += rng.random(shape, np.float32)
    return (total - np.float32(2.0)) * np.float32(1.7320508)


def unit_vectors(rng: np.random.Generator, count: int, dimensions: int) -> Float64:
    """[count, dimensions] random directions (near-normal components, normalised)."""
    raw = near_normal(rng, (count, dimensions)).astype(np.float64)
    raw[:, 0] += 1e-6  # never exactly zero
    norms = np.zeros(count)
    for axis in range(dimensions):
        norms += raw[:, axis] * raw[:, axis]
    return raw / np.sqrt(norms)[:, None]


def hash_unit(seed: NDArray[np.uint32], i: Integers, j: Integers) -> Float64:
    """Uniform in [0, 1), a pure function of (seed, i, j); arrays broadcast."""
    x = seed.astype(np.uint32) ^ (i.astype(np.uint32) * np.uint32(0x9E3779B1))
    x = x ^ (j.astype(np.uint32) * np.uint32(0x85EBCA77))
    x = (x ^ (x >> np.uint32(15))) * np.uint32(0x2C1B3C6D)
    x = (x ^ (x >> np.uint32(12))) * np.uint32(0x297A2D39)
    x = x ^ (x >> np.uint32(15))
    return x.astype(np.float64) * (1.0 / 4294967296.0)


def value_noise(seed: NDArray[np.uint32], x: Float64, y: Float64) -> Float64:
    """Smooth noise in [0, 1) with unit wavelength: hashed lattice values, smoothstep between."""
    fx, fy = np.floor(x), np.floor(y)
    i, j = fx.astype(np.int64), fy.astype(np.int64)
    tx, ty = x - fx, y - fy
    tx, ty = tx * tx * (3.0 - 2.0 * tx), ty * ty * (3.0 - 2.0 * ty)
    low = hash_unit(seed, i, j) * (1.0 - tx) + hash_unit(seed, i + 1, j) * tx
    high = hash_unit(seed, i, j + 1) * (1.0 - tx) + hash_unit(seed, i + 1, j + 1) * tx
    return low * (1.0 - ty) + high * ty


def unit_circle(turns: Float64) -> tuple[Float64, Float64]:
    """(x, y) on the unit circle at ``turns`` >= 0 full turns; the angle is good to a degree."""
    octant = np.floor(turns * 8.0)
    t = (turns * 8.0 - octant) * 0.41421356237309503  # tan(pi / 8)
    x, y = (1.0 - t * t) / (1.0 + t * t), 2.0 * t / (1.0 + t * t)
    eighth = octant.astype(np.int64) % 8
    cosines = _EIGHTHS[(eighth + 2) % 8]
    sines = _EIGHTHS[eighth]
    return x * cosines - y * sines, x * sines + y * cosines


def systematic_counts(weights: Float64, total: int, start: float) -> NDArray[np.int64]:
    """Whole numbers that sum to ``total`` and differ by less than one from their share of it.

    Systematic sampling: the running sum of the shares, shifted by ``start`` in [0, 1), is rounded
    down.
    """
    running = np.cumsum(weights)
    edges = np.floor(running * (total / running[-1]) + start).astype(np.int64)
    edges[-1] = total
    return np.diff(np.minimum(edges, total), prepend=0)
