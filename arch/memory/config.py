"""Memory and display as data: on-chip buffers, splat records, DRAM, scan-out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from arch.component import Fill, Units
from arch.provenance import Provenance
from gaussians.errors import InputError

RecordLayout = Literal["decoded_fp32", "decoded_fp16", "compressed_in_dram"]


@dataclass(frozen=True, kw_only=True)
class BufferSize(Provenance):
    """Capacity of an on-chip buffer."""

    capacity_kib: int

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(1, "capacity_kib")


@dataclass(frozen=True, kw_only=True)
class SplatRecord(Provenance):
    """How a splat of the subgraph lies in DRAM (``arch.memory.splat_record``)."""

    layout: RecordLayout
    code_index_bytes: int  # codeword index of the coefficients above degree 0, compressed layout

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_choice("layout", ("decoded_fp32", "decoded_fp16", "compressed_in_dram"))
        self.require_integers(1, "code_index_bytes")


@dataclass(frozen=True, kw_only=True)
class DramOrganisation(Provenance):
    """One channel."""

    bus_bytes: int
    transfers_per_ns: float  # 1.6 for LPDDR3-1600
    burst_bytes: int
    page_bytes: int
    banks: int

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(1, "bus_bytes", "burst_bytes", "page_bytes", "banks")
        self.require_positive("transfers_per_ns")


@dataclass(frozen=True, kw_only=True)
class DramTiming(Provenance):
    """Timing parameters in ns that bound the efficiency of a stream."""

    t_cl_ns: float
    t_ras_ns: float
    t_rc_ns: float
    t_rrd_ns: float
    t_faw_ns: float
    t_wtr_ns: float
    t_rfc_ns: float
    t_refi_ns: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("t_cl_ns", "t_ras_ns", "t_rc_ns", "t_rrd_ns", "t_faw_ns")
        self.require_positive("t_wtr_ns", "t_rfc_ns", "t_refi_ns")
        if self.t_rfc_ns >= self.t_refi_ns:
            raise InputError(
                f"DramTiming: t_rfc_ns must be below t_refi_ns ({self.t_refi_ns}), "
                f"not {self.t_rfc_ns}"
            )


@dataclass(frozen=True, kw_only=True)
class DramController(Provenance):
    """What the controller is assumed to do."""

    write_batch_bursts: int  # writes gathered between two changes of direction

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(1, "write_batch_bursts")


@dataclass(frozen=True)
class DramConfig:
    """DRAM behind the accelerator."""

    channels: Units
    organisation: DramOrganisation
    timing: DramTiming
    controller: DramController
    fill: Fill


@dataclass(frozen=True, kw_only=True)
class ScanOut(Provenance):
    """The display reads both images at its own rate, whatever the frame rate."""

    refresh_hz: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("refresh_hz")


@dataclass(frozen=True, kw_only=True)
class PixelFormat(Provenance):
    """One pixel of the frame buffer."""

    pixel_bytes: int

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(1, "pixel_bytes")


@dataclass(frozen=True)
class DisplayConfig:
    """The display as a client of the DRAM."""

    scan_out: ScanOut
    pixel: PixelFormat

    @property
    def bytes_per_pixel_and_s(self) -> float:
        """Bytes read per second for one pixel."""
        return self.pixel.pixel_bytes * self.scan_out.refresh_hz
