"""From the records of a run to the groups of report.json (keys: docs/report.md)."""

from __future__ import annotations

import dataclasses
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from arch import AreaReport, EnergyReport, sourced_groups
from gaussians.stereo_method import StereoMethod
from lod_cloud import Link, LodTree, PaperCodec
from nebula.measure import FrameRecord, Hardware
from nebula.session import Session, StartUp
from nebula.session_config import SessionConfig

EYES = ("left", "right")
PAPER_RATE_MBPS = 100.0


def mean(values: Iterable[float]) -> float:
    """Arithmetic mean; the values in a fixed order, summed exactly."""
    numbers = [float(v) for v in values]
    return math.fsum(numbers) / len(numbers)


def by_eye(pairs: Sequence[tuple[float, float]]) -> dict[str, float]:
    """Mean over the frames, per eye."""
    return {eye: mean(pair[i] for pair in pairs) for i, eye in enumerate(EYES)}


def lod(tree: LodTree, session: Session, tau_px: float, build_ms: float) -> dict[str, Any]:
    """Tree and searches."""
    searches = session.searches
    overlaps = [1.0 - s.found / s.cut_size for s in searches[1:]]
    return {
        "nodes": len(tree),
        "levels": tree.levels,
        "tau_px": tau_px,
        "method": session.method,
        "search_every_frames": session.cloud.table.frames_per_search,
        "cut_sizes": [s.cut_size for s in searches],
        "cut_size_mean": mean(s.cut_size for s in searches),
        "overlap_mean": mean(overlaps) if overlaps else None,
        "build_ms": build_ms,
        "search_ms": session.search_ms,
        "search_ms_mean": mean(session.search_ms),
        "nodes_visited_mean": mean(s.nodes_tested for s in searches),
    }


def stream(
    session: Session, start: StartUp, link: Link, records: Sequence[FrameRecord], rate_hz: float
) -> dict[str, Any]:
    """Messages and link. The rate is that of the messages sent, over the duration of the trace."""
    later = session.searches[1:]
    duration_s = len(records) / rate_hz
    window = session.cloud.table.reuse_window_frames
    return {
        "codec": "paper: 16-bit fixed point, vector-quantised harmonics, zstd",
        "link_mbps": link.rate_mbps,
        "latency_ms": link.latency_ms,
        "mbps_mean": sum(s.message_bytes for s in later) * 8e-6 / duration_s,
        "message_bytes": [s.message_bytes for s in session.searches],
        "initial_bytes": start.initial_bytes,
        "codebook_bytes": start.codebook_bytes,
        "initial_ms": start.initial_ms,
        "held_nodes_max": max(r.held_splats for r in records),
        "reuse_window_searches": window // session.cloud.table.frames_per_search,
        "pacing": _pacing(session),
    }


def _pacing(session: Session) -> dict[str, Any]:
    """What the byte budget did to each message; nothing without one."""
    if session.budget_bytes is None:
        return {}
    searches = session.searches
    errors = [s.pending_error_px for s in searches]
    return {
        "budget_bytes": session.budget_bytes,
        "pending_nodes": [s.pending for s in searches],
        "pending_error_px": [error if math.isfinite(error) else None for error in errors],
        "pending_harmonics": [s.pending_harmonics for s in searches],
        "deferred_bytes": [s.deferred_bytes for s in searches],
        "tau_px": [s.tau_px for s in searches],
    }


def stereo(method: StereoMethod, pixels: int, records: Sequence[FrameRecord]) -> dict[str, Any]:
    """The right eye against an independently rendered one, and what making it took."""
    error = mean(r.squared_error for r in records)
    entries = by_eye([r.list_entries for r in records])
    writes = mean(r.row_writes for r in records)
    return {
        "method": method.name,
        "description": str(method),
        "right_mismatching_pixels": sum(r.mismatching for r in records),
        "right_mismatching_pixels_8bit": sum(r.mismatching_8bit for r in records),
        "pixels": pixels * len(records),
        "psnr_db": -10.0 * math.log10(error) if error > 0 else None,
        "visible_splats": by_eye([r.visible for r in records]),
        "covered_pixels_share": by_eye([r.covered for r in records]),
        "list_entries": entries,
        "forward_only_entries": mean(r.forward_only for r in records),
        "entries_after_termination": mean(r.after_termination for r in records),
        "row_writes_per_entry": writes / entries["left"] if entries["left"] else 0.0,
        "dropped": mean(r.dropped for r in records),
        "duplicates": mean(r.duplicates for r in records),
    }


def timing(hardware: Hardware, records: Sequence[FrameRecord]) -> dict[str, Any]:
    """Means over the frames; the rate is that of the mean frame."""
    timings = [r.analysis.timing for r in records]
    cycles = mean(t.cycles_per_frame for t in timings)
    units = [unit.name for unit in timings[0].units]
    unit_cycles = {name: mean(t.units[i].cycles for t in timings) for i, name in enumerate(units)}
    streams: defaultdict[str, list[int]] = defaultdict(list)
    for t in timings:
        for s in t.dram:
            streams[s.name].append(s.read_bytes + s.write_bytes)
    dram_bytes = {name: math.fsum(b) / len(timings) for name, b in streams.items() if any(b)}
    clock_ghz = hardware.config.clock.frequency_ghz
    return {
        "accelerator": hardware.config.name,
        "fidelity": timings[0].fidelity,
        "clock_ghz": clock_ghz,
        "cycles_per_frame": cycles,
        "fps": clock_ghz * 1e9 / cycles,
        "bound_by": max(unit_cycles, key=lambda name: unit_cycles[name]),
        "cycles": unit_cycles,
        "utilisation": {
            name: mean(t.units[i].utilisation for t in timings) for i, name in enumerate(units)
        },
        "dram_bytes": dram_bytes,
        "dram_bytes_per_frame": math.fsum(dram_bytes.values()),
    }


def energy(
    records: Sequence[FrameRecord], start: StartUp, link: Link, fps: float
) -> dict[str, Any]:
    """Mean energy per frame, by component; static power under its own name."""
    parts = _mean_parts([r.energy for r in records])
    radio = mean(r.energy.radio_mj_per_frame for r in records)
    total = math.fsum([*parts.values(), radio])
    return {
        "total_mj_per_frame": total,
        "parts": parts,
        "radio": {
            "mj_per_frame": radio,
            "initial_mj": link.energy_mj(start.codebook_bytes + start.initial_bytes),
            "nj_per_byte": link.energy_nj_per_byte,
        },
        "power_mw": total * fps,
        "node_nm": records[0].energy.node_nm,
        "technology": records[0].energy.model,
        "low_mj_per_frame": mean(r.energy.band_mj_per_frame[0] for r in records),
        "high_mj_per_frame": mean(r.energy.band_mj_per_frame[1] for r in records),
    }


def _mean_parts(reports: Sequence[EnergyReport]) -> dict[str, float]:
    collected: defaultdict[str, list[float]] = defaultdict(list)
    for report in reports:
        for part in report.parts:
            if part.component != "radio":
                static = "_static" if part.kind == "static" else ""
                collected[part.component + static].append(part.value_mj)
    return {name: math.fsum(values) / len(reports) for name, values in collected.items()}


def area(at_synthesis: AreaReport, scaled: AreaReport) -> dict[str, Any]:
    """Parts at the synthesis node, total also at the scaled one."""
    low, high = scaled.band_mm2
    return {
        "total_mm2": at_synthesis.total_mm2,
        "node_nm": at_synthesis.node_nm,
        "technology": at_synthesis.model,
        "low_mm2": at_synthesis.band_mm2[0],
        "high_mm2": at_synthesis.band_mm2[1],
        "parts": {part.name: part.mm2 for part in at_synthesis.parts},
        "scaled": {
            "node_nm": scaled.node_nm,
            "total_mm2": scaled.total_mm2,
            "low_mm2": low,
            "high_mm2": high,
        },
    }


def frames(records: Sequence[FrameRecord]) -> list[dict[str, Any]]:
    """One group per frame."""
    return [
        {
            "index": r.index,
            "time_s": r.time_s,
            "eye_m": list(r.eye_m),
            "searched": r.searched,
            "message_bytes": r.received_bytes,
            "drawn_splats": r.drawn_splats,
            "visible_splats": dict(zip(EYES, r.visible, strict=True)),
            "covered_pixels_share": dict(zip(EYES, r.covered, strict=True)),
            "right_mismatching_pixels": r.mismatching,
            "right_mismatching_pixels_8bit": r.mismatching_8bit,
            "cycles": r.analysis.timing.cycles_per_frame,
            "fps": r.analysis.timing.fps,
            "bound_by": r.analysis.timing.bound_by,
            "dram_bytes": r.analysis.timing.dram_bytes,
            "energy_mj": r.energy.total_mj_per_frame - r.energy.radio_mj_per_frame,
        }
        for r in records
    ]


def sources(hardware: Hardware, session: SessionConfig, link: Link) -> list[dict[str, Any]]:
    """Every number the result rests on, group by group, with where it comes from."""
    configs: Mapping[str, object] = {
        "accelerator": hardware.config,
        "costs": hardware.costs,
        "scaling": hardware.technology,
        "session": session,
    }
    rows = [
        {
            "name": f"{name}.{group.path}",
            "value": group.values,
            "unit": "",
            **{key: getattr(group, key) for key in ("source", "reference", "confidence")},
        }
        for name, config in configs.items()
        for group in sourced_groups(config)
    ]
    given = {"source": "assumption", "reference": "given on the command line", "confidence": "M"}
    paper = {"source": "paper", "reference": "Sec. 6", "confidence": "A"}
    silent = {**given, "reference": "one way, a wireless link at home; the paper gives no value"}
    rate = {"name": "link.rate", "value": link.rate_mbps, "unit": "Mbps"}
    latency = {"name": "link.latency", "value": link.latency_ms, "unit": "ms"}
    rows.append({**rate, **(paper if link.rate_mbps == PAPER_RATE_MBPS else given)})
    rows.append({**latency, **silent})
    return rows


def codec_note(codec: PaperCodec, session: Session) -> str:
    """How many nodes left the fixed-point ranges and travelled as float32."""
    escapes = sum(s.escapes for s in session.searches)
    payloads = sum(s.payloads for s in session.searches)
    words = [len(book) for book in codec.codebook.stages] if codec.codebook else []
    trained = (
        f"codebooks of {words} words trained on this tree" if words else "no harmonics to code"
    )
    return f"Codec: {trained}; {escapes} of {payloads} payloads were sent as plain float32."


def plain(value: object) -> Any:
    """A dataclass as plain groups, paths as text."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    return value if isinstance(value, (int, float, str, bool, type(None))) else str(value)
