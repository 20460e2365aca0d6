"""How many bytes a splat takes in DRAM under each record layout."""

from __future__ import annotations

from arch.memory.config import SplatRecord

PLAIN_ATTRIBUTES = 11  # mean 3, scale 3, quaternion 4, opacity 1
CODED_BYTES = 2  # 16-bit fixed point (Sec. 4.3)
CHANNELS = 3


def coefficients(sh_degree: int) -> int:
    """Spherical-harmonic coefficients per channel, degree 0 included."""
    return (sh_degree + 1) ** 2


def attributes(sh_degree: int) -> int:
    """Numbers of one decoded splat."""
    return PLAIN_ATTRIBUTES + CHANNELS * coefficients(sh_degree)


def plain_bytes(sh_degree: int) -> int:
    """Bytes of a splat in float32, as escaped payloads carry it."""
    return 4 * attributes(sh_degree)


def codeword_bytes(sh_degree: int) -> int:
    """Bytes of one codeword: the coefficients above degree 0, 16 bits each."""
    return CODED_BYTES * CHANNELS * (coefficients(sh_degree) - 1)


def record_bytes(record: SplatRecord, sh_degree: int) -> int:
    """Bytes of one splat record in DRAM.

    ``decoded_fp32`` and ``decoded_fp16`` hold every attribute; ``compressed_in_dram`` holds 16-bit
    codes of the plain attributes and the base colour, and a codeword index for the rest.
    """
    if record.layout == "decoded_fp32":
        return plain_bytes(sh_degree)
    if record.layout == "decoded_fp16":
        return plain_bytes(sh_degree) // 2
    index = record.code_index_bytes if sh_degree > 0 else 0
    return CODED_BYTES * (PLAIN_ATTRIBUTES + CHANNELS) + index
