"""Stereo buffer: circular rows between SRU and merge unit (Sec. 5, Fig. 15), with a spill path.

Right tile N is rendered when left tile N + K - 1 is done. Until then row k holds what left tiles N
+ k .. N + K - 1 forwarded to right tiles N .. N + K - 1 - k. A full row cannot stall the SRU:
right tile N needs left tile N + K - 1, so both would wait for ever. What does not fit goes to DRAM
and is read from there when its right tile is merged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arch.component import Int64, Stream
from arch.config import StereoConfig
from arch.results import StereoBufferUse
from gaussians.work import Int32


@dataclass(frozen=True)
class StereoBufferRows:
    """Spill per tile row and use of the buffer over the frame."""

    stall_cycles: Int64  # [tiles_y] waits of the merge unit for spilled entries
    stream: Stream
    use: StereoBufferUse


def stereo_buffer(stereo: StereoConfig, fifo_entries: Int32, burst_bytes: int) -> StereoBufferRows:
    """Occupancy and spill of the stereo buffer for fifo_entries [rows, tiles_y, tiles_x].

    Each (row, right tile) list with spilled entries makes the merge unit wait
    ``spill_latency_cycles`` once; its bytes go to DRAM and back in whole bursts of
    ``burst_bytes``.
    """
    held = occupancy(fifo_entries)
    total = held.sum(axis=0)
    rows_full = np.any(held > stereo.row_entries, axis=0)
    over = rows_full if stereo.entries.organisation == "rows" else total > stereo.pool_entries
    affected = np.flatnonzero(np.any(over, axis=1))
    stalls = np.zeros(fifo_entries.shape[1], np.int64)
    spilled_entries, spilled_bytes = 0, 0
    if len(affected):
        spilled = spill(fifo_entries[:, affected], stereo)
        stalls[affected] = (
            np.count_nonzero(spilled, axis=(0, 2)) * stereo.entries.spill_latency_cycles
        )
        spilled_entries = int(spilled.sum(dtype=np.int64))
        bursts = -(-spilled.astype(np.int64) * stereo.entries.entry_bytes // burst_bytes)
        spilled_bytes = int(bursts.sum()) * burst_bytes
    sentence = "stereo-buffer entries that did not fit, written and read back"
    return StereoBufferRows(
        stalls,
        Stream("stereo_spill", sentence, spilled_bytes, spilled_bytes, 0),
        StereoBufferUse(
            organisation=stereo.entries.organisation,
            row_capacity_entries=stereo.row_entries,
            pool_capacity_entries=stereo.pool_entries,
            peak_row_entries=tuple(int(row.max()) if row.size else 0 for row in held),
            peak_total_entries=int(total.max()) if total.size else 0,
            tiles_over_a_row=int(np.count_nonzero(rows_full)),
            tiles_over_the_pool=int(np.count_nonzero(total > stereo.pool_entries)),
            spilled_entries=spilled_entries,
        ),
    )


def occupancy(fifo_entries: Int32) -> Int32:
    """[rows, tiles_y, tiles_x] entries in row k when right tile N merges, capacity ignored.

    Sum over t = N .. N + rows - 1 - k of fifo_entries[k, :, t].
    """
    rows, _, tiles_x = fifo_entries.shape
    held = fifo_entries.copy()
    for k in range(rows):
        for step in range(1, min(rows - k, tiles_x)):
            held[k, :, : tiles_x - step] += fifo_entries[k, :, step:]
    return held


def spill(fifo_entries: Int32, stereo: StereoConfig) -> NDArray[np.int32]:
    """[rows, tiles_y, tiles_x] entries that found no place, step by step along each tile row.

    When left tile c is done its entries for right tile c - k arrive in row k. Fixed rows: each
    keeps what fits. Pool: rows are served from the last (needed soonest) to row 0. Then right tile
    c - rows + 1 is merged and its places are free. Spilled entries stay outside.
    """
    rows, tiles_y, tiles_x = fifo_entries.shape
    k = np.arange(rows)
    steps = tiles_x + rows - 1
    arriving = np.zeros((steps, rows, tiles_y), np.int32)  # by left tile
    for row in range(rows):
        arriving[row : row + tiles_x, row] = fifo_entries[row].T
    kept = np.zeros((steps + rows, rows, tiles_y), np.int32)  # by right tile + rows - 1
    used = np.zeros((rows, tiles_y), np.int32)
    for c in range(steps):
        if stereo.entries.organisation == "rows":
            accepted = np.minimum(arriving[c], stereo.row_entries - used)
        else:
            free = stereo.pool_entries - used.sum(axis=0)
            wanted = np.cumsum(arriving[c, ::-1], axis=0)
            accepted = np.diff(np.minimum(wanted, free), axis=0, prepend=0)[::-1]
        kept[c - k + rows - 1, k] = accepted
        used += accepted
        used -= kept[c]  # right tile c - rows + 1
    on_chip = kept[rows - 1 : rows - 1 + tiles_x].transpose(1, 2, 0)
    return np.asarray(fifo_entries - on_chip)
