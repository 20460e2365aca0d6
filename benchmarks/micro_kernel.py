"""The rasteriser's check and blend on data that stays in registers: the limit of one core.

The arithmetic is the rasteriser's own, two entries a turn; lists, scattered records, pixels to
place and images to write are left out. In 15 of 16 records 12 of the block's 16 pixels pass, in the
last 4: 11.5 on average; on `street` 11.3 of 16 checks pass.
"""

from __future__ import annotations

import time

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.constants import (
    BLUE,
    CONIC_A,
    CONIC_C,
    GREEN,
    OPACITY,
    RED,
    THRESHOLD,
    U,
    V,
)
from gaussians.lanes import WIDTH, broadcast, halves, load, pair, store
from gaussians.rasterization import _blend, _check

RECORDS = 16
WIDE, NARROW = np.float32(-1.5), np.float32(-0.5)  # thresholds: 12 and 4 of the 16 pixels pass
FAINT = np.float32(1e-7)  # opacity: no pixel ever stops
ZERO, ONE = np.float32(0), np.float32(1)


@njit(error_model="numpy", nogil=True)
def _check_and_blend(count, features, centres, out):  # type: ignore[no-untyped-def] # a kernel
    x, y = load(centres, 0), load(centres, WIDTH)
    xs, ys, live = pair(x, x), pair(y, y), x >= ZERO
    t, red, green, blue = broadcast(ONE), broadcast(ZERO), broadcast(ZERO), broadcast(ZERO)
    for entry in range(0, count, 2):
        one, two = entry & (RECORDS - 1), (entry + 1) & (RECORDS - 1)
        passed_both, alpha_both = _check(features, one, two, True, xs, ys)
        passed_one, passed_two = halves(passed_both)
        alpha_one, alpha_two = halves(alpha_both)
        weight, t, live = _blend(alpha_one, passed_one & live, t, live)
        red = red + weight * features[one, RED]
        green = green + weight * features[one, GREEN]
        blue = blue + weight * features[one, BLUE]
        weight, t, live = _blend(alpha_two, passed_two & live, t, live)
        red = red + weight * features[two, RED]
        green = green + weight * features[two, GREEN]
        blue = blue + weight * features[two, BLUE]
    store(out, 0, (red + green) + (blue + t))


def records() -> NDArray[np.float32]:
    """[16, 10] round splats in the middle of the block."""
    features = np.zeros((RECORDS, 10), np.float32)
    features[:, [U, V]] = 2
    features[:, [CONIC_A, CONIC_C]] = 1
    features[:, THRESHOLD] = np.where(np.arange(RECORDS) == RECORDS - 1, NARROW, WIDE)
    features[:, OPACITY] = FAINT
    features[:, [RED, GREEN, BLUE]] = 0.5
    return features


def cpu_seconds(alpha_checks: int, repeat: int) -> float:
    """Least CPU time of one core for so many alpha checks, 16 at a time, and their blends."""
    places = np.arange(WIDTH)
    centres = np.stack([places % 4, places // 4]).astype(np.float32) + np.float32(0.5)
    arguments = records(), centres, np.empty(WIDTH, np.float32)
    _check_and_blend(2, *arguments)
    times = []
    for _ in range(repeat):
        started = time.process_time()
        _check_and_blend(alpha_checks // WIDTH, *arguments)
        times.append(time.process_time() - started)
    return min(times)
