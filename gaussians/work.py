"""The work trace: what rendering one stereo frame took, per tile and eye. Counted, never assumed.

The cycle model turns these counts into time and activity; it has no other source of scene
statistics.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Int32 = NDArray[np.int32]


@dataclass(frozen=True)
class EyeWork:
    """Rasterisation work of one eye; every array is [tiles_y, tiles_x] int32.

    The left eye's tiles_x is that of its widened view where the stereo method asks for one.
    """

    entries: Int32  # length of the tile's list (forward-only entries not included)
    processed: Int32  # entries walked until the last pixel of the tile had stopped
    alpha_checks: Int32  # live pixels tested, summed over processed entries
    passes: Int32  # live pixels that passed the test
    blends: Int32  # passes that were blended (a pass that stops its pixel is not)
    terminated: Int32  # 1 where every pixel of the tile stopped


@dataclass(frozen=True)
class StereoWork:
    """What the stereo re-projection unit, its buffer and the merge unit did.

    All zero for independent eyes.
    """

    # Tile columns of the plane: those of the left window, and where the right window reaches beyond
    # it, virtual ones that only forward.
    # [rows, tiles_y, tiles_x] writes into row k destined for right tile x; with a spilling method
    # one row more, what went through memory
    fifo_entries: Int32
    forward_only: Int32  # [tiles_y, plane tiles] forwards by entries added to a left tile for them
    walked_after_termination: Int32  # [tiles_y, plane tiles] entries read only for the SRU
    dropped: int  # forwards lost because the disparity exceeds the rows (method `paper`)
    spilled: int  # forwards that went through memory instead of a row
    unseen: int  # right pairs lost because no left tile that forwards holds or sees the splat
    duplicates: int  # equal heads the merge unit dropped


@dataclass(frozen=True)
class FrontEndWork:
    """Work before rasterisation, once per splat of the drawn set."""

    submitted: int  # splats handed to projection (the drawn set)
    behind_near: int  # culled: depth < near plane, or depth not finite
    transparent: int  # culled: opacity < 1/255
    degenerate: int  # culled: image-space determinant not > 0 in either eye
    ill_conditioned: int  # kept, but its list bound is not tight (covariance condition above ~1e6)
    projected: int  # splats left after the culls above, sorted by depth
    visible: int  # of these, splats in at least one tile of an eye
    row_entries: int  # (splat, tile row) pairs, shared by both eyes
    left_pairs: int  # (splat, tile) pairs of the left eye
    right_pairs: int  # (splat, tile) pairs of the right eye by its own footprint; 0 if not computed


@dataclass(frozen=True)
class FrameWork:
    """Everything the cycle model needs to know of one stereo frame."""

    width: int
    height: int
    tile_px: int
    sh_degree: int
    method: str  # one readable line, see StereoMethod
    shared_front_end: bool  # right eye uses the left eye's sorting and binning (stereo methods)
    right_projected: bool  # the right eye has its own conic, colour or centre
    front_end: FrontEndWork
    left: EyeWork
    right: EyeWork
    stereo: StereoWork
    independent_right_tiles: (
        int  # right tiles binned and sorted on their own (method `paper`: edges)
    )
