"""Image distances: bits, 8 bits, PSNR, SSIM."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest

from gaussians.errors import InputError
from gaussians.quality import (
    MissingQualityExtra,
    mismatching_pixels,
    mismatching_pixels_8bit,
    psnr_db,
    ssim,
    to_8bit,
)


def random_image(seed: int, height: int = 24, width: int = 17) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width, 3), np.float32)


def test_mismatching_pixels_counts_bits():
    a = np.zeros((4, 5, 3), np.float32)
    b = a.copy()
    assert mismatching_pixels(a, b) == 0
    b[1, 2, 0] = -0.0
    b[3, 4, 1:] = np.nextafter(np.float32(0), np.float32(1))
    assert mismatching_pixels(a, b) == 2
    assert mismatching_pixels_8bit(a, b) == 0
    assert mismatching_pixels(a[:, ::-1], b[:, ::-1]) == 2
    assert psnr_db(a, a.copy()) is None


def test_to_8bit_clips_and_rounds_halves_to_even():
    image = np.float32([[[-1, 0.5, 7], [0.1, 1.5 / 255, 1]]])
    assert to_8bit(image).tolist() == [[[0, 128, 255], [26, 2, 255]]]  # 127.5 is the one exact half
    assert to_8bit(image).dtype == np.uint8
    for bad in (np.nan, np.inf):
        with pytest.raises(InputError, match="finite in every pixel"):
            to_8bit(np.full((1, 1, 3), bad, np.float32))


def test_psnr_of_a_known_error():
    a = np.full((8, 8, 3), 0.5, np.float32)
    b = a.copy()
    b[..., 0] += np.float32(0.25)  # mean square = 0.0625 / 3
    assert psnr_db(a, b) == pytest.approx(-10 * math.log10(0.0625 / 3), abs=1e-12)
    assert psnr_db(a, b) == psnr_db(b, a)


def test_values_beyond_the_display_do_not_count():
    a, b = random_image(1), random_image(1)
    a[0, 0], b[0, 0] = 1.0, 40.0
    a[0, 1], b[0, 1] = 0.0, -3.0
    assert mismatching_pixels(a, b) == 2
    assert mismatching_pixels_8bit(a, b) == 0
    assert psnr_db(a, b) is None
    assert ssim(a, b) == 1.0


def naive_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Wang et al. 2004, eq. 13, one window position at a time, border of 5 px left out."""
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(taps, taps) / taps.sum() ** 2
    c1, c2 = 0.01**2, 0.03**2
    values = []
    for channel in range(3):
        for y in range(5, a.shape[0] - 5):
            for x in range(5, a.shape[1] - 5):
                p = a[y - 5 : y + 6, x - 5 : x + 6, channel].astype(float)
                q = b[y - 5 : y + 6, x - 5 : x + 6, channel].astype(float)
                mp, mq = (window * p).sum(), (window * q).sum()
                vp, vq = (window * p * p).sum() - mp**2, (window * q * q).sum() - mq**2
                cov = (window * p * q).sum() - mp * mq
                values.append(
                    (2 * mp * mq + c1) * (2 * cov + c2) / ((mp**2 + mq**2 + c1) * (vp + vq + c2))
                )
    return float(np.mean(values))


def test_ssim_is_that_of_the_paper():
    pytest.importorskip("skimage", reason="needs scikit-image (extra quality)")
    a = random_image(2)
    b = np.clip(a + 0.3 * (random_image(3) - 0.5), 0, 1).astype(np.float32)
    assert ssim(a, a) == pytest.approx(1.0, abs=1e-12)
    assert ssim(a, b) == pytest.approx(naive_ssim(a, b), abs=1e-9)
    with pytest.raises(InputError, match="at least 11 x 11 pixels, not 10 x 24"):
        ssim(a[:, :10], b[:, :10])


def test_ssim_without_scikit_image_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "skimage.metrics", None)
    with pytest.raises(MissingQualityExtra, match=r"pip install 'nebula-splat\[quality\]'"):
        ssim(random_image(1), random_image(2))
    assert issubclass(MissingQualityExtra, ImportError)


@pytest.mark.parametrize("measure", [mismatching_pixels, mismatching_pixels_8bit, psnr_db, ssim])
def test_images_of_different_kind_are_refused(measure):
    image = random_image(1)
    with pytest.raises(InputError, match="must have one size, not 17 x 24 and 17 x 23"):
        measure(image, image[1:])
    for other in (image.astype(np.float64), image[..., :2], image[..., 0], image[:0]):
        with pytest.raises(InputError, match=r"float32 of shape \[height, width, 3\]"):
            measure(image, other)
