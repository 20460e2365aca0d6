"""Stereo re-projection unit (SRU): moves splats of a left tile into rows of the stereo buffer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arch.component import Int64
from arch.config import AcceleratorConfig
from arch.units.binning_unit import row_sums
from gaussians.work import FrameWork


@dataclass(frozen=True)
class ReprojectionRows:
    """What the SRU does per tile row; every array is [tiles_y] int64."""

    cycles: Int64
    examined: Int64  # list entries looked at
    writes: Int64  # row writes, up to one per row and entry


def stereo_reprojection_unit(config: AcceleratorConfig, work: FrameWork) -> ReprojectionRows:
    """Cycles per tile row = max(entries examined, ceil(row writes / writes per cycle)).

    Examined are all entries walked for the left eye: those rendered, those walked after the last
    pixel stopped, and forward-only ones. Zero for independent eyes.
    """
    if config.stereo is None or not work.shared_front_end:
        zero = np.zeros(len(work.left.entries), np.int64)
        return ReprojectionRows(zero, zero, zero)
    examined = row_sums(work.left.processed) + row_sums(work.stereo.walked_after_termination)
    examined = examined + row_sums(work.stereo.forward_only)
    writes = work.stereo.fifo_entries.sum(axis=(0, 2), dtype=np.int64)
    per_cycle = config.stereo.reprojection.writes_per_cycle
    return ReprojectionRows(np.maximum(examined, -(-writes // per_cycle)), examined, writes)
