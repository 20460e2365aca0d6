"""Numbers as text, bars and columns for the report page: HTML and SVG made here, no script."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

_SCALES = ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"))
NARROW_SPACE = "\u202f"


def significant(value: float, digits: int = 3) -> str:
    """The number with so many significant digits, thousands apart: 0.0123, 4.56, 12 300."""
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    rounded = round(value, digits - 1 - exponent)
    exponent = math.floor(math.log10(abs(rounded)))
    if exponent < -4:
        return f"{rounded:.{digits - 1}e}"
    decimals = max(0, digits - 1 - exponent)
    return f"{rounded:,.{decimals}f}".replace(",", NARROW_SPACE)


def exact(value: int) -> str:
    """A whole number with every digit, thousands apart."""
    return f"{value:,}".replace(",", NARROW_SPACE)


def scaled(value: float, unit: str, short: bool = False) -> str:
    """Three significant digits and the unit, prefixed from 10 000 on: 35.4 MB, 14.3 M cycles.

    ``short`` drops zeros behind the point, for scales.
    """

    def number(amount: float) -> str:
        text = significant(amount)
        return text.rstrip("0").rstrip(".") if short and "." in text else text

    for factor, prefix in _SCALES:
        if abs(value) >= factor and abs(value) >= 1e4:
            gap = "" if unit in ("B", "bit") else " "
            return f"{number(value / factor)} {prefix}{gap}{unit}".strip()
    return f"{number(value)} {unit}".strip()


def percent(share: float) -> str:
    """A share as percent with three significant digits."""
    return f"{significant(100 * share)} %"


_ACRONYMS = {"dram": "DRAM", "sram": "SRAM", "lod": "LoD", "sh": "SH", "sru": "SRU", "vrc": "VRC"}


def words(name: str) -> str:
    """A key as words: ``dram_reads`` is "DRAM reads"."""
    return " ".join(_ACRONYMS.get(word, word) for word in name.split("_"))


@dataclass(frozen=True)
class Bar:
    """One line of a bar chart; ``text`` is what stands at its right end."""

    name: str
    value: float
    text: str
    strong: bool = False


def bar_chart(bars: Sequence[Bar], full: float | None = None) -> str:
    """Horizontal bars; ``full`` is the value of the whole width, by default the largest value."""
    full = full or max((bar.value for bar in bars), default=0) or 1
    lines = []
    for bar in bars:
        width = max(0.0, min(100.0, 100 * bar.value / full))
        name = escape(words(bar.name))
        name = f"<b>{name}</b>" if bar.strong else name
        kind = "track strong" if bar.strong else "track"
        lines.append(
            f'<span>{name}</span><span class="{kind}">'
            f'<span class="fill" style="width:{width:.2f}%"></span></span>'
            f'<span class="value">{escape(bar.text)}</span>'
        )
    return f'<div class="bars">{"".join(lines)}</div>'


def part_bars(parts: dict[str, float], unit: str) -> str:
    """Parts of a whole, largest first, each with its amount and share."""
    total = math.fsum(parts.values()) or 1
    ordered = sorted(parts.items(), key=lambda part: -part[1])
    return bar_chart(
        [
            Bar(name, value, f"{scaled(value, unit)} · {percent(value / total)}")
            for name, value in ordered
        ]
    )


_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP = 560, 190, 62, 34, 10


def column_chart(values: Sequence[float], labels: Sequence[str], unit: str, x_title: str) -> str:
    """Columns over time as SVG, with a scale from zero to a round number."""
    top = _round_up(max(values, default=0))
    inner_width, inner_height = _WIDTH - _LEFT - 4, _HEIGHT - _BOTTOM - _TOP
    base = _TOP + inner_height
    parts = [f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(x_title)}">']
    for step in range(5):
        y = _TOP + inner_height * (1 - step / 4)
        parts.append(f'<line x1="{_LEFT}" x2="{_WIDTH - 4}" y1="{y:.1f}" y2="{y:.1f}"/>')
        text = escape(scaled(top * step / 4, unit, short=True))
        parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{text}</text>')
    pitch = inner_width / max(1, len(values))
    width = min(46.0, 0.72 * pitch)
    every = math.ceil(len(values) * 34 / inner_width) or 1
    for index, (value, label) in enumerate(zip(values, labels, strict=True)):
        middle = _LEFT + (index + 0.5) * pitch
        height = inner_height * value / top
        hover = f"<title>{escape(label)}: {escape(scaled(value, unit))}</title>"
        parts.append(
            f'<rect x="{middle - width / 2:.1f}" y="{base - height:.1f}" '
            f'width="{width:.1f}" height="{height:.1f}">{hover}</rect>'
        )
        if index % every == 0:
            text = f'<text x="{middle:.1f}" y="{base + 14}" text-anchor="middle">'
            parts.append(f"{text}{escape(label)}</text>")
    middle = _LEFT + inner_width / 2
    title = (
        f'<text x="{middle:.1f}" y="{_HEIGHT - 4}" text-anchor="middle">{escape(x_title)}</text>'
    )
    return "".join(parts) + title + "</svg>"


def _round_up(value: float) -> float:
    """The next of 1, 2, 4, 6, 8, 10 times a power of ten; 1 for nothing."""
    if value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1, 2, 4, 6, 8, 10) if value <= step * power * (1 + 1e-9))
