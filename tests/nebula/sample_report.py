"""A complete report with plausible numbers, for tests of the schema and the page."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

PIXELS = 1024 * 1024
FRAMES = 12
UNITS = {
    "decoder": 412_300.0,
    "subgraph_unit": 288_100.0,
    "projection_unit": 3_120_000.0,
    "binning_unit": 6_540_000.0,
    "sorting_unit": 4_410_000.0,
    "volume_rendering_core": 9_870_000.0,
    "stereo_reprojection_unit": 5_230_000.0,
    "stereo_buffer": 3_050_000.0,
    "merge_unit": 4_980_000.0,
    "dram": 14_260_000.0,
}
DRAM = {
    "splat_records": 141_000_000.0,
    "tile_lists": 28_400_000.0,
    "sort_keys": 9_310_000.0,
    "frame_buffer": 6_290_000.0,
    "display": 6_290_000.0,
}
ENERGY = {
    "dram": 17.9,
    "volume_rendering_core": 6.42,
    "global_buffer": 2.13,
    "sorting_unit": 1.07,
    "projection_unit": 0.913,
    "leakage": 0.702,
    "stereo_buffer": 0.288,
    "stereo_reprojection_unit": 0.0914,
    "merge_unit": 0.0702,
    "decoder": 0.0133,
}
AREA = {
    "volume_rendering_core": 0.962,
    "global_buffer": 0.412,
    "projection_unit": 0.211,
    "sorting_unit": 0.148,
    "stereo_buffer": 0.201,
    "decoder": 0.0612,
    "stereo_reprojection_unit": 0.0203,
    "merge_unit": 0.0117,
}


def sample_report() -> dict[str, Any]:
    """A fresh report of method `exact` on the generated city; JSON types only."""
    report = {
        "schema_version": 1,
        **_provenance(),
        **_scene(),
        **_stereo(),
        **_hardware(),
        "quality": {
            "frames": [0, 6, 11],
            "decoded_vs_cut": {"psnr_db": 45.318, "ssim": 0.99412},
            "cut_vs_leaves": {"psnr_db": 36.902, "ssim": 0.97155},
            "decoded_vs_leaves": {"psnr_db": 36.214, "ssim": 0.96901},
        },
        "frames": [_frame(index) for index in range(FRAMES)],
        "sources": _sources(),
        "notes": [
            "Cycles are the bounds of an analytic model: the slowest stage counts, queues and bank "
            "conflicts do not.",
            "Costs marked M are judgements; they carry 31 % of the energy.",
            "The quality of the default city says nothing about captured scenes.",
        ],
    }
    plain: dict[str, Any] = json.loads(json.dumps(report))
    return plain


def _provenance() -> dict[str, Any]:
    return {
        "provenance": {
            "version": "0.1.0",
            "commit": "21d7992c4bb1a6c95f2e0c1f6a4b97d1f1c0a2de",
            "command": "nebula simulate --out out/demo",
            "started_utc": "2026-01-31T12:00:00Z",
            "wall_s": 41.3,
            "stage_wall_s": {"scene": 6.1, "tree": 3.4, "frames": 24.9, "quality": 4.6},
            "machine": {
                "platform": "Linux x86_64",
                "processor": "Example CPU @ 2.60 GHz",
                "cores": 2,
                "threads": 2,
                "packages": {"python": "3.11.7", "numpy": "2.4.6", "numba": "0.68.1"},
            },
            "seed": 0,
            "placement": {
                "up": "+z",
                "units_per_metre": 1.0,
                "view": [[2.0, -30.0, 1.7], [2.0, 0.0, 1.7]],
                "near_m": 0.2,
                "level": 0,
                "trace": "walk",
            },
            "display": {
                "width": 1024,
                "height": 1024,
                "fx": 461.0,
                "fy": 461.0,
                "cx_left": 512.0,
                "cx_right": 512.0,
                "cy": 512.0,
            },
            "options": {"tau_px": 6.0, "baseline_m": 0.06},
            "inputs": [{"name": "walk <b>.csv", "bytes": 1_352_211, "sha256": "5f" * 32}],
        }
    }


def _scene() -> dict[str, Any]:
    updates = [61_210, 58_934]
    return {
        "scene": {
            "name": "city 300000 leaves, seed 0",
            "origin": "generated",
            "leaves": 300_000,
            "sh_degree": 3,
            "bounds_min_m": [-60.0, -60.0, -0.2],
            "bounds_max_m": [60.0, 60.0, 31.4],
        },
        "lod": {
            "nodes": 451_336,
            "levels": 17,
            "tau_px": 6.0,
            "method": "flat",
            "search_every_frames": 4,
            "cut_sizes": [88_412, 88_790, 89_127],
            "cut_size_mean": 88_776.3,
            "overlap_mean": 0.9871,
            "build_ms": 612.4,
            "search_ms": [2.61, 2.48, 2.52],
            "search_ms_mean": 2.54,
            "nodes_visited_mean": 451_336.0,
        },
        "stream": {
            "codec": "paper",
            "link_mbps": 100.0,
            "latency_ms": 20.0,
            "mbps_mean": 9.0,
            "message_bytes": [2_811_404, *updates],
            "initial_bytes": 2_811_404,
            "codebook_bytes": 737_280,
            "initial_ms": 303.9,
            "held_nodes_max": 92_004,
            "reuse_window_searches": 32,
            "pacing": {
                "budget_bytes": 555_555,
                "pending_nodes": [4000, 12, 0],
                "pending_error_px": [None, 6.5, 0.0],
                "pending_harmonics": [0, 0, 0],
                "deferred_bytes": [64_000, 192, 0],
                "tau_px": [30.0, 6.0, 6.0],
            },
        },
    }


def _stereo() -> dict[str, Any]:
    return {
        "stereo": {
            "method": "exact",
            "description": "carrier rule, 4 rows, own conic, colour and centre per eye",
            "right_mismatching_pixels": 0,
            "right_mismatching_pixels_8bit": 0,
            "pixels": FRAMES * PIXELS,
            "psnr_db": None,
            "visible_splats": {"left": 61_402.5, "right": 61_377.2},
            "covered_pixels_share": {"left": 0.8134, "right": 0.8131},
            "list_entries": {"left": 3_914_022.1, "right": 3_911_840.7},
            "forward_only_entries": 251_913.4,
            "entries_after_termination": 402_817.9,
            "row_writes_per_entry": 1.0713,
            "dropped": 0,
            "duplicates": 0,
        }
    }


def _hardware() -> dict[str, Any]:
    cycles = max(UNITS.values())
    radio = 100e-9 * 1e3 * (61_210 + 58_934) / FRAMES
    total = sum(ENERGY.values()) + radio
    return {
        "timing": {
            "accelerator": "nebula",
            "fidelity": "analytic",
            "clock_ghz": 1.0,
            "cycles_per_frame": cycles,
            "fps": 1e9 / cycles,
            "bound_by": "dram",
            "cycles": UNITS,
            "utilisation": {name: busy / cycles for name, busy in UNITS.items()},
            "dram_bytes": DRAM,
            "dram_bytes_per_frame": sum(DRAM.values()),
        },
        "energy": {
            "total_mj_per_frame": total,
            "parts": ENERGY,
            "radio": {"mj_per_frame": radio, "nj_per_byte": 100.0, "initial_mj": 354.9},
            "power_mw": total * 1e9 / cycles,
            "node_nm": 8.0,
            "technology": "deepscaletool",
            "low_mj_per_frame": 29.8,
            "high_mj_per_frame": 33.1,
        },
        "area": {
            "total_mm2": sum(AREA.values()),
            "node_nm": 16.0,
            "technology": "deepscaletool",
            "low_mm2": 1.77,
            "high_mm2": 2.41,
            "parts": AREA,
            "scaled": {
                "node_nm": 8.0,
                "total_mm2": 0.641,
                "low_mm2": 0.507,
                "high_mm2": 0.812,
            },
        },
    }


def _frame(index: int) -> dict[str, Any]:
    cycles = max(UNITS.values()) * (1 + 0.02 * np.sin(index).item())
    message = {0: 2_811_404, 4: 61_210, 8: 58_934}.get(index, 0)
    return {
        "index": index,
        "time_s": index / 90,
        "eye_m": [2.0, -30.0 + 0.0155 * index, 1.7],
        "searched": index % 4 == 0,
        "message_bytes": message,
        "drawn_splats": 88_000 + 70 * index,
        "visible_splats": {"left": 61_000 + 67 * index, "right": 60_980 + 66 * index},
        "covered_pixels_share": {"left": 0.81 + 0.0005 * index, "right": 0.81 + 0.0004 * index},
        "right_mismatching_pixels": 0,
        "right_mismatching_pixels_8bit": 0,
        "cycles": cycles,
        "fps": 1e9 / cycles,
        "bound_by": "dram",
        "dram_bytes": sum(DRAM.values()),
        "energy_mj": sum(ENERGY.values()),
    }


def _sources() -> list[dict[str, Any]]:
    rows = (
        ("volume_rendering_core.count", 8, "", "paper", "NEBULA Sec. 6", "A"),
        ("dram.read", 15.2, "pJ/bit", "datasheet", "LPDDR3-1600, IDD currents by state", "B"),
        ("radio", 100.0, "nJ/B", "paper", "NEBULA Sec. 6", "A"),
        (
            "sorting_unit.timing",
            "keys_per_cycle 4, latency_cycles 12",
            "",
            "assumption",
            "none",
            "M",
        ),
        ("node scaling 16 to 8 nm", 0.316, "", "literature", "doi:10.1109/ISCAS.2019.8702105", "C"),
    )
    keys = ("name", "value", "unit", "source", "reference", "confidence")
    return [dict(zip(keys, row, strict=True)) for row in rows]


def sample_png(shift: int = 0) -> bytes:
    """A small street-like picture as PNG bytes."""
    rows, columns = np.mgrid[0:256, 0:256].astype(np.float32)
    towers = ((columns.astype(int) + shift) // 32 * 37 % 97)[None, 128]
    sky = rows < 90 + towers
    image: NDArray[np.float32] = np.empty((256, 256, 3), np.float32)
    image[...] = np.where(sky[..., None], (150, 185, 225), (120, 105, 95))
    image[rows > 200] = (70, 72, 76)
    buffer = io.BytesIO()
    Image.fromarray(image.astype(np.uint8)).save(buffer, "PNG")
    return buffer.getvalue()
