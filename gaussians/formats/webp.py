"""Lossless WebP images as exact bytes."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError

PIXEL_LIMIT = 80_000_000  # below the size at which Pillow warns of a decompression bomb
_LOSSLESS_SIGNATURE = 0x2F


def decode_lossless_webp(data: bytes, name: str, least: int, most: int) -> NDArray[np.uint8]:
    """[height, width, 4] RGBA bytes; alpha is 255 where the image has none.

    Raises InputError unless this is one still, lossless WebP image of ``least`` to ``most`` pixels;
    the size is checked before anything is decoded.
    """
    width, height = _lossless_size(data, name)
    if not least <= width * height <= most:
        raise InputError(
            f"{name}: must have {least} to {most} pixels, not {width} x {height} = {width * height}"
        )
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(data), formats=("WEBP",)) as image:
            pixels = np.array(image.convert("RGBA"))
    except (UnidentifiedImageError, OSError, ValueError, EOFError) as error:
        raise InputError(f"{name}: must be an intact WebP image") from error
    if pixels.shape != (height, width, 4):
        raise InputError(f"{name}: must be an intact WebP image of {width} x {height} pixels")
    return pixels


def _lossless_size(data: bytes, name: str) -> tuple[int, int]:
    """Width and height from the lossless chunk (RFC 9649, Sec. 2.3 to 2.7 and 3.4)."""
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        raise InputError(f"{name}: must be a WebP image")
    end = 8 + int.from_bytes(data[4:8], "little")
    if end > len(data):
        raise InputError(f"{name}: truncated: must hold {end} bytes, not {len(data)}")
    position = 12
    while position + 8 <= end:
        kind = data[position : position + 4]
        size = int.from_bytes(data[position + 4 : position + 8], "little")
        body = data[position + 8 : position + 13]
        if kind == b"VP8L" and len(body) == 5 and body[0] == _LOSSLESS_SIGNATURE:
            bits = int.from_bytes(body[1:], "little")
            return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
        position += 8 + size + size % 2
    raise InputError(f"{name}: must be a still, lossless WebP image")
