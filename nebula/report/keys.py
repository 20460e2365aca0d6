"""The keys of report.json, in the order in which the report shows them (see schema.py)."""

from __future__ import annotations

from typing import NamedTuple


class Key(NamedTuple):
    """One key of the report.

    ``type`` is integer, number, string, boolean, any, or ``list of <type>s``; a ? allows null.
    """

    path: str
    type: str
    unit: str  # "" = dimensionless
    meaning: str
    varies: bool = False  # differs between two runs of the same job


def _quality(group: str, what: str) -> tuple[Key, ...]:
    return (
        Key(f"quality.{group}.psnr_db", "number?", "dB", f"PSNR {what}; null when identical"),
        Key(
            f"quality.{group}.ssim", "number?", "", f"SSIM {what}; null without the extra `quality`"
        ),
    )


_SELF = (
    Key("schema_version", "integer", "", "Version of this schema: 1"),
    Key("provenance.version", "string", "", "Version of NEBULA"),
    Key(
        "provenance.commit",
        "string?",
        "",
        "Git commit of the checkout, `+changes` when files differ from it; null when installed",
    ),
    Key("provenance.command", "string", "", "Command line that made the report", True),
    Key("provenance.started_utc", "string", "", "ISO 8601 start of the run", True),
    Key("provenance.wall_s", "number", "s", "Wall-clock time of the run", True),
    Key("provenance.stage_wall_s.*", "number", "s", "The same, by stage", True),
    Key("provenance.machine.platform", "string", "", "Operating system and architecture", True),
    Key("provenance.machine.processor", "string", "", "Name of the processor", True),
    Key("provenance.machine.cores", "integer", "", "Cores this process may use", True),
    Key("provenance.machine.threads", "integer", "", "Threads the kernels ran on", True),
    Key("provenance.machine.packages.*", "string", "", "Versions of Python, numpy, ...", True),
    Key("provenance.seed", "integer", "", "Seed of everything random"),
    Key(
        "provenance.placement.*",
        "any",
        "",
        "How the scene is stood in: up, units_per_metre, eye_m, forward, near_m, level, trace",
    ),
    Key("provenance.display.width", "integer", "px", "Columns per eye"),
    Key("provenance.display.height", "integer", "px", "Rows per eye"),
    Key("provenance.display.fx", "number", "px", "Horizontal focal length"),
    Key("provenance.display.fy", "number", "px", "Vertical focal length"),
    Key("provenance.display.cx_left", "number", "px", "Principal column, left eye's window"),
    Key("provenance.display.cx_right", "number", "px", "Principal column, right eye's window"),
    Key("provenance.display.cy", "number", "px", "Principal row"),
    Key("provenance.options.*", "any", "", "Every other option of the run"),
    Key("provenance.inputs[].name", "string", "", "Name of a file that was read"),
    Key("provenance.inputs[].bytes", "integer", "B", "Its size"),
    Key("provenance.inputs[].sha256", "string", "", "Its SHA-256"),
)

_SCENE = (
    Key("scene.name", "string", "", "Name of the scene"),
    Key("scene.origin", "string", "", "`generated` or `file`"),
    Key("scene.leaves", "integer", "splats", "Gaussians of the scene (leaves of the tree)"),
    Key("scene.sh_degree", "integer", "", "Degree of the spherical harmonics"),
    Key("scene.bounds_min_m", "list of numbers", "m", "Smallest x, y, z of the means"),
    Key("scene.bounds_max_m", "list of numbers", "m", "Largest x, y, z of the means"),
    Key("lod.nodes", "integer", "nodes", "Nodes of the tree, leaves included"),
    Key("lod.levels", "integer", "", "Depth of the tree, root included"),
    Key("lod.tau_px", "number", "px", "Largest allowed size on screen of a node that is drawn"),
    Key("lod.method", "string", "", "Search method"),
    Key("lod.search_every_frames", "integer", "frames", "One search per so many frames"),
    Key("lod.cut_sizes", "list of integers", "nodes", "Size of each cut"),
    Key("lod.cut_size_mean", "number", "nodes", "Mean size of a cut"),
    Key(
        "lod.overlap_mean",
        "number?",
        "",
        "Share of a cut that was in the cut before, mean; null with one search",
    ),
    Key("lod.build_ms", "number", "ms", "Time to build the tree, here, on the CPU", True),
    Key("lod.search_ms", "list of numbers", "ms", "Time of each search, here, on the CPU", True),
    Key("lod.search_ms_mean", "number", "ms", "Mean time of a search", True),
    Key("lod.nodes_visited_mean", "number", "nodes", "Nodes tested per search, mean"),
    Key("stream.codec", "string", "", "Coding of the Δcut messages"),
    Key("stream.link_mbps", "number", "Mbps", "Rate of the link (1 Mb = 10⁶ bit)"),
    Key("stream.latency_ms", "number", "ms", "One-way latency of the link"),
    Key(
        "stream.mbps_mean", "number", "Mbps", "Messages after the first, over the trace's duration"
    ),
    Key(
        "stream.message_bytes", "list of integers", "B", "Size of each message, the first included"
    ),
    Key("stream.initial_bytes", "integer", "B", "First message: the whole first cut"),
    Key("stream.codebook_bytes", "integer", "B", "Codebook sent once, not in `initial_bytes`"),
    Key(
        "stream.initial_ms",
        "number",
        "ms",
        "Codebook and first message over the link, with latency",
    ),
    Key("stream.held_nodes_max", "integer", "nodes", "Most nodes the client held at a time"),
    Key(
        "stream.reuse_window_searches", "integer", "searches", "A node unused for longer is dropped"
    ),
    Key(
        "stream.pacing.*",
        "any",
        "",
        "With `--paced` only: `budget_bytes` of a message; after each message `pending_nodes` of "
        "the cut found that the client's cut lacked, `pending_error_px`, the τ at which the "
        "client's cut was complete (0: nothing pending; null: not even around the viewer), "
        "`pending_harmonics`, nodes of the client's cut that were sent without harmonics above "
        "degree 0 and wait for them, `deferred_bytes`, what the pending nodes were expected to "
        "take, and `tau_px` of the search",
    ),
)

_STEREO = (
    Key("stereo.method", "string", "", "Preset: `exact`, `paper` or `independent`"),
    Key("stereo.description", "string", "", "The preset's switches in one line"),
    Key(
        "stereo.right_mismatching_pixels",
        "integer",
        "pixels",
        "Right-eye pixels whose float32 bits differ from an independently rendered right eye with "
        "ellipse lists, summed over the frames",
    ),
    Key(
        "stereo.right_mismatching_pixels_8bit",
        "integer",
        "pixels",
        "The same after rounding to 8 bits",
    ),
    Key("stereo.pixels", "integer", "pixels", "Right-eye pixels compared: the base of both counts"),
    Key(
        "stereo.psnr_db",
        "number?",
        "dB",
        "Right eye against an independently rendered one, over all frames; null when identical",
    ),
    *(
        Key(
            f"stereo.visible_splats.{eye}",
            "number",
            "splats",
            f"In ≥ 1 tile of the {eye} eye, mean",
        )
        for eye in ("left", "right")
    ),
    *(
        Key(
            f"stereo.covered_pixels_share.{eye}",
            "number",
            "",
            f"Share of the {eye} eye's pixels in which at least one splat was blended, mean",
        )
        for eye in ("left", "right")
    ),
    Key("stereo.list_entries.left", "number", "entries", "(splat, tile) pairs per frame, mean"),
    Key("stereo.list_entries.right", "number", "entries", "(splat, tile) pairs per frame, mean"),
    Key(
        "stereo.forward_only_entries",
        "number",
        "entries",
        "Added to left lists only to be forwarded",
    ),
    Key("stereo.entries_after_termination", "number", "entries", "Walked only for the SRU, mean"),
    Key("stereo.row_writes_per_entry", "number", "", "Stereo-buffer writes per left entry"),
    Key("stereo.dropped", "number", "entries", "Forwards lost per frame, mean (method `paper`)"),
    Key(
        "stereo.duplicates",
        "number",
        "entries",
        "Equal heads the merge unit dropped per frame, mean",
    ),
)

_HARDWARE = (
    Key("timing.accelerator", "string", "", "Configuration that was timed"),
    Key("timing.fidelity", "string", "", "`analytic`: bounds from counters, slowest stage wins"),
    Key("timing.clock_ghz", "number", "GHz", "Clock of the accelerator"),
    Key("timing.cycles_per_frame", "number", "cycles", "Mean over the frames, both eyes"),
    Key("timing.fps", "number", "frames/s", "Clock over mean cycles"),
    Key("timing.bound_by", "string", "", "Stage that limits the mean frame"),
    Key(
        "timing.cycles.*",
        "number",
        "cycles",
        "Cycles until the slowest instance of a unit is done, mean",
    ),
    Key("timing.utilisation.*", "number", "", "Busy share of all instances of a unit, 0..1"),
    Key("timing.dram_bytes.*", "number", "B", "DRAM traffic per frame by stream, mean"),
    Key("timing.dram_bytes_per_frame", "number", "B", "Sum of `dram_bytes`"),
    Key("energy.total_mj_per_frame", "number", "mJ", "Sum of the parts and the radio"),
    Key("energy.parts.*", "number", "mJ", "Energy per frame by part, radio excluded"),
    Key(
        "energy.radio.mj_per_frame",
        "number",
        "mJ",
        "Energy of receiving the messages after the first, over all frames",
    ),
    Key("energy.radio.initial_mj", "number", "mJ", "Receiving codebook and first message, once"),
    Key("energy.radio.nj_per_byte", "number", "nJ/B", "Cost of reception"),
    Key("energy.power_mw", "number", "mW", "Energy per frame times FPS"),
    Key("energy.node_nm", "number", "nm", "Process node of the parts on the chip"),
    Key("energy.technology", "string", "", "Scaling model of the values"),
    Key("energy.low_mj_per_frame", "number", "mJ", "Smallest total of the scaling models"),
    Key("energy.high_mj_per_frame", "number", "mJ", "Largest total of the scaling models"),
    Key("area.total_mm2", "number", "mm²", "Sum of the parts"),
    Key("area.node_nm", "number", "nm", "Process node of the parts"),
    Key("area.technology", "string", "", "Scaling model of the values"),
    Key("area.low_mm2", "number", "mm²", "Smallest total of the scaling models"),
    Key("area.high_mm2", "number", "mm²", "Largest total of the scaling models"),
    Key("area.parts.*", "number", "mm²", "Area by part, all instances"),
    Key("area.scaled.node_nm", "number", "nm", "Node the total is scaled to"),
    Key("area.scaled.total_mm2", "number", "mm²", "Total at that node, same model"),
    Key("area.scaled.low_mm2", "number", "mm²", "Smallest value of the scaling models"),
    Key("area.scaled.high_mm2", "number", "mm²", "Largest value of the scaling models"),
)

_REST = (
    Key("quality.frames", "list of integers", "", "Frames compared (left eye); values are means"),
    *_quality("decoded_vs_cut", "of what the client decoded against the same cut uncoded"),
    *_quality("cut_vs_leaves", "of the uncoded cut against all leaves"),
    *_quality("decoded_vs_leaves", "of what the client decoded against all leaves"),
    Key("frames[].index", "integer", "", "Number of the frame"),
    Key("frames[].time_s", "number", "s", "Its time on the trace"),
    Key("frames[].eye_m", "list of numbers", "m", "Mid-point between the eyes, world"),
    Key("frames[].searched", "boolean", "", "A LoD search was made for it"),
    Key("frames[].message_bytes", "integer", "B", "Message received before it; 0 for none"),
    Key("frames[].drawn_splats", "integer", "splats", "Nodes the client selected and submitted"),
    Key("frames[].visible_splats.left", "integer", "splats", "In ≥ 1 tile of the left eye"),
    Key("frames[].visible_splats.right", "integer", "splats", "In ≥ 1 tile of the right eye"),
    Key("frames[].covered_pixels_share.left", "number", "", "As in `stereo`"),
    Key("frames[].covered_pixels_share.right", "number", "", "As in `stereo`"),
    Key("frames[].right_mismatching_pixels", "integer", "pixels", "As in `stereo`, this frame"),
    Key(
        "frames[].right_mismatching_pixels_8bit", "integer", "pixels", "As in `stereo`, this frame"
    ),
    Key("frames[].cycles", "number", "cycles", "Both eyes"),
    Key("frames[].fps", "number", "frames/s", "Clock over cycles"),
    Key("frames[].bound_by", "string", "", "Stage that limits this frame"),
    Key("frames[].dram_bytes", "number", "B", "DRAM traffic"),
    Key("frames[].energy_mj", "number", "mJ", "Energy, radio excluded"),
    Key("sources[].name", "string", "", "A number the result rests on"),
    Key("sources[].value", "any", "", "Its value, a number or a text that names several"),
    Key(
        "sources[].unit", "string", "", "Its unit; empty when dimensionless or in the value's text"
    ),
    Key(
        "sources[].source",
        "string",
        "",
        "`paper`, `datasheet`, `literature`, `synthesis`, `derived`, `calibrated` or `assumption`",
    ),
    Key("sources[].reference", "string", "", "Where it was found"),
    Key(
        "sources[].confidence",
        "string",
        "",
        "A read in the primary text, B in a secondary one, C computed from such, M a judgement",
    ),
    Key("notes", "list of strings", "", "What is thin in this report and should not be relied on"),
)

KEYS = _SELF + _SCENE + _STEREO + _HARDWARE + _REST
