"""Binning: which tiles a splat may touch, and the depth-ordered list of every tile.

Row lists come first and are shared by both eyes: on a rectified rig v, c_yy and the opacity have
the same bits in both eyes. Then each eye's own horizontal span per tile row. Spans are computed in
float64 from the float32 conic and are conservative by the bound stated in conventions.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.errors import InputError
from gaussians.parallel import run_chunks
from gaussians.projection import CONIC_A, CONIC_B, CONIC_C, THRESHOLD, ProjectedSplats, U, V

Float32 = NDArray[np.float32]
Intersection = Literal["ellipse", "square_3sigma", "obb"]
INTERSECTIONS: tuple[str, ...] = get_args(Intersection)
_ELLIPSE, _SQUARE = 0, 1

_ROUNDING = 16.0 * 2.0**-24  # bound on p's float32 rounding, relative, see conventions.md
_SLACK_PX = 1e-3  # far above the rounding of the float64 span arithmetic itself (< 1e-6 px)
_SIGMAS = 3.0  # INRIA and GSCore: splats are cut at three standard deviations
_FAR_PX = 1e9
_EMPTY = (1.0, -1.0)


@dataclass(frozen=True)
class TileGrid:
    """The tiles of one eye's window."""

    width: int
    height: int
    tile_px: int

    def __post_init__(self) -> None:
        if self.tile_px not in (4, 8, 16):
            raise InputError(f"tile size must be 4, 8 or 16 px, not {self.tile_px}")

    @property
    def tiles_x(self) -> int:
        return -(-self.width // self.tile_px)

    @property
    def tiles_y(self) -> int:
        return -(-self.height // self.tile_px)


@dataclass(frozen=True)
class TileLists:
    """Depth-ordered splat ranks per tile, row-major: tile i holds splats[offsets[i]:offsets[i +
    1]]."""

    tiles_x: int
    tiles_y: int
    offsets: NDArray[np.int64]  # [tiles_y * tiles_x + 1]
    splats: NDArray[np.int32]  # [pairs] ranks, ascending within a tile

    @property
    def lengths(self) -> NDArray[np.int32]:
        """[tiles_y, tiles_x] entries per tile."""
        return np.diff(self.offsets).astype(np.int32).reshape(self.tiles_y, self.tiles_x)


@dataclass(frozen=True)
class RowSpans:
    """(splat, tile row) entries in depth order per row, with each eye's span of tile columns."""

    grid: TileGrid
    offsets: NDArray[np.int64]  # [tiles_y + 1] into the entries
    ranks: NDArray[np.int32]  # [entries]
    spans: NDArray[np.int16]  # [eyes, entries, 2] first and last tile column; empty: first > last
    counts: NDArray[np.int32]  # [eyes, tiles_y, tiles_x] list lengths
    ill_conditioned: int  # splats whose region is unbounded by rounding


class _Job(NamedTuple):
    """What the binning kernels read."""

    rule: int
    tile: int
    width: int
    height: int
    features: Float32  # [eyes, M, 10]
    covariances: Float32  # [eyes, M, 3]


@njit(cache=True, error_model="numpy")
def _square_radius(cxx: float, cxy: float, cyy: float) -> float:
    """INRIA: ceil(3 sqrt(largest eigenvalue)), with its floor of 0.1 under the root."""
    middle = 0.5 * (cxx + cyy)
    largest = middle + math.sqrt(max(0.1, middle * middle - (cxx * cyy - cxy * cxy)))
    return math.ceil(_SIGMAS * math.sqrt(largest))


@njit(cache=True, error_model="numpy")
def _box_axes(cxx: float, cxy: float, cyy: float) -> tuple[float, float, float, float]:
    """GSCore's oriented box: half axes (x1, y1), (x2, y2) of three standard deviations."""
    middle = 0.5 * (cxx + cyy)
    spread = math.sqrt(max(0.0, middle * middle - (cxx * cyy - cxy * cxy)))
    angle = 0.5 * math.atan2(2.0 * cxy, cxx - cyy)
    long_axis = _SIGMAS * math.sqrt(middle + spread)
    short_axis = _SIGMAS * math.sqrt(max(0.0, middle - spread))
    cosine, sine = math.cos(angle), math.sin(angle)
    return long_axis * cosine, long_axis * sine, -short_axis * sine, short_axis * cosine


@njit(cache=True, error_model="numpy")
def _half_height(rule: int, feature: Float32, covariance: Float32) -> float:
    """Vertical half extent in px; infinite where rounding leaves the ellipse unbounded."""
    if rule == _ELLIPSE:
        a = np.float64(feature[CONIC_A]) * (1.0 - _ROUNDING)
        b = np.float64(feature[CONIC_B])
        c = np.float64(feature[CONIC_C]) * (1.0 - _ROUNDING)
        det = a * c - b * b
        if not det > 0.0:
            return np.inf
        return math.sqrt(max(0.0, -2.0 * np.float64(feature[THRESHOLD]) * a / det))
    cxx, cxy, cyy = (
        np.float64(covariance[0]),
        np.float64(covariance[1]),
        np.float64(covariance[2]),
    )
    if rule == _SQUARE:
        return _square_radius(cxx, cxy, cyy)
    _x1, y1, _x2, y2 = _box_axes(cxx, cxy, cyy)
    return abs(y1) + abs(y2)


@njit(cache=True, error_model="numpy")
def _ellipse_interval(feature: Float32, low: float, high: float) -> tuple[float, float]:
    """x interval, relative to u, of the pass region over dy in [low, high]."""
    a = np.float64(feature[CONIC_A]) * (1.0 - _ROUNDING)
    b = np.float64(feature[CONIC_B])
    c = np.float64(feature[CONIC_C]) * (1.0 - _ROUNDING)
    two_q = -2.0 * np.float64(feature[THRESHOLD])
    det = a * c - b * b
    if two_q < 0.0:
        return _EMPTY
    if det > 0.0:
        top = math.sqrt(two_q * a / det)
        low, high = max(low, -top), min(high, top)
        if low > high:
            return _EMPTY
        at_right = -b * math.sqrt(two_q / (c * det))  # dy where the ellipse is widest to the right
        right_dy = min(max(at_right, low), high)
        left_dy = min(max(-at_right, low), high)
        root_r = math.sqrt(max(0.0, two_q * a - det * right_dy * right_dy))
        root_l = math.sqrt(max(0.0, two_q * a - det * left_dy * left_dy))
        return (-b * left_dy - root_l) / a, (-b * right_dy + root_r) / a
    root_low = math.sqrt(two_q * a - det * low * low)
    root_high = math.sqrt(two_q * a - det * high * high)
    left = min((-b * low - root_low) / a, (-b * high - root_high) / a)
    right = max((-b * low + root_low) / a, (-b * high + root_high) / a)
    return left, right


@njit(cache=True, error_model="numpy")
def _box_interval(covariance: Float32, low: float, high: float) -> tuple[float, float]:
    """x interval of the oriented box over dy in [low, high]: corners inside, edges cut by the
    slab."""
    x1, y1, x2, y2 = _box_axes(
        np.float64(covariance[0]), np.float64(covariance[1]), np.float64(covariance[2])
    )
    left, right = _FAR_PX, -_FAR_PX
    for corner in range(4):
        p = 1.0 if corner < 2 else -1.0
        q = 1.0 if corner == 0 or corner == 3 else -1.0
        xa, ya = p * x1 + q * x2, p * y1 + q * y2
        if low <= ya <= high:
            left, right = min(left, xa), max(right, xa)
        xb, yb = p * x1 - q * x2, p * y1 - q * y2  # neighbour along the edge where q changes sign
        xc, yc = -p * x1 + q * x2, -p * y1 + q * y2  # and where p does
        for side in range(2):
            y = low if side == 0 else high
            if (ya - y) * (yb - y) < 0.0:
                x = xa + (xb - xa) * (y - ya) / (yb - ya)
                left, right = min(left, x), max(right, x)
            if (ya - y) * (yc - y) < 0.0:
                x = xa + (xc - xa) * (y - ya) / (yc - ya)
                left, right = min(left, x), max(right, x)
    return left, right


@njit(cache=True, error_model="numpy")
def _column_span(
    rule: int, feature: Float32, covariance: Float32, row: int, tile: int, width: int, height: int
) -> tuple[int, int]:
    """First and last tile column of a splat in a tile row; first > last when it touches none."""
    u, v = np.float64(feature[U]), np.float64(feature[V])
    top = row * tile
    last_tile = (width - 1) // tile
    if rule == _ELLIPSE:
        bottom = min(top + tile, height) - 1
        left, right = _ellipse_interval(
            feature, top + 0.5 - v - _SLACK_PX, bottom + 0.5 - v + _SLACK_PX
        )
        if left > right:
            return 1, 0
        first_px = math.ceil(max(u + left - 0.5 - _SLACK_PX, -1.0))
        last_px = math.floor(min(u + right - 0.5 + _SLACK_PX, np.float64(width)))
        if first_px > last_px or last_px < 0 or first_px >= width:
            return 1, 0
        first, last = max(first_px, 0) // tile, min(last_px, width - 1) // tile
        return first, last
    if rule == _SQUARE:
        right = np.float64(
            _square_radius(
                np.float64(covariance[0]), np.float64(covariance[1]), np.float64(covariance[2])
            )
        )
        left = -right
        if top >= v + right or top + tile <= v - right:
            return 1, 0
    else:
        left, right = _box_interval(covariance, top - v, top + tile - v)
    if left > right or u + right < 0.0 or u + left >= width:
        return 1, 0
    first = math.floor(max(u + left, 0.0) / tile)
    last = math.ceil(min(u + right, np.float64(width)) / tile) - 1
    return int(first), int(min(last, last_tile))


@njit(cache=True, error_model="numpy", nogil=True)
def _row_range(begin: int, end: int, job: _Job, rows: NDArray[np.int32]) -> int:
    """rows [M, 2]: first and last tile row, the union over eyes; returns the unbounded splats."""
    unbounded = 0
    for rank in range(begin, end):
        half = 0.0
        for eye in range(job.features.shape[0]):
            half = max(
                half, _half_height(job.rule, job.features[eye, rank], job.covariances[eye, rank])
            )
        if half == np.inf:
            unbounded += 1
        v = np.float64(job.features[0, rank, V])
        low = max(v - half - 0.5 - _SLACK_PX, -1.0)
        high = min(v + half - 0.5 + _SLACK_PX, np.float64(job.height))
        if job.rule == _ELLIPSE:  # only rows of pixel centres count
            first_px, last_px = math.ceil(low), math.floor(high)
        else:
            first_px, last_px = math.floor(low), math.ceil(high)
        if first_px > last_px or last_px < 0 or first_px >= job.height:
            rows[rank, 0], rows[rank, 1] = 1, 0
        else:
            rows[rank, 0] = max(first_px, 0) // job.tile
            rows[rank, 1] = min(last_px, job.height - 1) // job.tile
    return unbounded


@njit(cache=True, error_model="numpy")
def _row_lists(
    rows: NDArray[np.int32], tiles_y: int
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Counting sort of the splats into tile rows, depth order kept."""
    offsets = np.zeros(tiles_y + 1, np.int64)
    for rank in range(rows.shape[0]):
        for row in range(rows[rank, 0], rows[rank, 1] + 1):
            offsets[row + 1] += 1
    for row in range(tiles_y):
        offsets[row + 1] += offsets[row]
    ranks = np.empty(offsets[tiles_y], np.int32)
    cursor = offsets[:-1].copy()
    for rank in range(rows.shape[0]):
        for row in range(rows[rank, 0], rows[rank, 1] + 1):
            ranks[cursor[row]] = rank
            cursor[row] += 1
    return offsets, ranks


@njit(cache=True, error_model="numpy", nogil=True)
def _spans(
    begin: int,
    end: int,
    job: _Job,
    offsets: NDArray[np.int64],
    ranks: NDArray[np.int32],
    spans: NDArray[np.int16],
    counts: NDArray[np.int32],
) -> None:
    for row in range(begin, end):
        for eye in range(job.features.shape[0]):
            for entry in range(offsets[row], offsets[row + 1]):
                rank = ranks[entry]
                first, last = _column_span(
                    job.rule,
                    job.features[eye, rank],
                    job.covariances[eye, rank],
                    row,
                    job.tile,
                    job.width,
                    job.height,
                )
                spans[eye, entry, 0], spans[eye, entry, 1] = first, last
                for column in range(first, last + 1):
                    counts[eye, row, column] += 1


@njit(cache=True, error_model="numpy", nogil=True)
def _fill(
    begin: int,
    end: int,
    row_offsets: NDArray[np.int64],
    ranks: NDArray[np.int32],
    spans: NDArray[np.int16],
    tile_offsets: NDArray[np.int64],
    tiles_x: int,
    splats: NDArray[np.int32],
) -> None:
    for row in range(begin, end):
        cursor = tile_offsets[row * tiles_x : (row + 1) * tiles_x].copy()
        for entry in range(row_offsets[row], row_offsets[row + 1]):
            for column in range(spans[entry, 0], spans[entry, 1] + 1):
                splats[cursor[column]] = ranks[entry]
                cursor[column] += 1


def row_spans(
    splats: ProjectedSplats, grid: TileGrid, intersection: Intersection = "ellipse"
) -> RowSpans:
    """Bin splats into tile rows and compute every eye's column span in each.

    ``ellipse``: the opacity-aware contour p = threshold against pixel centres, exact up to the
    stated rounding bound. ``square_3sigma``: INRIA's square of radius ceil(3 sigma_max). ``obb``:
    GSCore's oriented box of three sigmas. The last two drop contributions that the ellipse keeps.
    """
    rule = INTERSECTIONS.index(intersection)
    job = _Job(rule, grid.tile_px, grid.width, grid.height, splats.features, splats.covariances)
    rows = np.empty((len(splats.ids), 2), np.int32)
    unbounded = run_chunks(_row_range, len(rows), job, rows)
    offsets, ranks = _row_lists(rows, grid.tiles_y)
    spans = np.empty((splats.eyes, len(ranks), 2), np.int16)
    counts = np.zeros((splats.eyes, grid.tiles_y, grid.tiles_x), np.int32)
    run_chunks(_spans, grid.tiles_y, job, offsets, ranks, spans, counts)
    return RowSpans(grid, offsets, ranks, spans, counts, sum(unbounded))


def offsets_of(counts: NDArray[np.integer]) -> NDArray[np.int64]:
    """[n + 1] running sum of counts, starting at 0."""
    offsets = np.zeros(counts.size + 1, np.int64)
    np.cumsum(counts.reshape(-1), out=offsets[1:])
    return offsets


def tile_lists(rows: RowSpans, eye: int) -> TileLists:
    """The lists of one eye (0 left, 1 right) from its own spans."""
    grid = rows.grid
    offsets = offsets_of(rows.counts[eye])
    splats = np.empty(offsets[-1], np.int32)
    run_chunks(
        _fill,
        grid.tiles_y,
        rows.offsets,
        rows.ranks,
        rows.spans[eye],
        offsets,
        grid.tiles_x,
        splats,
    )
    return TileLists(grid.tiles_x, grid.tiles_y, offsets, splats)
