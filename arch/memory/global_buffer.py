"""The global double buffer: one half fills while the other is read."""

from __future__ import annotations

from arch.config import AcceleratorConfig

WORD_BYTES = 16


def half_bytes(config: AcceleratorConfig) -> int:
    """Bytes one stage may fill before it hands over."""
    return config.global_buffer.capacity_kib * 1024 // 2


def bytes_per_core(config: AcceleratorConfig) -> int:
    """Share of one half for the tile that one volume rendering core works on."""
    return half_bytes(config) // config.volume_rendering_core.units.count


def staging(moved_bytes: int) -> dict[str, int]:
    """Counts of bytes that are written into the buffer once and read from it once."""
    words = -(-moved_bytes // WORD_BYTES)
    return {"global_buffer_reads": words, "global_buffer_writes": words}
