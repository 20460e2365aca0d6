"""What of the left eye's view forwards to the right eye: its image, or a wider window.

The wider one is that of a virtual camera behind both eyes (Sec. 4.4, Fig. 13), which sees all that
either eye sees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gaussians.cameras import StereoRig
from gaussians.errors import InputError
from gaussians.projection import ProjectedSplats
from gaussians.rasterization import EyeImage
from gaussians.tiling import RowSpans, TileGrid, TileLists

Float32 = NDArray[np.float32]

_MOST_TILES = 32_000  # tile columns are int16


@dataclass(frozen=True)
class LeftEye:
    """The left eye as forwarding reads it. Its grid may reach beyond the left image."""

    grid: TileGrid
    spans: NDArray[np.int16]  # [row entries, 2] tile columns of this grid, empty: first > last
    lists: TileLists
    eye: EyeImage
    forwards: NDArray[np.uint8]  # [pairs] 1 where the entry may be forwarded; [0]: all may


def disparity_px(splats: ProjectedSplats, rig: StereoRig) -> Float32:
    """[M] float32 disparity B f / z, the triangulation of Sec. 4.4."""
    return np.float32(rig.baseline_m * rig.display.fx) / splats.depths


def shift_tiles(rig: StereoRig, grid: TileGrid) -> int:
    """Right-window tile column + shift = tile column of the image plane, left window at 0."""
    return round(rig.display.window_offset_px) // grid.tile_px


def widened(rig: StereoRig, grid: TileGrid) -> TileGrid:
    """The left window of a virtual camera behind both eyes, which sees all that either eye sees.

    With the eyes' field of view it stands B f / W behind them, where its view at depth z reaches
    from the left eye's left edge to the right eye's right one: in left-eye pixels up to W + B f / z
    (plus the windows' offset), at most that of the near plane.
    """
    shift = shift_tiles(rig, grid)
    nearest = math.ceil(rig.baseline_m * rig.display.fx / rig.near_m / grid.tile_px)
    first = min(0, shift)
    behind = max(grid.tiles_x, grid.tiles_x + shift + nearest + 1)
    if behind - first > _MOST_TILES:
        raise InputError(
            f"left_view widened: the near plane of {rig.near_m:g} m widens the left view to "
            f"{behind - first} tiles; it must be at most {_MOST_TILES}"
        )
    return TileGrid((behind - first) * grid.tile_px, grid.height, grid.tile_px, first)


def clip_to_virtual_camera(
    rows: RowSpans, splats: ProjectedSplats, rig: StereoRig, grid: TileGrid
) -> RowSpans:
    """``rows`` of the widened window, left spans cut where the virtual camera's view ends."""
    wide = rows.grid
    in_tiles = np.ceil(disparity_px(splats, rig) / np.float32(grid.tile_px))
    last = np.minimum(in_tiles, wide.tiles_x).astype(np.int64) + shift_tiles(rig, grid)
    end = np.maximum(last, 0) + grid.tiles_x - 1 - wide.first_column
    spans = rows.spans.copy()
    spans[0, :, 1] = np.minimum(spans[0, :, 1], end[rows.ranks])
    row = np.repeat(np.arange(wide.tiles_y), np.diff(rows.offsets))
    first, behind = spans[0, :, 0].astype(np.int64), spans[0, :, 1] + 1
    some = first < behind
    width = wide.tiles_x + 1
    change = np.bincount((row * width + first)[some], minlength=wide.tiles_y * width)
    change -= np.bincount((row * width + behind)[some], minlength=wide.tiles_y * width)
    counts = rows.counts.copy()
    counts[0] = np.cumsum(change.reshape(-1, width), axis=1)[:, :-1]
    return replace(rows, spans=spans, counts=counts)
