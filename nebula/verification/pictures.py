"""The pictures of ``nebula verify``: where two images differ, by how much, and for which cause.

A map keeps the image's own pixels at the top left of the sheet, so that it can be laid over the
image; the legend stands at its right. Images far smaller than a screen are magnified by a whole
number. Texts may use the basic Latin letters (those of Pillow's own typeface).
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from gaussians.errors import InputError
from gaussians.quality import absolute_error, differing, to_8bit
from nebula.report.charts import percent

Colour = tuple[int, int, int]

_INK: Colour = (20, 20, 20)
_FAINT: Colour = (120, 120, 120)
_PAPER: Colour = (255, 255, 255)
_BLACK: Colour = (0, 0, 0)

# Chosen by exchange search over a lattice of sRGB colours of CIE lightness 36 to 97: the smallest
# CIEDE2000 distance of any two of these and black is 18 as seen normally, 14 as a protanope or a
# deuteranope sees them (Machado et al. 2009, doi:10.1109/TVCG.2009.113). Most distinct first.
PALETTE: tuple[Colour, ...] = (
    (0xFF, 0xFF, 0x33),
    (0x33, 0xBB, 0xFF),
    (0x00, 0x77, 0x55),
    (0x55, 0x00, 0xFF),
    (0x99, 0x77, 0x99),
    (0xFF, 0x77, 0x00),
    (0x55, 0xFF, 0xFF),
    (0x99, 0x33, 0x00),
    (0xBB, 0xFF, 0xBB),
    (0xBB, 0x99, 0x77),
    (0x55, 0x55, 0x77),
    (0x55, 0x77, 0xFF),
    (0xFF, 0x99, 0xBB),
)

DECADES = 7  # the error scale runs from 1e-7, below one bit of white, to 1
_SCALE_ENDS = (0x4B2A8C, 0x9A32A6, 0xDB4A80, 0xF57F4F, 0xFBB53F, 0xFCF5B0)  # lightness 27 to 96

_SCREEN_PX = 512  # smaller images are magnified towards this
_SMALLEST_TEXT_PX = 14
_TEXTS_PER_SIDE = 48  # the longer side of what is shown, in text heights
_COMPRESSION = 3  # zlib: a tenth larger than its default level, three times as fast


def error_colours() -> NDArray[np.uint8]:
    """uint8 [256, 3]: colours of errors 1e-7 to 1 on a log scale, dark to light; none is black."""
    anchors = np.array([[c >> 16, c >> 8 & 255, c & 255] for c in _SCALE_ENDS], float)
    places = np.linspace(0, 1, len(anchors))
    steps = np.linspace(0, 1, 256)
    channels = [np.interp(steps, places, anchors[:, i]) for i in range(3)]
    return np.rint(np.stack(channels, axis=1)).astype(np.uint8)


def difference_map(a: NDArray[np.float32], b: NDArray[np.float32]) -> bytes:
    """PNG of the largest absolute error of a channel, black where all float32 bits are equal.

    Errors outside 1e-7..1 (and bits that differ at error 0, as -0.0 does) take the scale's end.
    Raises InputError unless both are finite images of one size.
    """
    different = differing(a, b)
    error = np.clip(absolute_error(a, b), 10.0**-DECADES, 1.0)
    level = np.rint(255 * (1 + np.log10(error) / DECADES)).astype(np.uint8)
    pixels = error_colours().take(level, axis=0)
    pixels[~different] = _BLACK
    picture = _magnified(pixels)
    text_px = _text_px(*picture.size)
    wrong = int(np.count_nonzero(different))
    caption = _caption(wrong, different.size, "differ")
    return _png(_beside(picture, _error_legend(caption, text_px), text_px))


def cause_map(labels: NDArray[np.uint8], names: Sequence[str], counts: Sequence[int]) -> bytes:
    """PNG of what makes each pixel wrong: ``labels`` [H, W] uint8, i for ``names[i - 1]``.

    0 is a right pixel, drawn black. ``counts`` are the pixels of each name; the legend shows them
    and their share of all wrong pixels. A name keeps its place and colour when its count is 0.

    Raises InputError for more names than the palette has colours, labels without a name, and
    counts that are not those of the labels.
    """
    _check_labels(labels, names, counts)
    colours = np.array([_BLACK, *PALETTE[: len(names)]], np.uint8)
    picture = _magnified(colours[labels])
    text_px = _text_px(*picture.size)
    wrong = sum(counts)
    caption = _caption(wrong, labels.size, "wrong")
    rows = [("cause", "pixels", "of wrong"), ("none (correct)", _count(labels.size - wrong), "")]
    rows += [
        (name, _count(count), _share(count, wrong))
        for name, count in zip(names, counts, strict=True)
    ]
    return _png(_beside(picture, _cause_legend(caption, rows, text_px), text_px))


def side_by_side(images: Sequence[NDArray[np.float32]], titles: Sequence[str]) -> bytes:
    """PNG of float32 images [H, W, 3] of one size, left to right, each below its title.

    Titles are wrapped at the image's width. The images fill the sheet's lower edge.
    """
    if not images or len(images) != len(titles):
        raise InputError(f"every image needs one title, not {len(images)} and {len(titles)}")
    for image in images[1:]:
        if image.shape != images[0].shape:
            raise InputError(
                f"images must have one shape, not {list(images[0].shape)} and {list(image.shape)}"
            )
    pictures = [_magnified(to_8bit(image)) for image in images]
    width, height = pictures[0].size
    text_px = _text_px(len(images) * width, height)
    lines = [_wrapped(title, width, text_px) for title in titles]
    top = text_px // 2 + _line_px(text_px) * max(map(len, lines))
    gap = text_px // 2
    sheet = Image.new("RGB", (len(images) * (width + gap) - gap, top + height), _PAPER)
    for i, (picture, text) in enumerate(zip(pictures, lines, strict=True)):
        first = top - text_px // 4 - _line_px(text_px) * len(text)
        _write_lines(ImageDraw.Draw(sheet), (i * (width + gap), first), text, text_px)
        sheet.paste(picture, (i * (width + gap), top))
    return _png(sheet)


def _check_labels(labels: NDArray[np.uint8], names: Sequence[str], counts: Sequence[int]) -> None:
    if labels.dtype != np.uint8 or labels.ndim != 2 or not labels.size:
        raise InputError(
            f"labels must be uint8 of shape [height, width], not {labels.dtype} of "
            f"{list(labels.shape)}"
        )
    if len(names) > len(PALETTE):
        raise InputError(f"a cause map has at most {len(PALETTE)} causes, not {len(names)}")
    labelled = np.bincount(labels.ravel(), minlength=len(names) + 1)[1:].tolist()
    if len(labelled) > len(names):
        raise InputError(f"labels must lie in 0..{len(names)}, not {len(labelled)}")
    if labelled != list(counts):
        raise InputError(f"counts must be those of the labels, {labelled}, not {list(counts)}")


def _error_legend(caption: list[str], text_px: int) -> Image.Image:
    """Caption, colour bar with a label at each decade, and the black of equal bits."""
    line = _line_px(text_px)
    texts = [*caption, "", "largest absolute", "error of a channel"]
    top = line * len(texts) + text_px
    bar = 2 * line * DECADES
    width = max(_width(text, text_px) for text in texts)
    legend = Image.new("RGB", (width, top + bar + line + text_px + 1), _PAPER)
    draw = ImageDraw.Draw(legend)
    _write_lines(draw, (0, 0), texts, text_px)
    falling = error_colours()[np.rint(np.linspace(255, 0, bar)).astype(int)]
    legend.paste(Image.fromarray(falling[:, None].repeat(2 * text_px, axis=1)), (0, top))
    for decade in range(DECADES + 1):
        y = top + 2 * line * decade
        draw.line((2 * text_px, y, 2.4 * text_px, y), _INK, max(1, text_px // 12))
        label = "1" if decade == 0 else f"1e-{decade}"
        draw.text((2.7 * text_px, y), label, _INK, _font(text_px), anchor="lm")
    y = top + round(2 * line * math.log10(255))
    draw.line((2 * text_px, y, 2.4 * text_px, y), _FAINT, max(1, text_px // 12))
    draw.text((2.7 * text_px, y), "8-bit step", _FAINT, _font(text_px), anchor="lm")
    y = top + bar + line
    draw.rectangle((0, y, 2 * text_px, y + text_px), _BLACK)
    draw.text((2.7 * text_px, y + text_px // 2), "equal bits", _INK, _font(text_px), anchor="lm")
    return legend


def _cause_legend(
    caption: list[str], rows: list[tuple[str, str, str]], text_px: int
) -> Image.Image:
    """Caption and a table: swatch, name, and two columns of numbers set to the right."""
    font, line = _font(text_px), _line_px(text_px)
    widths = [max(_width(row[i], text_px) for row in rows) for i in range(3)]
    name_left = 2 * text_px
    count_right = name_left + widths[0] + 2 * text_px + widths[1]
    width = max(count_right + text_px + widths[2], *(_width(text, text_px) for text in caption))
    top = line * len(caption) + text_px
    legend = Image.new("RGB", (width, top + line * len(rows)), _PAPER)
    draw = ImageDraw.Draw(legend)
    _write_lines(draw, (0, 0), caption, text_px)
    swatches: list[Colour | None] = [None, _BLACK, *PALETTE]
    for i, (swatch, row) in enumerate(zip(swatches, rows, strict=False)):
        y = top + line * i + text_px // 2
        ink = _INK if swatch and row[1] != "0" else _FAINT
        draw.text((name_left, y), row[0], ink, font, anchor="lm")
        draw.text((count_right, y), row[1], ink, font, anchor="rm")
        draw.text((width, y), row[2], ink, font, anchor="rm")
        if swatch:
            box = (0, y - text_px // 2, int(1.4 * text_px), y + text_px // 2)
            draw.rectangle(box, swatch, _FAINT, max(1, text_px // 20))
    return legend


def _beside(picture: Image.Image, legend: Image.Image, text_px: int) -> Image.Image:
    """The picture at the top left, the legend at its right with a margin around."""
    width = picture.width + legend.width + 2 * text_px
    height = max(picture.height, legend.height + 2 * text_px)
    sheet = Image.new("RGB", (width, height), _PAPER)
    sheet.paste(picture, (0, 0))
    sheet.paste(legend, (picture.width + text_px, text_px))
    return sheet


def _magnified(pixels: NDArray[np.uint8]) -> Image.Image:
    """[H, W, 3] uint8 as it is, or in whole multiples where it is far smaller than a screen."""
    times = max(1, _SCREEN_PX // max(pixels.shape[:2]))
    return Image.fromarray(pixels.repeat(times, axis=0).repeat(times, axis=1))


def _text_px(width: int, height: int) -> int:
    return max(_SMALLEST_TEXT_PX, max(width, height) // _TEXTS_PER_SIDE)


def _line_px(text_px: int) -> int:
    return round(1.35 * text_px)


def _font(text_px: int) -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
    return ImageFont.load_default(text_px)


def _width(text: str, text_px: int) -> int:
    return math.ceil(_font(text_px).getlength(text))


def _wrapped(text: str, width: int, text_px: int) -> list[str]:
    """The text in lines of at most this many pixels; a single longer word stays whole."""
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and _width(longer, text_px) <= width:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def _write_lines(
    draw: ImageDraw.ImageDraw, corner: tuple[int, int], lines: Sequence[str], text_px: int
) -> None:
    for i, text in enumerate(lines):
        draw.text((corner[0], corner[1] + _line_px(text_px) * i), text, _INK, _font(text_px))


def _caption(part: int, whole: int, what: str) -> list[str]:
    return [f"{_count(part)} of", f"{_count(whole)} pixels", f"{what} ({_share(part, whole)})"]


def _count(number: int) -> str:
    return f"{number:,}".replace(",", " ")


def _share(part: int, whole: int) -> str:
    return percent(part / whole) if whole else "-"


def _png(sheet: Image.Image) -> bytes:
    stream = io.BytesIO()
    sheet.save(stream, format="PNG", compress_level=_COMPRESSION)
    return stream.getvalue()
