"""Slow twins of arch/units/stereo_buffer.py: entries pushed and popped one by one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def occupancy(fifo: NDArray[np.int32]) -> NDArray[np.int32]:
    """[rows, tiles_y, tiles_x] entries of row k for right tiles N .. N + rows - 1 - k."""
    rows, tiles_y, tiles_x = fifo.shape
    held = np.zeros_like(fifo)
    for k in range(rows):
        for y in range(tiles_y):
            for n in range(tiles_x):
                for t in range(n, min(n + rows - k, tiles_x)):
                    held[k, y, n] += fifo[k, y, t]
    return held


def spill(fifo: NDArray[np.int32], row_entries: int, pool_entries: int | None) -> NDArray[np.int32]:
    """Entries without a place; ``pool_entries`` None: fixed rows."""
    rows, tiles_y, tiles_x = fifo.shape
    lost = np.zeros_like(fifo)
    for y in range(tiles_y):
        buffer: list[tuple[int, int]] = []  # (row, right tile) per entry
        for c in range(tiles_x + rows - 1):
            for k in reversed(range(rows)):
                t = c - k
                for _ in range(fifo[k, y, t] if 0 <= t < tiles_x else 0):
                    in_row = sum(1 for row, _ in buffer if row == k)
                    full = in_row >= row_entries
                    if pool_entries is not None:
                        full = len(buffer) >= pool_entries
                    if full:
                        lost[k, y, t] += 1
                    else:
                        buffer.append((k, t))
            merged = c - rows + 1
            buffer = [entry for entry in buffer if entry[1] != merged]
    return lost
