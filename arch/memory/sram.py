"""On-chip memories: which macros the accelerator holds, and what one access costs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from arch.config import AcceleratorConfig
from arch.provenance import Provenance, weakest
from gaussians.errors import InputError

Ports = Literal["1RW", "1R1W"]

# memory -> (counter of reads, counter of writes); every access is one 16 B word
MEMORY_COUNTERS: dict[str, tuple[str, str]] = {
    "codebook_buffer": ("codebook_words_read", ""),  # written once per session: not counted
    "global_buffer": ("global_buffer_reads", "global_buffer_writes"),
    "feature_buffer": ("feature_buffer_reads", "feature_buffer_writes"),
    "stereo_buffer": ("stereo_buffer_reads", "stereo_buffer_writes"),
}


@dataclass(frozen=True, kw_only=True)
class SramMacro(Provenance):
    """One compiled memory of 128-bit words."""

    capacity_kib: float
    ports: Ports
    read_pj: float
    write_pj: float
    area_mm2: float
    leakage_mw: float
    node_nm: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("capacity_kib", "read_pj", "write_pj", "area_mm2", "node_nm")
        self.require_not_negative("leakage_mw")


@dataclass(frozen=True)
class Memory:
    """A memory of the accelerator: equal macros."""

    name: str
    macro_kib: float
    ports: Ports
    macros: int


def memories(config: AcceleratorConfig) -> tuple[Memory, ...]:
    """Every on-chip memory of the configuration.

    Buffers between two running units have a read and a write port; the two halves of the global
    buffer take turns, so one port each.
    """
    core = config.volume_rendering_core
    found = [
        Memory("global_buffer", config.global_buffer.capacity_kib / 2, "1RW", 2),
        Memory("feature_buffer", core.feature_buffer.size.capacity_kib, "1R1W", core.units.count),
    ]
    if config.stereo:
        buffer = config.stereo.buffer
        bank = buffer.capacity_kib / buffer.rows
        found.append(Memory("stereo_buffer", bank, "1R1W", buffer.rows * core.units.count))
    if config.decoder:
        size = config.decoder.timing.codebook_buffer_kib
        found.append(Memory("codebook_buffer", size, "1RW", 1))
    return tuple(found)


def macro(table: tuple[SramMacro, ...], capacity_kib: float, ports: Ports) -> SramMacro:
    """The macro of this size: the table's, or log-log between its two neighbours of the same ports.

    Raises InputError outside the table: nothing is extrapolated.
    """
    same = sorted((m for m in table if m.ports == ports), key=lambda m: m.capacity_kib)
    for entry in same:
        if entry.capacity_kib == capacity_kib:
            return entry
    below = [m for m in same if m.capacity_kib < capacity_kib]
    above = [m for m in same if m.capacity_kib > capacity_kib]
    if not below or not above:
        sizes = ", ".join(f"{m.capacity_kib:g}" for m in same) or "none"
        raise InputError(
            f"no {ports} memory macro of {capacity_kib:g} KiB; "
            f"it must lie within the table: {sizes} KiB"
        )
    low, high = below[-1], above[0]
    share = math.log(capacity_kib / low.capacity_kib) / math.log(
        high.capacity_kib / low.capacity_kib
    )
    fields = ("read_pj", "write_pj", "area_mm2", "leakage_mw")
    values = {f: getattr(low, f) ** (1 - share) * getattr(high, f) ** share for f in fields}
    return replace(
        low,
        capacity_kib=capacity_kib,
        source="derived",
        reference=f"between {low.capacity_kib:g} and {high.capacity_kib:g} KiB of: {low.reference}",
        confidence=weakest(low.confidence, high.confidence, "C"),
        **values,
    )
