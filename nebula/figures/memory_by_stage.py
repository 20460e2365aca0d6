"""Gaussians and bytes by stage of the pipeline (paper Sec. 3.3, Fig. 6), local and split.

*Local* rendering keeps the whole tree in the headset. *Split*, the client keeps the nodes that the
cloud sent and has not taken back; all later stages are the same. Three measures, never added up:

* Gaussians involved, the paper's proxy for memory;
* bytes held: tree, subgraph, projected splats, lists and images as they lie in memory here;
* bytes moved per frame between the accelerator and its DRAM (docs/accelerator.md), and by the local
  search what a flat one reads of the tree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from arch import ClientWork, analyse_frame
from arch.memory.splat_record import record_bytes
from gaussians.cameras import StereoRig
from gaussians.projection import project
from gaussians.rasterization import rasterise
from gaussians.render import StereoFrame, render_stereo
from gaussians.scene import FIELDS, Scene
from gaussians.stereo_method import PRESETS
from gaussians.tiling import TileGrid, row_spans, tile_lists
from lod_cloud import Client, Cloud, LodTree, ReceiveStats, Selection, flat_search, make_search
from nebula.figures.codecs import train_codecs
from nebula.figures.output import Figure
from nebula.figures.trees import SEARCH_EVERY, Subject, choose_tree, motion_name
from nebula.figures.views import TILE_PX
from nebula.hardware import load_accelerator
from nebula.options import FigureOptions
from nebula.output import text_table
from nebula.progress import progress
from nebula.scene_input import require_visible
from nebula.session_config import load_session_config

FRAMES = 37  # the reuse window of 32 frames has begun to empty
HEADSET_GB = 12.0  # "often less than", Sec. 3.1
SEARCH, PROJECTION, SORTING, RASTERISATION = STAGES = (
    "LoD search",
    "projection",
    "sorting",
    "rasterisation",
)
_SUBGRAPH_BYTES = 41  # per node held, beside its record; see lod_cloud.subgraph
_IMAGE_BYTES = 16  # per pixel: three colours and the transmittance, float32
_STREAMS = {  # of the accelerator's DRAM
    SEARCH: ("incoming_stream", "new_records", "codebook", "headers"),
    PROJECTION: ("splat_records", "feature_writes"),
    SORTING: ("tile_lists", "sort_spill"),
    RASTERISATION: ("feature_reads", "stereo_spill", "frame_buffer", "display_scan_out"),
}
DIFFERENCE = (
    "The paper shows shares in a figure without numbers, for scenes of up to 66 GB that are not "
    "available here. The drop after LoD search follows from the size of the tree against the cut: "
    "a tree that is all within reach, as a small city is, has a cut of a third of its nodes."
)


def make(options: FigureOptions) -> Figure:
    """One row per stage."""
    subject = choose_tree(options)
    frames = options.frames or FRAMES
    motion = options.given.get("trace") or "walk"
    every = options.search_every or SEARCH_EVERY
    trace = subject.trace(motion, frames)
    last = (frames - 1) // every * every
    client, received = _streamed(subject, motion, frames, every)
    request = subject.request(trace, last)
    selection = client.select(request)
    rig = subject.rig(trace, last, subject.display, options.baseline_m)
    with progress("both eyes"):
        counts = _Counts.of(selection.scene, rig)
        traffic = _traffic(selection, received, rig)
    flat = flat_search(subject.tree, request)
    local_bytes = tree_bytes(subject.tree)
    assert client.table is not None
    record = record_bytes(load_accelerator("nebula").splat_record, subject.tree.sh_degree)
    client_bytes = client.table.state_bytes + selection.held * (_SUBGRAPH_BYTES + record)
    gaussians = (len(subject.tree), len(flat), counts.visible, counts.blended)
    held = (local_bytes, counts.projected_bytes, counts.list_bytes, counts.image_bytes)
    context = {**subject.labels, "trace": motion_name(motion), "search_every": every}
    rows = []
    for stage, involved, here in zip(STAGES, gaussians, held, strict=True):
        search = stage == SEARCH
        row: dict[str, Any] = {
            **context,
            "stage": stage,
            "gaussians_local": involved,
            "gaussians_split": selection.held if search else involved,
            "held_bytes_local": here,
            "held_bytes_split": client_bytes if search else here,
            "moved_bytes_local": flat.bytes_touched if search else traffic[stage],
            "moved_bytes_split": traffic[stage],
        }
        rows.append(row)
    notes = {
        "scenes": [subject.description],
        "frame": last,
        "cut_size": len(flat),
        "client": {
            "held": selection.held,
            "table_bytes": client.table.state_bytes,
            "record_bytes": record,
            "subgraph_bytes_per_node": _SUBGRAPH_BYTES,
        },
        "definitions": __doc__,
        "accelerator": "nebula",
        "paper": {
            "headset_gb_less_than": HEADSET_GB,
            "reference": "Sec. 3.1, Sec. 3.3, Fig. 6",
            "difference": DIFFERENCE,
        },
    }
    return Figure(
        f"Memory by stage: {subject.title}, {motion_name(motion)}",
        notes,
        rows,
        lambda canvas: _draw(canvas, rows),
        _table(rows),
    )


def tree_bytes(tree: LodTree) -> int:
    """What local rendering keeps of a tree: topology, node test, and every node's Gaussian."""
    arrays = (tree.parent, tree.first_child, tree.child_count, tree.radius, tree.extent)
    gaussians = (getattr(tree.gaussians, field) for field in FIELDS)
    return sum(array.nbytes for array in (*arrays, *gaussians))


def _streamed(
    subject: Subject, motion: str, frames: int, every: int
) -> tuple[Client, ReceiveStats]:
    """A client after the trace, and what the last message brought it."""
    config = load_session_config()
    trace = subject.trace(motion, frames)
    codec = train_codecs(subject.tree, subject.seed)["paper"]
    cloud = Cloud(
        subject.tree,
        codec,
        search=make_search("wheel", subject.hot),
        frames_per_search=every,
        reuse_window_frames=config.reuse_window.frames,
    )
    client = Client()
    client.receive(cloud.session_start())
    with progress("streaming", len(range(0, frames, every))) as step:
        for frame in range(0, frames, every):
            received = client.receive(cloud.search(subject.request(trace, frame), frame))
            cloud.receive(client.report())
            step()
    return client, received


@dataclass(frozen=True)
class _Counts:
    """One stereo frame with independent eyes and ellipse lists."""

    visible: int  # Gaussians in at least one tile of an eye
    blended: int  # of these, in at least one pixel of an eye
    projected_bytes: int
    list_bytes: int
    image_bytes: int

    @classmethod
    def of(cls, scene: Scene, rig: StereoRig) -> _Counts:
        splats = project(scene, rig, eyes=2)
        grid = TileGrid(rig.display.width, rig.display.height, TILE_PX)
        rows = row_spans(splats, grid)
        visible = np.any(rows.visible, axis=0)
        require_visible(int(visible.sum()), "memory by stage")
        blended = np.zeros(len(splats.ids), np.bool_)
        list_bytes = 0
        for eye in range(2):
            lists = tile_lists(rows, eye)
            list_bytes += lists.splats.nbytes + lists.offsets.nbytes
            black = (0.0, 0.0, 0.0)
            drawn = rasterise(splats.features[eye], lists, grid, black, record_passes=True)
            blended[lists.splats[drawn.live_passes > 0]] = True
        arrays = (splats.ids, splats.depths, splats.features, splats.covariances)
        return cls(
            visible=int(visible.sum()),
            blended=int(blended.sum()),
            projected_bytes=sum(array.nbytes for array in arrays),
            list_bytes=list_bytes,
            image_bytes=2 * _IMAGE_BYTES * rig.display.width * rig.display.height,
        )


def _traffic(selection: Selection, received: ReceiveStats, rig: StereoRig) -> dict[str, int]:
    """DRAM bytes by stage of the frame that received the last message."""
    config = load_accelerator("nebula")
    method = PRESETS[config.workload.stereo_method]
    if method.forwarding == "none":
        method = replace(method, intersection=config.workload.intersection)
    frame: StereoFrame = render_stereo(selection.scene, rig, method)
    client = ClientWork(
        held_splats=selection.held,
        selected_splats=len(selection.node_ids),
        decoded_splats=received.payloads,
        escaped_splats=0,
        evicted_splats=received.evicted,
        received_bytes=received.message_bytes,
    )
    streams = {
        stream.name: stream.read_bytes + stream.write_bytes
        for stream in analyse_frame(config, frame.work, client).timing.dram
    }
    unknown = set(streams) - {name for names in _STREAMS.values() for name in names}
    if unknown:
        raise RuntimeError(f"DRAM streams of no stage: {', '.join(sorted(unknown))}")
    return {stage: sum(streams.get(n, 0) for n in names) for stage, names in _STREAMS.items()}


def _table(rows: Sequence[dict[str, Any]]) -> str:
    heads = ["stage", "Gaussians local", "split", "MB held local", "split", "MB moved local"]
    heads += ["split"]
    lines = [
        [
            row["stage"],
            f"{row['gaussians_local']}",
            f"{row['gaussians_split']}",
            *(f"{row[f'{kind}_bytes_{side}'] / 1e6:.1f}" for kind, side in _KINDS),
        ]
        for row in rows
    ]
    sums = [sum(row[f"{kind}_bytes_{side}"] for row in rows) / 1e6 for kind, side in _KINDS]
    lines.append(["all stages", "", "", *(f"{total:.1f}" for total in sums)])
    return text_table(heads, lines, range(1, len(heads)))


_KINDS = tuple((kind, side) for kind in ("held", "moved") for side in ("local", "split"))


def _draw(canvas: Any, rows: Sequence[dict[str, Any]]) -> None:
    canvas.set_size_inches(13, 4.8)
    panels = canvas.subplots(1, 3)
    at = np.arange(len(rows))
    measures = {
        "gaussians_{}": ("Gaussians involved", 1.0),
        "held_bytes_{}": ("MB held", 1e-6),
        "moved_bytes_{}": ("MB moved per frame", 1e-6),
    }
    panels[1].axhline(1e3 * HEADSET_GB, color="black", linestyle="--", linewidth=1)
    for axes, (key, (label, scale)) in zip(panels, measures.items(), strict=True):
        for shift, side, name in ((-0.2, "local", "local"), (0.2, "split", "client of the split")):
            values = [scale * row[key.format(side)] for row in rows]
            bars = axes.bar(at + shift, values, 0.4, label=name)
            shown = [f"{v:.3g}" if v < 1e3 else f"{v:,.0f}" for v in values]
            axes.bar_label(bars, shown, fontsize=7, padding=2, rotation=90)
        axes.set_yscale("log")
        low, high = axes.get_ylim()
        if axes is panels[1]:
            high = max(high, 1e3 * HEADSET_GB)
        axes.set_ylim(low, high * (high / low) ** 0.25)
        axes.set_xticks(at, [row["stage"] for row in rows], fontsize=8)
        axes.set_ylabel(label)
    panels[1].annotate(
        f"headset: often less than {HEADSET_GB:g} GB (paper)",
        (1.0, 1e3 * HEADSET_GB),
        xycoords=("axes fraction", "data"),
        xytext=(-3, 2),
        textcoords="offset points",
        fontsize=7,
        ha="right",
    )
    canvas.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
