"""How far two images are apart: in bits, in absolute error, in decibels, and as they are seen.

Images are [height, width, 3] float32 as rendered, 0 black and 1 white, in the display's own (sRGB)
encoding. Colours may exceed 1; what a display can show is the range 0..1. The measures of the
arithmetic (``differing``, ``mismatching_pixels``, ``absolute_error``, ``max_abs``, ``mean_abs``)
take the values as they are; all others first clip both images to 0..1.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError

Image = NDArray[np.float32]

_SSIM_SIGMA_PX = 1.5
_SSIM_WINDOW_PX = 11  # the Gaussian is cut off at 3.5 sigma


class MissingQualityExtra(ImportError):
    """A measure needs the optional extra ``quality``, which is not installed."""


def differing(a: Image, b: Image) -> NDArray[np.bool_]:
    """bool [H, W]: any channel's float32 bits differ (so -0.0 differs from 0.0). No clipping."""
    _check_pair(a, b)
    different = np.ascontiguousarray(a).view(np.uint32) != np.ascontiguousarray(b).view(np.uint32)
    return different.any(axis=2)


def mismatching_pixels(a: Image, b: Image) -> int:
    """Pixels with any channel whose float32 bits differ: those of ``differing``."""
    return int(differing(a, b).sum())


def error_8bit(a: Image, b: Image) -> NDArray[np.uint8]:
    """uint8 [H, W]: the largest difference of a channel after ``to_8bit``, in steps of 1/255."""
    _check_pair(a, b)
    shown_a, shown_b = to_8bit(a), to_8bit(b)
    return _largest_channel(np.maximum(shown_a, shown_b) - np.minimum(shown_a, shown_b))


def mismatching_pixels_8bit(a: Image, b: Image) -> int:
    """Pixels with any channel that differs after ``to_8bit``."""
    return int(np.count_nonzero(error_8bit(a, b)))


def absolute_error(a: Image, b: Image) -> NDArray[np.float64]:
    """float64 [H, W]: the largest absolute difference of a channel, without clipping.

    Zero does not mean equal bits (-0.0). Raises InputError for NaN and infinity.
    """
    return _largest_channel(_absolute_errors(a, b))


def max_abs(a: Image, b: Image) -> float:
    """Largest ``absolute_error`` of the image."""
    return float(_absolute_errors(a, b).max())


def mean_abs(a: Image, b: Image) -> float:
    """Mean absolute difference over all pixels and channels, in float64, without clipping."""
    return float(_absolute_errors(a, b).mean())


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


def flip(a: Image, b: Image, *, pixels_per_degree: float) -> float:
    """Mean LDR-FLIP error (Andersson et al. 2020, doi:10.1145/3406183), 0 identical, 1 the largest.

    What a viewer notices who alternates between the images at ``pixels_per_degree`` (see the
    function of that name). Symmetric; exactly 0.0 for equal clipped images. Error map by
    flip-evaluator in float32, its mean in float64.

    Raises MissingQualityExtra without flip-evaluator.
    """
    _check_pair(a, b)
    if not (math.isfinite(pixels_per_degree) and pixels_per_degree > 0):
        raise InputError(f"pixels per degree must be finite and above 0, not {pixels_per_degree}")
    try:
        from flip_evaluator import evaluate
    except ImportError as error:
        raise MissingQualityExtra(
            f"FLIP needs flip-evaluator (pip install 'nebula-splat[quality]'): {error}"
        ) from error
    error_map, _mean, _parameters = evaluate(
        _clipped(a).astype(np.float32),
        _clipped(b).astype(np.float32),
        "LDR",
        inputsRGB=True,  # encoded for the display, not linear
        applyMagma=False,
        computeMeanError=False,
        parameters={"ppd": pixels_per_degree},
    )
    return float(np.mean(error_map, dtype=np.float64))


def pixels_per_degree(focal_px: float) -> float:
    """Pixels that one degree covers at the principal point of a display with this focal length."""
    return 2.0 * focal_px * math.tan(math.radians(0.5))


def _absolute_errors(a: Image, b: Image) -> NDArray[np.float64]:
    """float64 [H, W, 3], unclipped."""
    _check_pair(a, b)
    return np.abs(_finite(a) - _finite(b))


def _largest_channel(values: NDArray[Any]) -> NDArray[Any]:
    """[H, W] of [H, W, 3], many times faster than a maximum over the short axis."""
    return np.maximum(np.maximum(values[..., 0], values[..., 1]), values[..., 2])


def _finite(image: Image) -> NDArray[np.float64]:
    """The image in float64."""
    if not np.isfinite(image).all():
        raise InputError("image must be finite in every pixel")
    return image.astype(np.float64)


def _clipped(image: Image) -> NDArray[np.float64]:
    """The image in float64, clipped to what a display can show."""
    return np.clip(_finite(image), 0.0, 1.0)


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
