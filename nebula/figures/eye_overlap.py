"""How much of the right eye's image the left eye has: by warping, by depth, and splat by splat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.cameras import StereoRig
from gaussians.constants import BLUE, GREEN, RED
from gaussians.projection import ProjectedSplats
from gaussians.rasterization import rasterise
from gaussians.tiling import RowSpans, TileLists, tile_lists

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

DEPTH_TOLERANCE = 0.05
BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Overlap:
    """Shares of the right eye, 0 to 1. All but the first are what the left eye does not have."""

    covered: float  # right pixels in which anything was blended
    unreached_by_points: float  # right pixels that no left pixel's centre falls into when warped
    unreached: float  # right pixels that no warped left pixel touches
    unreached_of_covered: float  # the same among covered right pixels alone
    unreached_right_edge: float  # of these, pixels of rays that pass right of the left window
    other_depth: float  # right pixels whose surface the left eye does not see
    splats_right_only: float  # splats blended in the right image and nowhere in the left one
    pairs_right_only: float  # (splat, tile) pairs with a blend, of such splats
    weight_right_only: float  # blending weight of such splats


@dataclass(frozen=True)
class _Eye:
    depth: Float64  # [H, W] metres, infinite where nothing was blended
    blended: Bool  # [M] splats that pass in a live pixel
    pairs: NDArray[np.int32]  # ranks of the (splat, tile) pairs that do
    flagged_weight: float  # share of the blending weight that is of flagged splats


def overlap(splats: ProjectedSplats, rows: RowSpans, rig: StereoRig) -> Overlap:
    """Compare both eyes of one frame; ``splats`` and ``rows`` of both."""
    left = _eye(splats, rows, 0, np.zeros(len(splats.ids), np.bool_))
    right = _eye(splats, rows, 1, ~left.blended)
    shift = rig.baseline_m * rig.display.fx / left.depth + rig.display.window_offset_px
    unreached, covered = ~touched(shift), np.isfinite(right.depth)
    back = rig.baseline_m * rig.display.fx / right.depth + rig.display.window_offset_px
    beyond = np.arange(back.shape[1]) + 0.5 + back >= back.shape[1]
    return Overlap(
        covered=float(covered.mean()),
        unreached_by_points=float((~hit(shift)).mean()),
        unreached=float(unreached.mean()),
        unreached_of_covered=float(unreached[covered].mean()) if covered.any() else 0.0,
        unreached_right_edge=float((unreached & beyond).mean()),
        other_depth=float((~same_depth(left.depth, right.depth, back)).mean()),
        splats_right_only=float((~left.blended[right.blended]).mean()),
        pairs_right_only=float((~left.blended[right.pairs]).mean()),
        weight_right_only=right.flagged_weight,
    )


def _eye(splats: ProjectedSplats, rows: RowSpans, eye: int, flagged: Bool) -> _Eye:
    """Render depth, weight and flag instead of red, green and blue."""
    features = splats.features[eye].copy()
    features[:, RED], features[:, GREEN], features[:, BLUE] = splats.depths, 1, flagged
    lists: TileLists = tile_lists(rows, eye)
    drawn = rasterise(features, lists, rows.grid, BLACK, record_passes=True)
    depth_sum, weight, flagged_sum = np.moveaxis(drawn.image.astype(np.float64), 2, 0)
    depth = np.full(weight.shape, np.inf)
    np.divide(depth_sum, weight, out=depth, where=weight > 0)
    pairs = lists.splats[drawn.live_passes > 0]
    blended = np.zeros(len(splats.ids), np.bool_)
    blended[pairs] = True
    return _Eye(depth, blended, pairs, float(flagged_sum.sum() / max(weight.sum(), 1e-30)))


def hit(shift: Float64) -> Bool:
    """Right pixels that the centre of a left pixel falls into; pixels move left by ``shift``."""
    columns = np.floor(np.arange(shift.shape[1]) + 0.5 - shift)
    return _marked(columns, shift.shape)


def touched(shift: Float64) -> Bool:
    """Right pixels that a left pixel touches when its square moves left by ``shift``.

    So surfaces that are wider in the right eye, by less than twice, leave no cracks.
    """
    edges = np.arange(shift.shape[1]) - shift
    return _marked(np.floor(edges), shift.shape) | _marked(np.ceil(edges), shift.shape)


def _marked(columns: Float64, shape: tuple[int, ...]) -> Bool:
    marked = np.zeros(shape, np.bool_)
    inside = (columns >= 0) & (columns < shape[1])
    rows = np.broadcast_to(np.arange(shape[0])[:, None], shape)
    marked[rows[inside], columns[inside].astype(np.int64)] = True
    return marked


def same_depth(left: Float64, right: Float64, back: Float64) -> Bool:
    """Right pixels whose surface, followed back by ``back`` to the nearest left pixel, lies there
    at the same depth within 5 % of it; nothing in either eye is the same."""
    columns = np.floor(np.arange(right.shape[1]) + 0.5 + back)
    inside = (columns >= 0) & (columns < right.shape[1])
    found = np.full(right.shape, np.nan)
    rows = np.broadcast_to(np.arange(right.shape[0])[:, None], right.shape)
    found[inside] = left[rows[inside], columns[inside].astype(np.int64)]
    empty = np.isinf(right) & np.isinf(found)
    with np.errstate(invalid="ignore"):
        return empty | (np.abs(found - right) <= DEPTH_TOLERANCE * right) & np.isfinite(right)
