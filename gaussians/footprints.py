"""Footprints: the image-space shapes by which a splat is binned, and their cuts with a tile row.

``ellipse``: the opacity-aware contour p = threshold, widened by the rounding bound of
conventions.md. ``box``: its axis-aligned bounding box, sqrt(2 q cxx) by sqrt(2 q cyy) to either
side for q = -threshold but for that widening; it holds every tile of the ellipse.
``square_3sigma``: INRIA's square of radius ceil(3 sigma_max). ``obb``: GSCore's oriented box of
three sigmas. These two drop contributions that the ellipse keeps: an opacity of 1 reaches 1/255
only at 3.33 sigma. Arithmetic is float64 on the float32 conic and covariance.

A footprint is prepared once per splat and eye into six numbers, whose meaning depends on the rule.
Called from kernels in other files; see kernel_cache.py.
"""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np
from numba import njit

Intersection = Literal["ellipse", "square_3sigma", "obb", "box"]
INTERSECTIONS: tuple[str, ...] = get_args(Intersection)
ELLIPSE, SQUARE, OBB, BOX = range(4)

Shape = tuple[float, float, float, float, float, float]
_SLOPE, _INVERSE, _REACH, _DET, _TOP, _WIDEST = range(6)  # ellipse
_HALF_WIDTH, _HALF_HEIGHT = range(2)  # square, box
_X1, _Y1, _X2, _Y2 = range(4)  # oriented box: half axes (x1, y1) and (x2, y2)

_ROUNDING = 16.0 * 2.0**-24  # bound on p's float32 rounding, relative, see conventions.md
_SIGMAS = 3.0  # INRIA and GSCore: splats are cut at three standard deviations
_FAR_PX = 1e9
_EMPTY = (1.0, -1.0)


@njit(cache=True, error_model="numpy")
def _ellipse(a: float, b: float, c: float, threshold: float) -> tuple[float, Shape]:
    """With a, c widened by the rounding bound and q = -threshold, the boundary over dy is
    (-b dy -+ sqrt(2 q a - det dy^2)) / a; it is widest to the right at dy = WIDEST."""
    a *= 1.0 - _ROUNDING
    c *= 1.0 - _ROUNDING
    two_q = -2.0 * threshold
    det = a * c - b * b
    top, widest = np.inf, 0.0
    if two_q < 0.0:
        top = -1.0
    elif det > 0.0:
        top = math.sqrt(two_q * a / det)
        widest = -b * math.sqrt(two_q / (c * det))
    return top, (-b / a, 1.0 / a, two_q * a, det, top, widest)


@njit(cache=True, error_model="numpy")
def footprint(
    rule: int,
    conic: tuple[float, float, float],
    threshold: float,
    covariance: tuple[float, float, float],
) -> tuple[float, Shape]:
    """Half height in px, negative if empty and infinite if unbounded, and the shape.

    ``conic`` is (A, B, C), ``covariance`` (cxx, cxy, cyy). An ellipse and its box are unbounded
    where rounding leaves them so (condition number about 1e6 and above).
    """
    a, b, c = conic
    if rule == ELLIPSE:
        return _ellipse(a, b, c, threshold)
    if rule == BOX:
        half_height, _shape = _ellipse(a, b, c, threshold)
        half_width, _shape = _ellipse(c, b, a, threshold)
        return half_height, (half_width, half_height, 0.0, 0.0, 0.0, 0.0)
    cxx, cxy, cyy = covariance
    middle = 0.5 * (cxx + cyy)
    square_root_of = middle * middle - (cxx * cyy - cxy * cxy)
    if rule == SQUARE:  # INRIA's floor of 0.1 under the root
        largest = middle + math.sqrt(max(0.1, square_root_of))
        radius = np.ceil(_SIGMAS * math.sqrt(largest))
        return radius, (radius, radius, 0.0, 0.0, 0.0, 0.0)
    spread = math.sqrt(max(0.0, square_root_of))
    angle = 0.5 * math.atan2(2.0 * cxy, cxx - cyy)
    long_axis = _SIGMAS * math.sqrt(middle + spread)
    short_axis = _SIGMAS * math.sqrt(max(0.0, middle - spread))
    cosine, sine = math.cos(angle), math.sin(angle)
    x1, y1 = long_axis * cosine, long_axis * sine
    x2, y2 = -short_axis * sine, short_axis * cosine
    return abs(y1) + abs(y2), (x1, y1, x2, y2, 0.0, 0.0)


@njit(cache=True, error_model="numpy")
def _ellipse_interval(shape: Shape, low: float, high: float) -> tuple[float, float]:
    top = shape[_TOP]
    low, high = max(low, -top), min(high, top)
    if low > high:
        return _EMPTY
    slope, inverse, reach, det = shape[_SLOPE], shape[_INVERSE], shape[_REACH], shape[_DET]
    if top < np.inf:
        right_dy = min(max(shape[_WIDEST], low), high)
        left_dy = min(max(-shape[_WIDEST], low), high)
        root_r = math.sqrt(max(0.0, reach - det * right_dy * right_dy))
        root_l = math.sqrt(max(0.0, reach - det * left_dy * left_dy))
        return slope * left_dy - root_l * inverse, slope * right_dy + root_r * inverse
    root_low = math.sqrt(reach - det * low * low) * inverse
    root_high = math.sqrt(reach - det * high * high) * inverse
    left = min(slope * low - root_low, slope * high - root_high)
    right = max(slope * low + root_low, slope * high + root_high)
    return left, right


@njit(cache=True, error_model="numpy")
def _oriented_box_interval(shape: Shape, low: float, high: float) -> tuple[float, float]:
    """Corners inside the slab, and edges cut by its two lines."""
    x1, y1, x2, y2 = shape[_X1], shape[_Y1], shape[_X2], shape[_Y2]
    left, right = _FAR_PX, -_FAR_PX
    for corner in range(4):
        p = 1.0 if corner < 2 else -1.0
        q = 1.0 if corner == 0 or corner == 3 else -1.0
        xa, ya = p * x1 + q * x2, p * y1 + q * y2
        if low <= ya <= high:
            left, right = min(left, xa), max(right, xa)
        for edge in range(2):  # to the corner where q changes sign, and to the one where p does
            turn = -1.0 if edge == 1 else 1.0
            xb, yb = turn * (p * x1 - q * x2), turn * (p * y1 - q * y2)
            for side in range(2):
                y = low if side == 0 else high
                if (ya - y) * (yb - y) < 0.0:
                    x = xa + (xb - xa) * (y - ya) / (yb - ya)
                    left, right = min(left, x), max(right, x)
    return left, right


@njit(cache=True, error_model="numpy")
def footprint_interval(rule: int, shape: Shape, low: float, high: float) -> tuple[float, float]:
    """x interval, relative to the centre, of the footprint over dy in [low, high].

    Empty: left > right.
    """
    if rule == ELLIPSE:
        return _ellipse_interval(shape, low, high)
    if rule == OBB:
        return _oriented_box_interval(shape, low, high)
    if low >= shape[_HALF_HEIGHT] or high <= -shape[_HALF_HEIGHT]:
        return _EMPTY
    return -shape[_HALF_WIDTH], shape[_HALF_WIDTH]
