"""What came out: accelerator, streaming, stereo and image quality, as sections of the page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from nebula.report.blocks import card, decibel, pairs, table
from nebula.report.charts import (
    Bar,
    bar_chart,
    column_chart,
    exact,
    part_bars,
    percent,
    scaled,
    significant,
)


def accelerator(report: Mapping[str, Any]) -> str:
    timing, energy, area = report["timing"], report["energy"], report["area"]
    units = [
        Bar(
            name,
            timing["utilisation"].get(name, 0.0),
            f"{scaled(cycles, 'cycles')} · {percent(timing['utilisation'].get(name, 0.0))}",
            strong=name == timing["bound_by"],
        )
        for name, cycles in timing["cycles"].items()
    ]
    energy_parts = {**energy["parts"], "radio": energy["radio"]["mj_per_frame"]}
    scaling = area["scaled"]
    area_text = (
        f"{significant(area['total_mm2'])} mm² at {area['node_nm']:g} nm by {area['technology']} "
        f"({significant(area['low_mm2'])} to {significant(area['high_mm2'])} by other models); "
        f"at {scaling['node_nm']:g} nm {significant(scaling['total_mm2'])} mm² "
        f"({significant(scaling['low_mm2'])} to {significant(scaling['high_mm2'])})"
    )
    energy_text = (
        f"{significant(energy['total_mj_per_frame'])} mJ per frame, chip at "
        f"{energy['node_nm']:g} nm by {energy['technology']} "
        f"({significant(energy['low_mj_per_frame'])} to "
        f"{significant(energy['high_mj_per_frame'])} by other models)"
    )
    cards = [
        card(
            "Cycles per unit",
            f"until the slowest instance is done, and busy share of all instances; the frame takes "
            f"{scaled(timing['cycles_per_frame'], 'cycles')} at {timing['clock_ghz']:g} GHz",
            bar_chart(units, full=1.0),
        ),
        card(
            "Energy by part",
            energy_text,
            part_bars(energy_parts, "mJ"),
        ),
        card(
            "DRAM traffic by stream",
            f"{scaled(timing['dram_bytes_per_frame'], 'B')} per frame",
            part_bars(timing["dram_bytes"], "B"),
        ),
        card("Area by part", area_text, part_bars(area["parts"], "mm²")),
    ]
    return f'<h2>Accelerator</h2><div class="grid">{"".join(cards)}</div>'


def streaming(report: Mapping[str, Any]) -> str:
    stream, lod, frames = report["stream"], report["lod"], report["frames"]
    every = lod["search_every_frames"]
    updates = stream["message_bytes"][1:]
    overlap = lod["overlap_mean"]
    cards = [
        card(
            "Bytes per Δcut message",
            f"after the first of {scaled(stream['initial_bytes'], 'B')}; mean "
            f"{significant(stream['mbps_mean'])} Mbps over the trace",
            column_chart(
                updates, [str((i + 1) * every) for i in range(len(updates))], "B", "frame"
            ),
        ),
        card(
            "Cut size per search",
            "" if overlap is None else f"{percent(overlap)} of a cut was in the cut before",
            column_chart(
                lod["cut_sizes"],
                [str(i * every) for i in range(len(lod["cut_sizes"]))],
                "",
                "frame",
            ),
        ),
        card(
            "Tree, search and link",
            f"search method {lod['method']}, times measured here on the CPU",
            pairs(
                [
                    ("leaves", exact(report["scene"]["leaves"])),
                    ("nodes", exact(lod["nodes"])),
                    ("levels", exact(lod["levels"])),
                    ("cut, mean", scaled(lod["cut_size_mean"], "nodes")),
                    ("nodes tested per search", scaled(lod["nodes_visited_mean"], "nodes")),
                    ("search", f"{significant(lod['search_ms_mean'])} ms"),
                    ("building the tree", f"{significant(lod['build_ms'])} ms"),
                    ("link", f"{significant(stream['link_mbps'])} Mbps"),
                    ("latency", f"{significant(stream['latency_ms'])} ms"),
                    ("first picture complete after", f"{significant(stream['initial_ms'])} ms"),
                    ("nodes held by the client, most", exact(stream["held_nodes_max"])),
                    *_pacing(stream["pacing"]),
                ]
            ),
        ),
        card(
            "Cycles per frame",
            f"mean {scaled(report['timing']['cycles_per_frame'], 'cycles')}, both eyes",
            column_chart(
                [f["cycles"] for f in frames], [str(f["index"]) for f in frames], "", "frame"
            ),
        ),
    ]
    return f'<h2>Level of detail and streaming</h2><div class="grid">{"".join(cards)}</div>'


def _pacing(pacing: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What a byte budget did; nothing without one."""
    if not pacing:
        return []
    behind = sum(nodes > 0 for nodes in pacing["pending_nodes"])
    return [
        ("byte budget of a message", scaled(pacing["budget_bytes"], "B")),
        ("messages that left something pending", exact(behind)),
        ("nodes pending, most", exact(max(pacing["pending_nodes"]))),
    ]


def stereo_and_quality(report: Mapping[str, Any]) -> str:
    stereo, quality = report["stereo"], report["quality"]
    both = [
        ("visible splats", stereo["visible_splats"], lambda v: scaled(v, "")),
        ("covered pixels", stereo["covered_pixels_share"], percent),
        ("list entries", stereo["list_entries"], lambda v: scaled(v, "")),
    ]
    eyes = [[name, show(v["left"]), show(v["right"])] for name, v, show in both]
    counters = pairs(
        [
            ("mismatching pixels, float32", exact(stereo["right_mismatching_pixels"])),
            ("mismatching pixels, 8 bit", exact(stereo["right_mismatching_pixels_8bit"])),
            ("PSNR of the right eye", decibel(stereo["psnr_db"])),
            ("forward-only entries", scaled(stereo["forward_only_entries"], "")),
            ("entries walked after termination", scaled(stereo["entries_after_termination"], "")),
            ("row writes per entry", significant(stereo["row_writes_per_entry"])),
            ("forwards dropped", scaled(stereo["dropped"], "")),
            ("duplicates at the merge unit", scaled(stereo["duplicates"], "")),
        ]
    )
    groups = {
        "decoded_vs_cut": "decoded stream vs. the same cut uncoded (codec loss)",
        "cut_vs_leaves": "uncoded cut vs. all leaves (level-of-detail loss)",
        "decoded_vs_leaves": "decoded stream vs. all leaves (both)",
    }
    rows = [
        [text, decibel(quality[key]["psnr_db"]), _ssim(quality[key]["ssim"])]
        for key, text in groups.items()
    ]
    compared = ", ".join(str(frame) for frame in quality["frames"])
    cards = [
        card(f"Stereo method: {stereo['method']}", stereo["description"], counters),
        card(
            "Image quality and coverage",
            f"quality of the left eye, mean over frames {compared}; coverage per frame, mean",
            table(["", "PSNR", "SSIM"], rows) + table(["", "left eye", "right eye"], eyes),
        ),
    ]
    return f'<h2>Stereo and image quality</h2><div class="grid">{"".join(cards)}</div>'


def _ssim(value: float | None) -> str:
    return "not measured" if value is None else significant(value, 4)
