"""Tile lists and rasterisation work by trying every splat at every pixel."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gaussians.reference import ReferenceSplats, check
from gaussians.work import EyeWork

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Lists = list[list[list[int]]]  # [tile row][tile column] -> ranks in depth order


class FlatLists(Protocol):
    """The lists of a rendered frame: tile i holds splats[offsets[i]:offsets[i + 1]], row-major."""

    @property
    def tiles_x(self) -> int: ...
    @property
    def tiles_y(self) -> int: ...
    @property
    def offsets(self) -> NDArray[np.int64]: ...
    @property
    def splats(self) -> NDArray[np.int32]: ...


def nested(lists: FlatLists) -> Lists:
    """The same lists as Python lists."""
    tiles = [
        lists.splats[start:end].tolist()
        for start, end in zip(lists.offsets[:-1], lists.offsets[1:], strict=True)
    ]
    width = lists.tiles_x
    return [tiles[row * width : (row + 1) * width] for row in range(lists.tiles_y)]


def passing_pixels(splats: ReferenceSplats, shape: tuple[int, int]) -> tuple[Bool, Float32]:
    """Where each splat passes, and its alpha there; both [M, height, width]."""
    passing = np.zeros((len(splats.ids), *shape), bool)
    alphas = np.zeros((len(splats.ids), *shape), np.float32)
    with np.errstate(all="ignore"):
        for rank in range(len(splats.ids)):
            passing[rank], alphas[rank] = check(splats, rank, shape)
    return passing, alphas


def necessary_lists(passing: Bool, tile_px: int) -> Lists:
    """Of every tile, the splats that pass at one of its pixel centres."""
    _, height, width = passing.shape
    return [
        [
            np.flatnonzero(passing[:, y : y + tile_px, x : x + tile_px].any(axis=(1, 2))).tolist()
            for x in range(0, width, tile_px)
        ]
        for y in range(0, height, tile_px)
    ]


def recount(lists: Lists, passing: Bool, alphas: Float32, tile_px: int) -> EyeWork:
    """Walk every list until all pixels of the tile have stopped, and count on the way."""
    shape = (len(lists), len(lists[0]))
    counts = {name: np.zeros(shape, np.int32) for name in EyeWork.__dataclass_fields__}
    for row, column in np.ndindex(shape):
        y, x = row * tile_px, column * tile_px
        passing_here = passing[:, y : y + tile_px, x : x + tile_px]
        alphas_here = alphas[:, y : y + tile_px, x : x + tile_px]
        transmittance = np.ones(passing_here.shape[1:], np.float32)
        live = np.ones(passing_here.shape[1:], bool)
        counts["entries"][row, column] = len(lists[row][column])
        for rank in lists[row][column]:
            if not live.any():
                break
            counts["processed"][row, column] += 1
            counts["alpha_checks"][row, column] += live.sum()
            passed = live & passing_here[rank]
            after = transmittance * (1 - alphas_here[rank])
            stopping = passed & (after < 1e-4)
            counts["passes"][row, column] += passed.sum()
            counts["blends"][row, column] += (passed & ~stopping).sum()
            transmittance = np.where(passed & ~stopping, after, transmittance)
            live &= ~stopping
        counts["terminated"][row, column] = not live.any()
    return EyeWork(**counts)


def live_passes(lists: Lists, passing: Bool, alphas: Float32, tile_px: int) -> list[int]:
    """1 for every list entry, tile by tile, that passes in a pixel not yet stopped."""
    found = []
    for row, column in np.ndindex(len(lists), len(lists[0])):
        y, x = row * tile_px, column * tile_px
        window = slice(None), slice(y, y + tile_px), slice(x, x + tile_px)
        transmittance = np.ones(passing[window].shape[1:], np.float32)
        live = np.ones(transmittance.shape, bool)
        for rank in lists[row][column]:
            passed = live & passing[window][rank]
            found.append(int(passed.any()))
            after = transmittance * (1 - alphas[window][rank])
            live &= ~(passed & (after < 1e-4))
            transmittance = np.where(passed & live, after, transmittance)
    return found


def box_lists(splats: ReferenceSplats, shape: tuple[int, int], tile_px: int, grow: float) -> Lists:
    """Of every tile, the splats whose axis-aligned box, grown by so many px, overlaps its area
    inside the image.

    The box holds the contour p = threshold: sqrt(2 q cxx) by sqrt(2 q cyy) to either side of the
    centre, with q = -threshold and the covariance that belongs to the conic.
    """
    height, width = shape
    boxes = []
    for rank in range(len(splats.ids)):
        a, b, c = (float(value[rank]) for value in (splats.a, splats.b, splats.c))
        q, det = -float(splats.thresholds[rank]), a * c - b * b
        half_width, half_height = math.sqrt(2 * q * c / det), math.sqrt(2 * q * a / det)
        boxes.append((half_width + grow, half_height + grow))

    def overlaps(rank: int, x: int, y: int) -> bool:
        across, down = float(splats.u[rank]), float(splats.v[rank])
        half_width, half_height = boxes[rank]
        beside = min(x + tile_px, width) > across - half_width and x < across + half_width
        return beside and min(y + tile_px, height) > down - half_height and y < down + half_height

    return [
        [
            [rank for rank in range(len(boxes)) if overlaps(rank, x, y)]
            for x in range(0, width, tile_px)
        ]
        for y in range(0, height, tile_px)
    ]
