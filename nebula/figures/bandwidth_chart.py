"""How the figure of quality against Mbps is drawn and tabulated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nebula.output import text_table

_MARKERS = {"video": "o", "stream": "*"}
_LEAST_MBPS = 1e-3  # drawn for a stream that has nothing to send


def table(rows: Sequence[dict[str, Any]]) -> str:
    """For the terminal."""
    heads = ["trace", "coding", "Mbps", "first kB", "PSNR dB, cut", "all leaves", "x stream"]
    lines = []
    for row in rows:
        ratios = [value for key, value in row.items() if key.startswith("times_the_")]
        shown = [f"{ratio:.1f}" for ratio in ratios if ratio is not None]
        lines.append(
            [
                row["trace"],
                row["coding"],
                f"{row['mbps']:.2f}",
                f"{row['first_bytes'] / 1e3:.1f}",
                _psnr(row["psnr_vs_cut_db"]),
                _psnr(row["psnr_vs_leaves_db"]) if row["leaves_rendered"] else "not rendered",
                " / ".join(shown),
            ]
        )
    return text_table(heads, lines, range(2, len(heads)))


def draw(canvas: Any, rows: Sequence[dict[str, Any]]) -> None:
    """One panel per motion; what loses nothing stands in the hatched band at the upper edge."""
    traces = list(dict.fromkeys(row["trace"] for row in rows))
    canvas.set_size_inches(max(10.0, 2.0 + 4.2 * len(traces)), 5.8)
    panels = canvas.subplots(1, len(traces), sharey=True, squeeze=False)[0]
    finite = [row["psnr_vs_cut_db"] for row in rows if row["psnr_vs_cut_db"] is not None]
    low, band = min(finite) - 2, max(finite) + 2
    for axes, trace in zip(panels, traces, strict=True):
        own = [row for row in rows if row["trace"] == trace]
        for number, row in enumerate(own):
            psnr = row["psnr_vs_cut_db"]
            axes.plot(
                max(row["mbps"], _LEAST_MBPS),
                band + 1.5 if psnr is None else psnr,
                _MARKERS[row["side"]],
                color=f"C{number}",
                markersize=9 if row["side"] == "video" else 13,
                label=row["coding"],
                linestyle="none",
            )
        axes.axhspan(band, band + 3, facecolor="none", edgecolor="0.8", hatch="//")
        axes.text(0.02, 0.98, "no loss", transform=axes.transAxes, va="top", fontsize=8)
        rates = [max(row["mbps"], _LEAST_MBPS) for row in own]
        axes.set_xscale("log")
        axes.set_xlim(min(rates) / 2, max(rates) * 2)
        axes.set_ylim(low, band + 3)
        axes.set_title(f"{trace}, {own[0]['speed_m_s']:.2f} m/s", fontsize=10)
        axes.set_xlabel("Mbps, 90 Hz, both eyes, without the first frame")
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("PSNR against the uncoded cut, dB")
    sizes = f"video: {rows[0]['pictures']} per eye; stream: LoD for {rows[0]['display']}"
    canvas.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, title=sizes
    )


def _psnr(value: float | None) -> str:
    return "identical" if value is None else f"{value:.1f}"
