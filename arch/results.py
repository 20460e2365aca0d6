"""Results of the accelerator model: frozen, plain, ready for ``dataclasses.asdict`` and JSON."""

from __future__ import annotations

from dataclasses import dataclass

from arch.activity import Activity


@dataclass(frozen=True)
class UnitTiming:
    """One kind of unit in one frame."""

    name: str
    instances: int
    cycles: int  # until the slowest instance has finished
    busy_cycles: int  # summed over instances
    utilisation: float  # busy / (instances * cycles per frame); 0 where the unit is not built


@dataclass(frozen=True)
class StreamBytes:
    """DRAM bytes of one stream in one frame, in whole bursts."""

    name: str
    sentence: str
    read_bytes: int
    write_bytes: int


@dataclass(frozen=True)
class Stall:
    """Cycles the volume rendering cores waited, summed over the cores, and for whom."""

    name: str
    sentence: str
    cycles: int


@dataclass(frozen=True)
class StereoBufferUse:
    """How full the stereo buffers were; capacities are per core."""

    organisation: str
    row_capacity_entries: int
    pool_capacity_entries: int
    peak_row_entries: tuple[int, ...]
    peak_total_entries: int
    tiles_over_a_row: int  # right tiles at whose merge some row holds more than an equal share
    tiles_over_the_pool: int  # right tiles at whose merge all rows hold more than the buffer
    spilled_entries: int


@dataclass(frozen=True)
class FrameTiming:
    """Time of one stereo frame and what bounds it."""

    fidelity: str
    cycles_per_frame: int
    fill_cycles: int
    frame_ms: float
    fps: float
    bound_by: str
    units: tuple[UnitTiming, ...]
    stalls: tuple[Stall, ...]
    dram: tuple[StreamBytes, ...]
    dram_bytes: int
    dram_efficiency: float  # bytes moved / (peak rate * DRAM time), scan-out left out
    stereo_buffer: StereoBufferUse | None  # none where no stereo units are built
    overlap: str
    notes: tuple[str, ...]


@dataclass(frozen=True)
class FrameAnalysis:
    """Timing and activity of one stereo frame."""

    timing: FrameTiming
    activity: Activity
