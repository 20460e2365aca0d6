"""Maps and side by side images of ``nebula verify``: colours at known places."""

from __future__ import annotations

import io
from itertools import combinations

import numpy as np
import pytest
from PIL import Image

from gaussians.errors import InputError
from gaussians.quality import to_8bit
from nebula.verification.pictures import (
    DECADES,
    PALETTE,
    cause_map,
    difference_map,
    error_colours,
    side_by_side,
)

WHITE = [255, 255, 255]
BLACK = [0, 0, 0]


def pixels(png: bytes) -> np.ndarray:
    """[H, W, 3] uint8 of PNG bytes."""
    image = Image.open(io.BytesIO(png))
    assert image.format == "PNG" and image.mode == "RGB"
    return np.asarray(image).astype(int)


def lightness(colours: np.ndarray) -> np.ndarray:
    """CIE L* of sRGB colours [..., 3] in 0..255."""
    encoded = np.asarray(colours) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    y = linear @ [0.2126, 0.7152, 0.0722]
    return np.where(y > 216 / 24389, 116 * np.cbrt(y) - 16, y * 24389 / 27)


def gray(height: int, width: int, value: float = 0.5) -> np.ndarray:
    return np.full((height, width, 3), value, np.float32)


def test_error_colours_get_lighter_and_none_is_as_dark_as_equal_bits():
    scale = lightness(error_colours())
    assert error_colours().shape == (256, 3)
    assert (np.diff(scale) > 0).all()
    assert scale[0] > 20 and scale[-1] > 90


def test_difference_map_of_equal_images_is_black_beside_its_legend():
    drawn = pixels(difference_map(gray(600, 700), gray(600, 700)))
    assert (drawn[:600, :700] == 0).all()
    assert drawn.shape[0] == 600 and drawn.shape[1] > 700 + 8 * 14
    legend = drawn[:, 700:]
    assert (legend[:, :5] == 255).all() and (legend < 100).any()


def test_difference_map_colours_by_the_logarithm_of_the_worst_channel():
    a, b = gray(600, 700, 0.0), gray(600, 700, 0.0)
    for row, error in enumerate((1.0, 1e-2, 1e-7, 1e-12, 50.0)):
        b[row, 3] = (error / 2, error, 0)
    b[5, 3, 0] = -0.0  # other bits, no error
    drawn = pixels(difference_map(a, b))
    colours = error_colours().tolist()
    places = [255, round(255 * (1 - 2 / DECADES)), 0, 0, 255, 0]
    assert drawn[:6, 3].tolist() == [colours[i] for i in places]
    assert (drawn[:600, :3] == 0).all() and (drawn[6:600, :700] == 0).all()
    assert (pixels(difference_map(b, a)) == drawn).all()


def test_difference_map_has_the_whole_scale_in_its_legend():
    legend = pixels(difference_map(gray(600, 700), gray(600, 700)))[:, 700:]
    bar = legend[:, 14 + 5]
    for end in (error_colours()[0], error_colours()[-1]):
        assert (np.abs(bar - end).max(axis=1) <= 3).any()
    colourful = np.ptp(bar, axis=1) > 40
    steps = np.diff(lightness(bar[colourful]))
    assert len(steps) > 100 and (steps <= 1e-9).all()  # the largest error is at the top


def test_difference_map_refuses_what_is_no_pair():
    with pytest.raises(InputError, match="must have one size, not 7 x 9 and 7 x 8"):
        difference_map(gray(9, 7), gray(8, 7))
    with pytest.raises(InputError, match="finite in every pixel"):
        difference_map(gray(9, 7), gray(9, 7, np.inf))


def test_small_images_are_magnified_by_a_whole_number():
    a, b = gray(48, 64), gray(48, 64)
    b[47, 63] += np.float32(0.25)
    drawn = pixels(difference_map(a, b))  # 512 / 64 = 8 times
    lit = np.argwhere(drawn[: 8 * 48, : 8 * 64].any(axis=2))
    assert lit.min(axis=0).tolist() == [8 * 47, 8 * 63]
    assert lit.max(axis=0).tolist() == [8 * 48 - 1, 8 * 64 - 1]
    assert drawn.shape[0] > 8 * 48  # the legend is higher; below the map the sheet is white
    assert (drawn[8 * 48 :, : 8 * 64] == 255).all()


def test_legends_grow_with_the_image():
    small, large = (difference_map(gray(n, n), gray(n, n)) for n in (512, 2048))
    widths = [pixels(png).shape[1] - n for png, n in ((small, 512), (large, 2048))]
    assert widths[1] > 2.5 * widths[0]


def causes(height: int = 600, width: int = 700) -> tuple[np.ndarray, list[str], list[int]]:
    """A map with three of four causes, and 'equal' elsewhere."""
    labels = np.zeros((height, width), np.uint8)
    labels[0, :5], labels[1, :2], labels[height - 1, width - 1] = 1, 2, 4
    return labels, ["termination", "conic", "ties", "unknown"], [5, 2, 0, 1]


def test_cause_map_paints_each_label_in_its_colour():
    labels, names, counts = causes()
    drawn = pixels(cause_map(labels, names, counts))
    expected = np.array([BLACK, *PALETTE])[labels]
    assert (drawn[:600, :700] == expected).all()
    legend = drawn[:, 700:].reshape(-1, 3).tolist()
    for colour in (BLACK, *PALETTE[:4]):  # those that occur and the one that does not
        assert legend.count(list(colour)) > 100
    assert list(PALETTE[4]) not in legend


def test_cause_legend_makes_room_for_every_line_and_the_longest_name():
    labels = np.zeros((64, 300), np.uint8)  # lower than thirteen lines of legend
    names = [f"cause {i}" for i in range(13)]
    short = pixels(cause_map(labels, names, [0] * 13))
    longer = pixels(cause_map(labels, [*names[:12], "a cause with a much longer name"], [0] * 13))
    assert short.shape[0] == longer.shape[0] > 13 * 14
    assert longer.shape[1] > short.shape[1] + 100
    assert (short[64:, :300] == 255).all()
    assert (short[-14:] == 255).all() and (short[:, -14:] == 255).all()  # a margin all around


def test_cause_map_without_a_wrong_pixel():
    drawn = pixels(cause_map(np.zeros((600, 600), np.uint8), ["conic"], [0]))
    assert (drawn[:600, :600] == 0).all()


@pytest.mark.parametrize(
    ("labels", "names", "counts", "message"),
    [
        (np.zeros((4, 4), np.int64), ["a"], [0], r"labels must be uint8 .* not int64 of \[4, 4\]"),
        (np.zeros((0, 4), np.uint8), ["a"], [0], r"labels must be uint8 .* of \[0, 4\]"),
        (np.zeros((4, 4, 3), np.uint8), ["a"], [0], "labels must be uint8"),
        (np.full((2, 2), 2, np.uint8), ["a"], [0], r"labels must lie in 0\.\.1, not 2"),
        (np.ones((2, 2), np.uint8), ["a"], [3], r"those of the labels, \[4\], not \[3\]"),
        (np.ones((2, 2), np.uint8), ["a", "b"], [4], r"\[4, 0\], not \[4\]"),
        (np.zeros((2, 2), np.uint8), ["a"] * 14, [0] * 14, "at most 13 causes, not 14"),
    ],
)
def test_cause_map_refuses_labels_it_cannot_draw(labels, names, counts, message):
    with pytest.raises(InputError, match=message):
        cause_map(labels, names, counts)


# Linear RGB as a protanope and a deuteranope see it: Machado et al. 2009, severity 1.
VISIONS = {
    "normal": (np.eye(3), 18.0),
    "protanope": (
        np.array(
            [
                [0.152286, 1.052583, -0.204868],
                [0.114503, 0.786281, 0.099216],
                [-0.003882, -0.048116, 1.051998],
            ]
        ),
        14.0,
    ),
    "deuteranope": (
        np.array(
            [
                [0.367322, 0.860646, -0.227968],
                [0.280085, 0.672501, 0.047413],
                [-0.011820, 0.042940, 0.968881],
            ]
        ),
        14.0,
    ),
}


@pytest.mark.parametrize("vision", VISIONS)
def test_palette_is_told_apart(vision):
    color = pytest.importorskip("skimage.color", reason="needs scikit-image (extra quality)")
    matrix, least = VISIONS[vision]
    encoded = np.array([BLACK, *PALETTE]) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ matrix.T, 0, 1)
    seen = np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055)
    lab = color.rgb2lab(seen)
    pairs = combinations(range(len(lab)), 2)
    assert min(color.deltaE_ciede2000(lab[i], lab[j]) for i, j in pairs) >= least
    assert len(PALETTE) == 13


def test_side_by_side_keeps_the_images_below_their_titles():
    rng = np.random.default_rng(0)
    images = [rng.random((520, 530, 3), np.float32) for _ in range(3)]
    drawn = pixels(side_by_side(images, ["one", "two", "three"]))
    gap = (drawn.shape[1] - 3 * 530) // 2
    assert gap > 0 and drawn.shape[0] > 520 + 14
    for i, image in enumerate(images):
        left = i * (530 + gap)
        assert (drawn[-520:, left : left + 530] == to_8bit(image)).all()
        title = drawn[:-520, left : left + 530]
        assert (title < 60).all(axis=2).any()
    assert (drawn[-520:, 530 : 530 + gap] == 255).all()


def test_side_by_side_wraps_long_titles():
    images = [gray(512, 512), gray(512, 512)]
    short = pixels(side_by_side(images, ["one", "two"]))
    long = pixels(side_by_side(images, ["one", "the right eye as this method makes it " * 3]))
    assert long.shape[1] == short.shape[1] and long.shape[0] > short.shape[0] + 14
    lines = (long[:-512, 512 + 20 :] < 60).all(axis=2).any(axis=1)
    assert np.count_nonzero(np.diff(lines.astype(int)) == 1) >= 3  # each line of text is there
    left = long[:-512, : 512 + 4]
    assert (left[: long.shape[0] - short.shape[0]] == 255).all()  # a short title stays at its image


def test_side_by_side_refuses_images_that_do_not_match():
    with pytest.raises(InputError, match=r"one shape, not \[4, 5, 3\] and \[5, 4, 3\]"):
        side_by_side([gray(4, 5), gray(5, 4)], ["a", "b"])
    for images, titles in (([], []), ([gray(4, 5)], ["a", "b"])):
        with pytest.raises(InputError, match="every image needs one title"):
            side_by_side(images, titles)
