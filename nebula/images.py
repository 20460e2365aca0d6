"""Images to PNG bytes."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gaussians.quality import to_8bit


def png(image: NDArray[np.float32]) -> bytes:
    """PNG of a float32 image [H, W, 3], 8 bits per channel."""
    stream = io.BytesIO()
    Image.fromarray(to_8bit(image)).save(stream, format="PNG")
    return stream.getvalue()


def difference_png(a: NDArray[np.float32], b: NDArray[np.float32]) -> bytes:
    """Where two images differ: absolute difference on grey, differing pixels at least visible.

    A pixel that differs in a single float32 bit is drawn at 15 % grey, so that it can be seen.
    """
    differs = (a.view(np.uint32) != b.view(np.uint32)).any(axis=2)
    grey = np.abs(a - b).max(axis=2)
    shown = np.where(differs, np.maximum(grey, np.float32(0.15)), np.float32(0))
    return png(np.repeat(shown[:, :, None], 3, axis=2))
