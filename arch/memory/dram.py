"""DRAM in first order: bytes by stream against a rate derived from the timing parameters.

No queues and no bank state: a sequential stream runs at the bus rate; a random one opens a row per
request, which four-activate window and row cycle limit; refresh, changes of direction and the
display's own reading are taken off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from arch.component import Stream, ceil_div
from arch.config import AcceleratorConfig
from arch.memory.config import DramConfig
from arch.results import StreamBytes
from gaussians.errors import InputError


@dataclass(frozen=True)
class DramReport:
    """Time and traffic of the streams of one frame, scan-out left out."""

    cycles: int
    streams: tuple[StreamBytes, ...]
    activations: int
    efficiency: float  # bytes / (peak rate * time)

    @property
    def total_bytes(self) -> int:
        return sum(s.read_bytes + s.write_bytes for s in self.streams)


def channel_bytes_per_ns(config: DramConfig) -> float:
    """Peak rate of one channel: 6.4 B/ns for LPDDR3-1600 by 32 bits."""
    return config.organisation.bus_bytes * config.organisation.transfers_per_ns


def peak_bytes_per_ns(config: DramConfig) -> float:
    """Peak rate of all channels."""
    return config.channels.count * channel_bytes_per_ns(config)


def request_efficiency(config: DramConfig, granule_bytes: int) -> float:
    """Share of the bus rate that random requests of this size reach; 1 for sequential (0 bytes).

    Every request opens one row of one bank. Rows of a channel open no closer than tRRD, tFAW/4 and,
    with all banks in turn, tRC/banks. A request shorter than that leaves the bus idle.
    """
    if granule_bytes == 0:
        return 1.0
    timing = config.timing
    spacing_ns = max(
        timing.t_rrd_ns, timing.t_faw_ns / 4, timing.t_rc_ns / config.organisation.banks
    )
    data_ns = _in_bursts(config, granule_bytes) / channel_bytes_per_ns(config)
    return min(1.0, data_ns / spacing_ns)


def bus_bytes(config: DramConfig, moved_bytes: int, granule_bytes: int) -> int:
    """Bytes on the bus: requests in whole bursts."""
    if granule_bytes == 0:
        return _in_bursts(config, moved_bytes)
    return ceil_div(moved_bytes, granule_bytes) * _in_bursts(config, granule_bytes)


def activations(config: DramConfig, moved_bytes: int, granule_bytes: int) -> int:
    """Rows opened: one per page of a sequential stream, else one per request and page in it."""
    page = config.organisation.page_bytes
    if granule_bytes == 0:
        return ceil_div(moved_bytes, page)
    return ceil_div(moved_bytes, granule_bytes) * ceil_div(granule_bytes, page)


def dram(
    config: AcceleratorConfig, streams: tuple[Stream, ...], scan_out_bytes_per_s: float
) -> DramReport:
    """Time until all streams of a frame are through, the channels sharing the load evenly.

    data time = sum of bytes / (peak * efficiency) + changes of direction; frame time of the DRAM =
    data time / (1 - refresh share - scan-out share). Raises InputError when refresh and
    scan-out leave nothing.
    """
    memory = config.dram
    data_ns, rows, reported = 0.0, 0, []
    for stream in streams:
        read = bus_bytes(memory, stream.read_bytes, stream.granule_bytes)
        write = bus_bytes(memory, stream.write_bytes, stream.granule_bytes)
        rate = peak_bytes_per_ns(memory) * request_efficiency(memory, stream.granule_bytes)
        data_ns += (read + write) / rate + _turnaround_ns(memory, write)
        rows += activations(memory, stream.read_bytes, stream.granule_bytes)
        rows += activations(memory, stream.write_bytes, stream.granule_bytes)
        reported.append(StreamBytes(stream.name, stream.sentence, read, write))
    refresh_share = memory.timing.t_rfc_ns / memory.timing.t_refi_ns
    scan_share = scan_out_bytes_per_s * 1e-9 / peak_bytes_per_ns(memory)
    left_over = 1.0 - refresh_share - scan_share
    if left_over <= 0:
        raise InputError(
            f"{config.name}: the display must leave DRAM bandwidth to the accelerator, "
            f"but refresh and scan-out take {1 - left_over:.0%}"
        )
    time_ns = data_ns / left_over
    total = sum(s.read_bytes + s.write_bytes for s in reported)
    efficiency = total / (peak_bytes_per_ns(memory) * time_ns) if time_ns else 0.0
    cycles = math.ceil(time_ns * config.clock.frequency_ghz)
    return DramReport(cycles, tuple(reported), rows, efficiency)


def _turnaround_ns(config: DramConfig, write_bytes: int) -> float:
    """Bus idle while the direction changes, once per batch of writes; channels in parallel."""
    burst = config.organisation.burst_bytes
    batches = write_bytes / (burst * config.controller.write_batch_bursts)
    return batches * (config.timing.t_wtr_ns + config.timing.t_cl_ns) / config.channels.count


def _in_bursts(config: DramConfig, moved_bytes: int) -> int:
    burst = config.organisation.burst_bytes
    return ceil_div(moved_bytes, burst) * burst
