"""``nebula simulate``: a head trace through cloud, link, client and accelerator, to a report."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from arch import area
from gaussians.cameras import Display, StereoRig
from gaussians.errors import InputError
from gaussians.poses import HeadTrace
from gaussians.render import StereoFrame, render_stereo
from gaussians.stereo_method import PRESETS, StereoMethod
from lod_cloud import Link, LodTree, PaperCodec, SearchRequest
from nebula import assemble, provenance
from nebula.build_tree import tree_of
from nebula.hardware import load_accelerator, load_costs, load_technology
from nebula.images import difference_png, png
from nebula.measure import FrameRecord, Hardware, measure, own_right
from nebula.options import SimulateOptions
from nebula.output import CommandResult, OutputDirectory
from nebula.progress import progress
from nebula.quality import QualityComparison
from nebula.report import SCHEMA_VERSION, html_page, validate_report
from nebula.scene_input import SceneInput, describe_files, head_trace, load, require_visible
from nebula.session import Session, StartUp
from nebula.session_config import SessionConfig, load_session_config

NOTES = (
    "Timing is of fidelity `analytic`: each unit's cycles are bounds from counters of this run, "
    "and the slowest unit sets the frame time; no queueing between units is simulated.",
    "Search method and hysteresis are listed under sources (`nebula search --compare` times the "
    "others), and the cloud's computing time is an assumption, listed there too.",
    "The link loses nothing; messages arrive in order.",
    "Image arithmetic is float32; `nebula figure formats` says what fixed point would change.",
    "The paper's six data sets are not available here; its figures are compared only where they do "
    "not depend on the scene.",
)


@dataclass
class _Clock:
    """Wall time by stage."""

    started_utc: str = field(default_factory=provenance.now_utc)
    begin: float = field(default_factory=time.perf_counter)
    stages: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        self.stages[name] = time.perf_counter() - begin


@dataclass(frozen=True)
class _Setting:
    """Everything that stands before the first frame."""

    place: SceneInput
    trace: HeadTrace
    display: Display
    method: StereoMethod
    hardware: Hardware
    config: SessionConfig
    link: Link
    tree: LodTree
    codec: PaperCodec
    build_ms: float
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Outcome:
    """Everything that came out of the frames."""

    session: Session
    start: StartUp
    records: list[FrameRecord]
    quality: QualityComparison
    last: StereoFrame


def run(options: SimulateOptions) -> CommandResult:
    """Write report.json, report.html, left.png, right.png and difference.png (last frame)."""
    clock = _Clock()
    with OutputDirectory(options.out) as out:
        setting = _prepare(options, clock)
        with clock.stage("frames"):
            outcome = _play(options, setting)
        report = _report(options, setting, outcome, clock)
        validate_report(report)
        last = outcome.last
        images = {"left": png(last.left), "right": png(last.right)}
        images["difference"] = difference_png(last.right, own_right(last))
        for name, content in images.items():
            out.write_bytes(f"{name}.png", content)
        out.write_json("report.json", report)
        if options.html:
            out.write_text("report.html", html_page(report, images))
    page = options.out / ("report.html" if options.html else "report.json")
    return CommandResult(report, _summary(report) + f"\n{page.resolve()}")


def _prepare(options: SimulateOptions, clock: _Clock) -> _Setting:
    hardware = Hardware(load_accelerator(options.accelerator), load_costs(), load_technology())
    method, config = _method(options, hardware), load_session_config()
    with clock.stage("scene"):
        place = load(options.scene, options.seed)
    up = place.placement.up
    rate_hz = config.display_rate.hz
    trace = head_trace(options.scene.trace, place.view, up, options.frames, rate_hz, options.seed)
    display, notes = _display(options, trace)
    begin = time.perf_counter()
    with clock.stage("tree"), progress("building the tree"):
        tree = tree_of(place)
    build_ms = 1e3 * (time.perf_counter() - begin)
    with clock.stage("codebook"), progress("training the codebook"):
        book = config.codebook
        codec = PaperCodec.train(tree, options.seed, words=book.words, stages=book.stages)
    return _Setting(
        place=place,
        trace=trace,
        display=display,
        method=method,
        hardware=hardware,
        config=config,
        link=Link(options.rate_mbps, options.latency_ms, hardware.costs.radio.nj_per_byte),
        tree=tree,
        codec=codec,
        build_ms=build_ms,
        notes=notes,
    )


def _display(options: SimulateOptions, trace: HeadTrace) -> tuple[Display, tuple[str, ...]]:
    """The display asked for, or the recording's off-axis windows of the same size."""
    display = options.scene.display
    if not options.trace_fov:
        return display, ()
    if trace.half_angles is None:
        raise InputError(f"--trace-fov: trace {trace.name} must be a recording with half-angles")
    outer, inner, up, down = trace.half_angles
    off_axis, rounding_deg = Display.from_half_angles(
        display.width, display.height, outer, inner, up, down
    )
    note = (
        f"Off-axis windows by the recording's half-angles; their offset was rounded to "
        f"{off_axis.window_offset_px:g} px, which turns each window by {rounding_deg:.2f} degrees."
    )
    return off_axis, (note,)


def _method(options: SimulateOptions, hardware: Hardware) -> StereoMethod:
    """The method asked for or the accelerator's own; independent eyes use the latter's lists."""
    workload = hardware.config.workload
    method = PRESETS[options.method or workload.stereo_method]
    if method.forwarding == "none":
        return replace(method, intersection=workload.intersection)
    if hardware.config.stereo is None:
        raise InputError(
            f"{hardware.config.name}: has no stereo units; --method must be 'independent', "
            f"not '{method.name}'"
        )
    return method


def _play(options: SimulateOptions, setting: _Setting) -> _Outcome:
    place, trace, link = setting.place, setting.trace, setting.link
    tree, codec, config = setting.tree, setting.codec, setting.config
    session = Session(tree, codec, config, link, options.search_every, paced=options.paced)
    quality = QualityComparison(setting.tree, place.scene, options.frames)
    records: list[FrameRecord] = []
    with progress("encoding the first cut"):
        start = session.start(_request(options, setting, 0))
    with progress("frames", options.frames) as step:
        for index in range(options.frames):
            client = session.frame(index, _request(options, setting, index))
            pose, near_m = trace.pose(index), place.placement.near_m
            rig = StereoRig(setting.display, pose, options.baseline_m, near_m)
            frame = render_stereo(client.selection.scene, rig, setting.method, compare=True)
            require_visible(sum(frame.visible), f"frame {index}")
            time_s = float(trace.times_s[index])
            records.append(measure(index, time_s, pose.position, client, frame, setting.hardware))
            quality.compare(index, client.selection.node_ids, frame.left, rig)
            step()
    return _Outcome(session, start, records, quality, frame)


def _request(options: SimulateOptions, setting: _Setting, frame: int) -> SearchRequest:
    x, y, z = (float(c) for c in setting.trace.positions[frame])
    display = setting.display
    return SearchRequest((x, y, z), max(display.fx, display.fy), options.tau_px)


def _report(
    options: SimulateOptions, setting: _Setting, outcome: _Outcome, clock: _Clock
) -> dict[str, Any]:
    records, session, hardware = outcome.records, outcome.session, setting.hardware
    display, rate_hz = setting.display, setting.config.display_rate.hz
    timing = assemble.timing(hardware, records)
    shared = (hardware.config, hardware.costs, hardware.technology)
    scaled_node = hardware.technology.choice.energy_node_nm
    quality, missing = outcome.quality.result()
    return {
        "schema_version": SCHEMA_VERSION,
        "provenance": _provenance(options, setting, clock),
        "scene": _scene(setting.place),
        "lod": assemble.lod(setting.tree, session, options.tau_px, setting.build_ms),
        "stream": assemble.stream(session, outcome.start, setting.link, records, rate_hz),
        "stereo": assemble.stereo(setting.method, display.width * display.height, records),
        "timing": timing,
        "energy": assemble.energy(records, outcome.start, setting.link, timing["fps"]),
        "area": assemble.area(area(*shared), area(*shared, scaled_node)),
        "quality": quality,
        "frames": assemble.frames(records),
        "sources": assemble.sources(hardware, setting.config, setting.link),
        "notes": [*NOTES, *setting.notes, assemble.codec_note(setting.codec, session), *missing],
    }


def _provenance(options: SimulateOptions, setting: _Setting, clock: _Clock) -> dict[str, Any]:
    place, scene = setting.place, options.scene
    pose = place.view
    return {
        "version": provenance.nebula_version(),
        "commit": provenance.commit(),
        "command": provenance.command_line(),
        "started_utc": clock.started_utc,
        "wall_s": time.perf_counter() - clock.begin,
        "stage_wall_s": dict(clock.stages),
        "machine": provenance.machine(),
        "seed": options.seed,
        "placement": {
            "up": place.placement.up,
            "units_per_metre": place.placement.units_per_metre,
            "eye_m": pose.position.tolist(),
            "forward": pose.rotation[:, 2].tolist(),
            "near_m": place.placement.near_m,
            "level": scene.level,
            "trace": setting.trace.name,
        },
        "display": assemble.plain(setting.display),
        "options": {
            key: assemble.plain(value)
            for key, value in vars(options).items()
            if key not in ("scene", "seed", "out", "html")
        },
        "inputs": describe_files((*place.files, *setting.trace.files)),
    }


def _scene(place: SceneInput) -> dict[str, Any]:
    return {
        "name": place.name,
        "origin": "generated" if place.generated else "file",
        "leaves": len(place.scene),
        "sh_degree": place.scene.sh_degree,
        "bounds_min_m": np.min(place.scene.means, axis=0).tolist(),
        "bounds_max_m": np.max(place.scene.means, axis=0).tolist(),
    }


def _summary(report: dict[str, Any]) -> str:
    timing, stream, energy = report["timing"], report["stream"], report["energy"]
    stereo, area_mm2 = report["stereo"], report["area"]
    return (
        f"{report['scene']['name']}: {len(report['frames'])} frames on {timing['accelerator']}\n"
        f"{timing['fps']:.1f} FPS ({timing['cycles_per_frame'] / 1e6:.2f} M cycles, "
        f"bound by {timing['bound_by']}), {energy['total_mj_per_frame']:.2f} mJ per frame, "
        f"{area_mm2['total_mm2']:.2f} mm² at {area_mm2['node_nm']:g} nm\n"
        f"{stream['mbps_mean']:.2f} Mbps after a first {stream['initial_bytes'] / 1e6:.2f} MB\n"
        f"right eye by {stereo['method']}: {stereo['right_mismatching_pixels']} of "
        f"{stereo['pixels']} pixels differ from an independent right eye "
        f"({stereo['right_mismatching_pixels_8bit']} in 8 bit)"
    )
