"""The accelerator as data: how many of each unit, how wide, how large.

Every group of numbers carries its source (``arch.provenance``); numbers of different sources stand
in different groups, so that an assumption never borrows the name of the paper. Files:
configs/nebula.yaml, configs/gscore_nebula.yaml.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from arch.component import Fill, Units
from arch.memory.config import BufferSize, DisplayConfig, DramConfig, SplatRecord
from arch.provenance import Provenance
from gaussians.errors import InputError

ListLayout = Literal["row_spans", "pairs"]
BufferOrganisation = Literal["rows", "pool"]


@dataclass(frozen=True, kw_only=True)
class TileSize(Provenance):
    """Edge of a render tile."""

    edge_px: int

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(1, "edge_px")


@dataclass(frozen=True)
class Workload:
    """What the functional level must render for this accelerator (see gaussians.stereo_method)."""

    stereo_method: str
    intersection: Literal["ellipse", "square_3sigma", "obb"]
    tile: TileSize


@dataclass(frozen=True, kw_only=True)
class Clock(Provenance):
    """One clock for every unit."""

    frequency_ghz: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("frequency_ghz")


@dataclass(frozen=True, kw_only=True)
class DecoderTiming(Provenance):
    """Codebook and width of the attribute decoder."""

    codebook_words: int  # codewords per stage of the spherical-harmonic codebook
    codebook_stages: int  # residual stages: so many words are read and added per splat
    codebook_buffer_kib: int  # on-chip part; the rest stays in DRAM
    bytes_per_cycle: int  # decoded bytes written per cycle

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(1, "codebook_words", "codebook_stages")
        self.require_integers(1, "codebook_buffer_kib", "bytes_per_cycle")


@dataclass(frozen=True)
class DecoderConfig:
    """Attribute decoder: codes to decoded records. One, in front of the subgraph or behind DRAM."""

    timing: DecoderTiming
    fill: Fill


@dataclass(frozen=True, kw_only=True)
class SubgraphTiming(Provenance):
    """The walk over the headers of everything the client holds."""

    header_bytes: int
    headers_per_cycle: int  # per unit

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(1, "header_bytes", "headers_per_cycle")


@dataclass(frozen=True)
class SubgraphConfig:
    """Subgraph unit: level-of-detail selection, frustum cull, eviction."""

    units: Units
    timing: SubgraphTiming
    fill: Fill


@dataclass(frozen=True, kw_only=True)
class ProjectionTiming(Provenance):
    """Initiation intervals of one projection unit."""

    cycles_per_splat: int
    right_eye_cycles: int  # more, for a splat that gets its own right conic and colour

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(1, "cycles_per_splat")
        self.require_integers(0, "right_eye_cycles")


@dataclass(frozen=True)
class ProjectionConfig:
    """Projection units: transform, cull, conic, colour."""

    units: Units
    timing: ProjectionTiming
    fill: Fill


@dataclass(frozen=True, kw_only=True)
class BinningTiming(Provenance):
    """Tile intersection: span solver, pair emitter, and how lists wait in DRAM."""

    spans_per_cycle: int  # per unit: (splat, tile row, eye) spans solved
    pairs_per_cycle: int  # per unit: (splat, tile) pairs emitted
    list_layout: ListLayout  # what waits in DRAM: spans per tile row, or expanded pairs
    span_bytes: int  # id, depth, first and last tile
    right_span_bytes: int  # more, where a span record serves both eyes
    pair_bytes: int  # id, depth
    burst_bytes: int  # list bytes gathered into one DRAM request

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(1, "spans_per_cycle", "pairs_per_cycle", "span_bytes", "pair_bytes")
        self.require_integers(0, "right_span_bytes")
        self.require_integers(1, "burst_bytes")
        self.require_choice("list_layout", ("row_spans", "pairs"))


@dataclass(frozen=True)
class BinningConfig:
    """Binning (tile-intersection) units."""

    units: Units
    timing: BinningTiming
    fill: Fill


@dataclass(frozen=True, kw_only=True)
class SortingTiming(Provenance):
    """Hierarchical sorting: pivot partition into chunks, then a bitonic network."""

    network_width: int  # elements of the bitonic network, a power of two
    chunk_entries: int  # lists up to here are sorted without a partition pass
    pivots: int  # a partition pass makes pivots + 1 subsets
    partition_entries_per_cycle: int

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(2, "network_width", "chunk_entries")
        self.require_integers(1, "pivots", "partition_entries_per_cycle")
        if self.network_width & (self.network_width - 1):
            raise InputError(
                f"SortingTiming: network_width must be a power of two, not {self.network_width}"
            )
        if self.chunk_entries < self.network_width:
            raise InputError(
                f"SortingTiming: chunk_entries must be at least network_width "
                f"({self.network_width}), not {self.chunk_entries}"
            )


@dataclass(frozen=True)
class SortingConfig:
    """Hierarchical sorting units."""

    units: Units
    timing: SortingTiming
    fill: Fill


@dataclass(frozen=True, kw_only=True)
class RenderingUnits(Provenance):
    """Rendering units (one pixel each) of one volume rendering core."""

    per_core: int

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(1, "per_core")


@dataclass(frozen=True, kw_only=True)
class CoreTiming(Provenance):
    """What a volume rendering core pays besides one cycle per entry and pass."""

    tile_switch_cycles: int  # per tile and eye: swap of the double-buffered pixel state
    chunk_switch_cycles: int  # per further chunk of a list longer than the feature buffer

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(0, "tile_switch_cycles", "chunk_switch_cycles")


@dataclass(frozen=True, kw_only=True)
class FeatureRecord(Provenance):
    """One projected splat of one eye, as the rendering units read it."""

    record_bytes: int

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(1, "record_bytes")


@dataclass(frozen=True)
class FeatureBufferConfig:
    """Feature buffer of one volume rendering core."""

    size: BufferSize
    record: FeatureRecord

    @property
    def records(self) -> int:
        """Whole records the buffer holds."""
        return self.size.capacity_kib * 1024 // self.record.record_bytes


@dataclass(frozen=True)
class VolumeRenderingCoreConfig:
    """Volume rendering cores: rendering units and feature buffer."""

    units: Units
    rendering_units: RenderingUnits
    timing: CoreTiming
    feature_buffer: FeatureBufferConfig
    fill: Fill


@dataclass(frozen=True, kw_only=True)
class ReprojectionTiming(Provenance):
    """Stereo re-projection unit: writes into the stereo buffer."""

    writes_per_cycle: int

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(1, "writes_per_cycle")


@dataclass(frozen=True, kw_only=True)
class StereoBufferRows(Provenance):
    """Disparity rows and capacity of one stereo buffer."""

    capacity_kib: int
    rows: int

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(1, "capacity_kib", "rows")


@dataclass(frozen=True, kw_only=True)
class StereoBufferEntries(Provenance):
    """How the stereo buffer is used: equal fixed rows, or one pool with a linked list per row."""

    organisation: BufferOrganisation
    entry_bytes: int
    spill_latency_cycles: int  # merge unit waits this long for the first spilled entry of a list

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_choice("organisation", ("rows", "pool"))
        self.require_integers(1, "entry_bytes")
        self.require_integers(0, "spill_latency_cycles")


@dataclass(frozen=True, kw_only=True)
class MergeTiming(Provenance):
    """Merge unit: entries out per cycle and the wait for the first heads of a tile."""

    outputs_per_cycle: int
    tile_start_cycles: int

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(1, "outputs_per_cycle")
        self.require_integers(0, "tile_start_cycles")


@dataclass(frozen=True)
class StereoConfig:
    """What every core has for stereo rasterisation: one SRU, one stereo buffer, one merge unit."""

    reprojection: ReprojectionTiming
    buffer: StereoBufferRows
    entries: StereoBufferEntries
    merge: MergeTiming
    fill: Fill

    def __post_init__(self) -> None:
        capacity = self.buffer.capacity_kib * 1024
        if capacity < self.buffer.rows * self.entries.entry_bytes:
            raise InputError(
                f"stereo buffer must hold at least one entry of {self.entries.entry_bytes} B in "
                f"each of {self.buffer.rows} rows, not {capacity} B"
            )

    @property
    def pool_entries(self) -> int:
        """Entries the whole buffer holds."""
        return self.buffer.capacity_kib * 1024 // self.entries.entry_bytes

    @property
    def row_entries(self) -> int:
        """Entries one of the equal rows holds."""
        return self.buffer.capacity_kib * 1024 // self.buffer.rows // self.entries.entry_bytes


@dataclass(frozen=True)
class AcceleratorConfig:
    """One accelerator with its memory and display."""

    name: str
    workload: Workload
    clock: Clock
    decoder: DecoderConfig | None  # none: the host decodes
    subgraph_unit: SubgraphConfig
    projection_unit: ProjectionConfig
    binning_unit: BinningConfig
    sorting_unit: SortingConfig
    volume_rendering_core: VolumeRenderingCoreConfig
    stereo: StereoConfig | None  # none: eyes can only be rendered independently
    global_buffer: BufferSize
    splat_record: SplatRecord
    dram: DramConfig
    display: DisplayConfig

    def __post_init__(self) -> None:
        if self.splat_record.layout == "compressed_in_dram" and self.decoder is None:
            raise InputError(f"{self.name}: splat layout compressed_in_dram needs a decoder")
        if self.volume_rendering_core.feature_buffer.records < 2:
            raise InputError(f"{self.name}: the feature buffer must hold at least 2 records")

    @property
    def cycle_s(self) -> float:
        """Seconds per clock cycle."""
        return 1e-9 / self.clock.frequency_ghz
