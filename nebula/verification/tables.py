"""The rows of ``nebula verify`` as a table for the terminal, as Markdown and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

from gaussians.attribution import LABELS
from nebula.output import text_table

Row = Mapping[str, Any]

_SHOWN_CAUSES = 3
_HEADS = (
    *("method", "differ", "in 8 bit", "PSNR dB", "SSIM", "FLIP", "inserted M", "forward-only M"),
    *("past termination M", "writes per entry", "processed left M", "right M", "checks M"),
    "causes, share of the pixels that differ in 8 bit",
)


def terminal_table(rows: Sequence[Row]) -> str:
    """The columns that matter most."""
    heads = ("", "differ", "in 8 bit", "PSNR dB", "inserted", "checks", "main cause")
    several = len({row["scene"] for row in rows}) > 1
    lines = [
        (
            f"{row['scene']}: {row['method']}" if several else row["method"],
            _share(row, "mismatching_pixels"),
            _share(row, "mismatching_pixels_8bit"),
            _psnr(row),
            f"{row['inserted'] / 1e6:.2f} M",
            f"{row['alpha_checks'] / 1e6:.1f} M",
            _causes(row, 1),
        )
        for row in rows
    ]
    return text_table(heads, lines, (1, 2, 3, 4, 5))


def markdown_table(rows: Sequence[Row]) -> str:
    """All columns but descriptions, counts in millions."""
    lines = [_HEADS, tuple("---" for _ in _HEADS)]
    lines += [
        (
            row["method"],
            _share(row, "mismatching_pixels"),
            _share(row, "mismatching_pixels_8bit"),
            _psnr(row),
            _number(row["ssim"], ".5f"),
            _number(row["flip"], ".5f"),
            *(f"{row[key] / 1e6:.2f}" for key in ("inserted", "forward_only")),
            f"{row['entries_after_termination'] / 1e6:.2f}",
            f"{row['row_writes_per_entry']:.2f}",
            *(f"{row[key] / 1e6:.2f}" for key in ("processed_left", "processed_right")),
            f"{row['alpha_checks'] / 1e6:.0f}",
            _causes(row, _SHOWN_CAUSES),
        )
        for row in rows
    ]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def hostile_markdown(rows: Sequence[Row]) -> str:
    """One line per hostile scene: what `paper` loses there, and that `exact` does not."""
    heads = ("scene", "what is hard there", "`paper`: differ", "in 8 bit", "PSNR dB", "causes")
    lines = [(*heads, "`exact`: differ"), tuple("---" for _ in range(len(heads) + 1))]
    by_method = {(row["scene"], row["method"]): row for row in rows}
    for row in rows:
        if row["method"] == "paper":
            exact = by_method[row["scene"], "exact"]
            lines.append(
                (
                    f"`{row['scene']}`",
                    row["breaks"],
                    _share(row, "mismatching_pixels"),
                    _share(row, "mismatching_pixels_8bit"),
                    _psnr(row),
                    _causes(row, _SHOWN_CAUSES),
                    _share(exact, "mismatching_pixels"),
                )
            )
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def csv_table(rows: Sequence[Row]) -> str:
    """One line per row; a cause's pixels, in float32 and in 8 bit, in columns of their own."""
    plain = [key for key in rows[0] if key != "causes"]
    labels = [label for label in LABELS if any(label in row["causes"] for row in rows)]
    causes = [(label, unit) for label in labels for unit in ("pixels", "pixels_8bit")]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([*plain, *(f"{label}_{unit}" for label, unit in causes)])
    for row in rows:
        counts = [row["causes"].get(label, {}).get(unit, 0) for label, unit in causes]
        writer.writerow([*(row[key] for key in plain), *counts])
    return stream.getvalue()


def _share(row: Row, key: str) -> str:
    return f"{row[key] / row['pixels']:.3%}" if row[key] else "0"


def _psnr(row: Row) -> str:
    if row["psnr_db"] is not None:
        return f"{row['psnr_db']:.1f}"
    return "clipped away" if row["mismatching_pixels"] else "identical"


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _causes(row: Row, most: int) -> str:
    """The largest labels with their share of the pixels wrong in 8 bit, else in float32."""
    unit = "pixels_8bit" if row["mismatching_pixels_8bit"] else "pixels"
    counts = {name: count[unit] for name, count in row["causes"].items() if count[unit]}
    total = sum(counts.values())
    largest = sorted(counts, key=lambda name: -counts[name])[:most]
    if most == 1:
        return largest[0] if largest else ""
    return ", ".join(f"{name} {counts[name] / total:.1%}" for name in largest)
