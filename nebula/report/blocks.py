"""Boxes and tables of the report page, as HTML; every text is escaped here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from nebula.report.charts import significant, words


def decibel(value: float | None) -> str:
    return "identical" if value is None else f"{significant(value)} dB"


def card(title: str, sub: str, content: str) -> str:
    """One box; ``sub`` is plain text, ``content`` HTML."""
    return (
        f'<div class="card"><h3>{escape(title)}</h3><p class="sub">{escape(sub)}</p>{content}</div>'
    )


def pairs(rows: Sequence[tuple[str, str]]) -> str:
    """A table of names and values, plain text both."""
    lines = (
        f'<tr><td class="name">{escape(words(name))}</td><td>{escape(value)}</td></tr>'
        for name, value in rows
    )
    return f'<table class="pairs">{"".join(lines)}</table>'


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], numbers: bool = True) -> str:
    """A table of plain text; with ``numbers`` every column after the first is right-aligned."""

    def line(tag: str, cells: Sequence[str]) -> str:
        mark = ' class="number"' if numbers else ""
        cell = (f"<{tag}{mark if i else ''}>{escape(text)}</{tag}>" for i, text in enumerate(cells))
        return f"<tr>{''.join(cell)}</tr>"

    body = "".join(line("td", row) for row in rows)
    return f'<div class="scroll"><table>{line("th", heads)}{body}</table></div>'


def plain(value: Any) -> str:
    """Any JSON value as text."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(plain(item) for item in value)
    if isinstance(value, Mapping):
        return "; ".join(f"{key} {plain(item)}" for key, item in value.items())
    return str(value)


def tile(name: str, value: str, unit: str, note: str, mood: str = "") -> str:
    return (
        f'<div class="tile"><div class="name">{escape(name)}</div>'
        f'<div class="value {mood}">{escape(value)} <small>{escape(unit)}</small></div>'
        f'<div class="note">{escape(note)}</div></div>'
    )
