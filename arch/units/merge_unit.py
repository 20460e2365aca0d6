"""Merge unit: the heads of the stereo buffer's rows to one right list, nearest first (Sec. 5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arch.component import Int64
from arch.config import AcceleratorConfig
from arch.units.binning_unit import row_sums
from gaussians.work import FrameWork


@dataclass(frozen=True)
class MergeRows:
    """What the merge unit does per tile row; every array is [tiles_y] int64."""

    cycles: Int64
    outputs: Int64  # entries handed to the right tile


def merge_unit(config: AcceleratorConfig, work: FrameWork) -> MergeRows:
    """Cycles per tile row = ceil(outputs / outputs per cycle) + start cycles per right tile with
    entries.

    Equal heads pop together. A right tile that has stopped takes no more: its rows are dropped by
    moving the pointers. Zero for independent eyes and for tiles that nothing was forwarded to.
    """
    if config.stereo is None or not work.shared_front_end:
        zero = np.zeros(len(work.left.entries), np.int64)
        return MergeRows(zero, zero)
    forwarded = work.stereo.fifo_entries.sum(axis=0)
    outputs = row_sums(np.minimum(work.right.processed, forwarded))
    timing = config.stereo.merge
    starts = np.count_nonzero(forwarded, axis=1) * timing.tile_start_cycles
    return MergeRows(-(-outputs // timing.outputs_per_cycle) + starts, outputs)
