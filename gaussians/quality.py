"""How far two images are apart: in bits, in decibels, and in structural similarity.

Images are [height, width, 3] float32 as rendered, 0 black and 1 white. Colours may exceed 1; what a
display can show is the range 0..1, so every measure but ``mismatching_pixels`` first clips both
images to it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError

Image = NDArray[np.float32]

_SSIM_SIGMA_PX = 1.5
_SSIM_WINDOW_PX = 11  # the Gaussian is cut off at 3.5 sigma


class MissingQualityExtra(ImportError):
    """A measure needs the optional extra ``quality``, which is not installed."""


def mismatching_pixels(a: Image, b: Image) -> int:
    """Pixels with any channel whose float32 bits differ (so -0.0 differs from 0.0). No clipping."""
    _check_pair(a, b)
    different = np.ascontiguousarray(a).view(np.uint32) != np.ascontiguousarray(b).view(np.uint32)
    return int(different.any(axis=2).sum())


def mismatching_pixels_8bit(a: Image, b: Image) -> int:
    """Pixels with any channel that differs after ``to_8bit``."""
    _check_pair(a, b)
    return int((to_8bit(a) != to_8bit(b)).any(axis=2).sum())


def to_8bit(image: Image) -> NDArray[np.uint8]:
    """uint8 for display: clipped to 0..1, times 255 in float64, halves rounded to even.

    Raises InputError for NaN and infinity.
    """
    return np.rint(_clipped(image) * 255.0).astype(np.uint8)


def psnr_db(a: Image, b: Image) -> float | None:
    """Peak signal-to-noise ratio in dB with peak 1, over all pixels and channels, in float64.

    None when the clipped images are equal, as they are when the bits are: the ratio is infinite.
    """
    _check_pair(a, b)
    mean_square = float(np.mean((_clipped(a) - _clipped(b)) ** 2))
    return None if mean_square == 0 else -10.0 * math.log10(mean_square)


def ssim(a: Image, b: Image) -> float:
    """Mean structural similarity (Wang et al. 2004, doi:10.1109/TIP.2003.819861), 1 = identical.

    Computed by scikit-image in float64 with the paper's options: Gaussian window of sigma 1.5 px,
    population covariance, range 1, mean over the three channels.

    Raises MissingQualityExtra without scikit-image, InputError for images below 11 x 11 pixels.
    """
    _check_pair(a, b)
    if min(a.shape[:2]) < _SSIM_WINDOW_PX:
        raise InputError(
            f"SSIM needs images of at least {_SSIM_WINDOW_PX} x {_SSIM_WINDOW_PX} pixels, "
            f"not {a.shape[1]} x {a.shape[0]}"
        )
    try:
        from skimage.metrics import structural_similarity
    except ImportError as error:
        raise MissingQualityExtra(
            f"SSIM needs scikit-image (pip install 'nebula-splat[quality]'): {error}"
        ) from error
    return float(
        structural_similarity(
            _clipped(a),
            _clipped(b),
            gaussian_weights=True,
            sigma=_SSIM_SIGMA_PX,
            use_sample_covariance=False,
            data_range=1.0,
            channel_axis=2,
        )
    )


def _clipped(image: Image) -> NDArray[np.float64]:
    """The image in float64, clipped to what a display can show."""
    if not np.isfinite(image).all():
        raise InputError("image must be finite in every pixel")
    return np.clip(image.astype(np.float64), 0.0, 1.0)


def _check_pair(a: Image, b: Image) -> None:
    """Raise InputError unless both are non-empty float32 images of one size."""
    for image in (a, b):
        if image.dtype != np.float32 or image.ndim != 3 or image.shape[2] != 3 or not image.size:
            raise InputError(
                f"image must be float32 of shape [height, width, 3], not {image.dtype} of "
                f"{list(image.shape)}"
            )
    if a.shape != b.shape:
        raise InputError(
            f"images must have one size, not {a.shape[1]} x {a.shape[0]} and "
            f"{b.shape[1]} x {b.shape[0]}"
        )
