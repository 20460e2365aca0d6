"""Image distances: bits, 8 bits, absolute error, PSNR, SSIM, FLIP."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest

from gaussians.errors import InputError
from gaussians.quality import (
    MissingQualityExtra,
    absolute_error,
    differing,
    error_8bit,
    flip,
    max_abs,
    mean_abs,
    mismatching_pixels,
    mismatching_pixels_8bit,
    pixels_per_degree,
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


def test_differing_marks_the_pixels_that_are_counted():
    a = random_image(4)
    b = a.copy()
    b[3, 5, 2] = np.nextafter(b[3, 5, 2], np.float32(2))
    a[7, 1, 0], b[7, 1, 0] = 0.0, -0.0
    marked = differing(a, b)
    assert marked.dtype == np.bool_ and marked.shape == a.shape[:2]
    assert np.argwhere(marked).tolist() == [[3, 5], [7, 1]]
    assert mismatching_pixels(a, b) == 2


def test_error_8bit_is_the_largest_channel_difference():
    a, b = np.zeros((2, 2, 3), np.float32), np.zeros((2, 2, 3), np.float32)
    a[0, 1] = (10 / 255, 0, 200 / 255)
    b[0, 1] = (0, 3 / 255, 255 / 255)
    a[1, 0, 1], b[1, 0, 1] = 30.0, 1.0  # both are white on the display
    error = error_8bit(a, b)
    assert error.dtype == np.uint8
    assert error.tolist() == [[0, 55], [0, 0]]
    assert (error_8bit(b, a) == error).all()
    assert error_8bit(np.zeros_like(a), np.ones_like(a)).tolist() == [[255, 255], [255, 255]]


def test_absolute_errors_are_of_the_values_as_computed():
    a = np.zeros((2, 5, 3), np.float32)
    b = a.copy()
    b[0, 0, 0], a[1, 1, 2] = -3.0, 9.0  # beyond the display
    assert max_abs(a, b) == max_abs(b, a) == 9.0
    assert mean_abs(a, b) == mean_abs(b, a) == 12.0 / 30
    assert absolute_error(a, b).tolist() == [[3, 0, 0, 0, 0], [0, 9, 0, 0, 0]]
    one = np.full((1, 1, 3), 1.0, np.float32)
    after = np.nextafter(one, np.float32(2))
    assert max_abs(one, after) == mean_abs(one, after) == 2.0**-23
    assert max_abs(a, a.copy()) == mean_abs(a, a.copy()) == 0.0
    for measure in (max_abs, mean_abs):
        with pytest.raises(InputError, match="finite in every pixel"):
            measure(one, np.full_like(one, np.nan))


def test_flip_of_equal_and_of_opposite_images():
    pytest.importorskip("flip_evaluator", reason="needs flip-evaluator (extra quality)")
    a = random_image(5)
    beyond = a.copy()
    a[0, 0], beyond[0, 0] = 1.0, 40.0
    a[0, 1], beyond[0, 1] = 0.0, -3.0
    assert flip(a, a.copy(), pixels_per_degree=16.0) == 0.0
    assert flip(a, beyond, pixels_per_degree=16.0) == 0.0
    assert flip(beyond, a, pixels_per_degree=16.0) == 0.0
    assert flip(a[:, ::-1], a[:, ::-1].copy(), pixels_per_degree=16.0) == 0.0
    black, white = np.zeros((8, 8, 3), np.float32), np.ones((8, 8, 3), np.float32)
    assert 0.9 < flip(black, white, pixels_per_degree=16.0) <= 1.0


def test_flip_of_a_flat_pair_follows_its_definition():
    """Flat images: no filter, no edge. The error is the remapped HyAB distance of greys."""
    pytest.importorskip("flip_evaluator", reason="needs flip-evaluator (extra quality)")
    a, b = np.full((9, 9, 3), 0.5, np.float32), np.full((9, 9, 3), 0.6, np.float32)

    def lightness(encoded: float) -> float:
        linear = ((encoded + 0.055) / 1.055) ** 2.4
        return 116 * linear ** (1 / 3) - 16

    distance = abs(lightness(0.6) - lightness(0.5)) ** 0.7
    # the largest distance is that of the sRGB green and blue, after Hunt adjustment: 41.2761
    expected = 0.95 * distance / (0.4 * 41.2761)
    assert flip(a, b, pixels_per_degree=16.0) == pytest.approx(expected, abs=2e-4)


def test_flip_sees_less_of_what_is_smaller():
    pytest.importorskip("flip_evaluator", reason="needs flip-evaluator (extra quality)")
    a = random_image(6, 40, 40)
    b = np.clip(a + 0.3 * (random_image(7, 40, 40) - 0.5), 0, 1).astype(np.float32)
    values = [flip(a, b, pixels_per_degree=ppd) for ppd in (10.0, 30.0, 90.0)]
    assert values == sorted(values, reverse=True)
    assert values[0] > 1.5 * values[2] > 0
    assert flip(a, b, pixels_per_degree=30.0) == flip(b, a, pixels_per_degree=30.0) == values[1]


@pytest.mark.parametrize("ppd", [0.0, -1.0, math.nan, math.inf])
def test_flip_refuses_pixels_per_degree_that_are_none(ppd):
    with pytest.raises(InputError, match=f"must be finite and above 0, not {ppd}"):
        flip(random_image(1), random_image(2), pixels_per_degree=ppd)


def test_flip_refuses_what_is_not_finite():
    pytest.importorskip("flip_evaluator", reason="needs flip-evaluator (extra quality)")
    image = random_image(1)
    unknown = image.copy()
    unknown[3, 4, 1] = np.nan
    for a, b in ((image, unknown), (unknown, image)):
        with pytest.raises(InputError, match="finite in every pixel"):
            flip(a, b, pixels_per_degree=20.0)


def test_flip_without_flip_evaluator_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(MissingQualityExtra, match=r"FLIP needs .*'nebula-splat\[quality\]'"):
        flip(random_image(1), random_image(2), pixels_per_degree=20.0)


def test_pixels_per_degree_of_the_prototype_display():
    assert pixels_per_degree(929.2) == pytest.approx(
        16.218, abs=1e-3
    )  # 21.5 on average: 96 degrees


def flip_at_20(a: np.ndarray, b: np.ndarray) -> float:
    return flip(a, b, pixels_per_degree=20.0)


MEASURES = [
    absolute_error,
    differing,
    error_8bit,
    flip_at_20,
    max_abs,
    mean_abs,
    mismatching_pixels,
    mismatching_pixels_8bit,
    psnr_db,
    ssim,
]


@pytest.mark.parametrize("measure", MEASURES)
def test_images_of_different_kind_are_refused(measure):
    image = random_image(1)
    with pytest.raises(InputError, match="must have one size, not 17 x 24 and 17 x 23"):
        measure(image, image[1:])
    for other in (image.astype(np.float64), image[..., :2], image[..., 0], image[:0]):
        with pytest.raises(InputError, match=r"float32 of shape \[height, width, 3\]"):
            measure(image, other)
