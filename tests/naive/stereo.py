"""The carrier rule, one (splat, right tile) pair at a time.

All columns are those of one plane of tiles that both windows look at: a left tile keeps its
number, a right tile t stands in column t + offset. Columns beyond the left window are tiles that
draw nothing and only forward.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tests.naive.tiling import Lists


@dataclass
class Forwarding:
    """What the carrier rule makes of one frame."""

    fifo_entries: NDArray[np.int32]  # [rows, tiles_y, right tiles_x]
    forward_only: NDArray[np.int32]  # [tiles_y, plane columns], one for each right tile served
    right_lists: Lists = field(default_factory=list)


def carry(
    left: Lists, right: Lists, disparity_tiles: NDArray[np.int64], *, rows: int, offset_tiles: int
) -> Forwarding:
    """Send every splat of every right tile through its one carrier.

    ``left`` and ``right`` are the lists each eye would make for itself; ``disparity_tiles`` [M] is
    the disparity in tiles, rounded up.
    """
    tiles_y, left_width, right_width = len(left), len(left[0]), len(right[0])
    plane_width = max(left_width, right_width + offset_tiles)
    lowest = min(0, offset_tiles)  # the plane begins with the window further left
    fifos: dict[tuple[int, int, int], list[int]] = {}
    forward_only = np.zeros((tiles_y, plane_width - lowest), np.int32)
    for y in range(tiles_y):
        for t in range(right_width):
            for splat in right[y][t]:
                span = [x for x in range(left_width) if splat in left[y][x]]
                c = carrier(t + offset_tiles, int(disparity_tiles[splat]), span, rows, plane_width)
                fifos.setdefault((c - t - offset_tiles, y, t), []).append(splat)
                if c not in span:
                    forward_only[y, c - lowest] += 1
    entries = np.zeros((rows, tiles_y, right_width), np.int32)
    for key, queue in fifos.items():
        entries[key] = len(queue)
    merged = [
        [
            sorted(s for row in range(rows) for s in fifos.get((row, y, t), []))
            for t in range(right_width)
        ]
        for y in range(tiles_y)
    ]
    return Forwarding(entries, forward_only, merged)


def carrier(t: int, k: int, span: list[int], rows: int, plane_width: int) -> int:
    """Plane column of the tile that forwards to plane column ``t``; its row is carrier - t."""
    c = t + k
    if span:
        c = clamp(c, span[0], span[-1])
    return min(clamp(c, t, t + rows - 1), plane_width - 1)


def clamp(value: int, low: int, high: int) -> int:
    """The nearest integer in low..high."""
    return max(low, min(value, high))
