"""``nebula verify``: the right eye by stereo methods against one that shares nothing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gaussians.attribution import LABELS, Attribution, CauseMap
from gaussians.cameras import StereoRig
from gaussians.poses import GENERATED_RATE_HZ
from gaussians.quality import pixels_per_degree
from gaussians.render import BLACK, Colour, StereoFrame, StereoRenderer
from gaussians.scene import Scene
from gaussians.stereo_causes import CAUSES, isolated, ladder
from gaussians.stereo_method import PRESETS, StereoMethod, parse_method
from gaussians.synthetic import HOSTILE
from nebula.memory import keep_freed_memory
from nebula.options import VerifyOptions
from nebula.output import CommandResult, OutputDirectory
from nebula.progress import progress
from nebula.scene_input import describe_files, head_trace, load, require_visible
from nebula.verification.chart import MissingReportExtra, accuracy_against_work
from nebula.verification.pictures import cause_map, difference_map, side_by_side
from nebula.verification.tables import (
    csv_table,
    hostile_markdown,
    markdown_table,
    terminal_table,
)
from nebula.verification.tally import MethodTally

# Both eyes on their own, by each kind of list: what sharing has to beat.
_BASELINES = tuple(
    replace(PRESETS["independent"], name=f"independent {kind}", intersection=kind)
    for kind in ("square_3sigma", "obb", "ellipse")
)


@dataclass(frozen=True)
class _View:
    scene: Scene
    rig: StereoRig
    background: Colour


@dataclass(frozen=True)
class _Subject:
    """One scene and the views it is verified from."""

    name: str
    breaks: str | None  # what is hard there, of a hostile scene
    views: Sequence[_View]
    files: Sequence[Path]


def run(options: VerifyOptions) -> CommandResult:
    """Write verify.json, .csv and .md, chart.png and the pictures of the first view."""
    methods = _methods(options)
    keep_freed_memory()
    with OutputDirectory(options.out) as out:
        subjects = list(_subjects(options))
        alone = () if options.mode == "hostile" else _BASELINES
        rows: list[dict[str, Any]] = []
        missing: list[str] = []
        steps = (len(methods) + len(alone)) * sum(len(subject.views) for subject in subjects)
        with progress(f"verifying {len(methods)} methods", steps) as advance:
            for subject in subjects:
                pictures = None if subject.breaks else out
                every = (*methods, *alone)
                about = {} if subject.breaks is None else {"breaks": subject.breaks}
                for tally in _verify(subject, every, options.tile_px, pictures, advance):
                    rows.append({"scene": subject.name, **about, **tally.row()})
                    missing += [f"{subject.name}: {why}" for why in tally.missing]
        rows, baselines = rows[: len(rows) - len(alone)], rows[len(rows) - len(alone) :]
        if alone:
            try:
                title = f"{subjects[0].name}, right eye against an independent one"
                out.write_bytes("chart.png", accuracy_against_work([*rows, *baselines], title))
            except MissingReportExtra as error:
                missing.append(f"chart.png was not drawn: {error}")
        missing = sorted(set(missing))
        data = _describe(options, subjects, rows, baselines, missing)
        out.write_json("verify.json", data)
        every_row = [*rows, *baselines]
        out.write_text("verify.csv", csv_table(every_row))
        markdown = markdown_table if alone else hostile_markdown
        out.write_text("verify.md", markdown(every_row))
    lines = (terminal_table(every_row), *missing, str(options.out / "verify.json"))
    return CommandResult(data, "\n".join(lines))


def _methods(options: VerifyOptions) -> tuple[StereoMethod, ...]:
    if options.mode == "ladder":
        return ladder()
    if options.mode == "isolate":
        return isolated()
    return tuple(parse_method(text) for text in options.methods or ("paper", "exact"))


def _subjects(options: VerifyOptions) -> Iterator[_Subject]:
    if options.mode == "hostile":
        for name, build in HOSTILE.items():
            case = build()
            yield _Subject(name, case.breaks, [_View(case.scene, case.rig, case.background)], ())
        return
    place = load(options.scene, options.seed)
    poses = [place.view]
    if options.moving:
        trace = head_trace(
            options.scene.trace,
            place.view,
            place.placement.up,
            options.frames,
            GENERATED_RATE_HZ,
            options.seed,
        )
        poses = [trace.pose(i) for i in range(options.frames)]
    display, near_m = options.scene.display, place.placement.near_m
    rigs = [StereoRig(display, pose, options.baseline_m, near_m) for pose in poses]
    yield _Subject(place.name, None, [_View(place.scene, rig, BLACK) for rig in rigs], place.files)


def _verify(
    subject: _Subject,
    methods: Sequence[StereoMethod],
    tile_px: int,
    pictures: OutputDirectory | None,
    advance: Any,
) -> list[MethodTally]:
    ppd = pixels_per_degree(subject.views[0].rig.display.fx)
    tallies = [MethodTally(method, ppd) for method in methods]
    for index, view in enumerate(subject.views):
        renderer = StereoRenderer(view.scene, view.rig, view.background, tile_px)
        reference, attribution = renderer.independent_right(), Attribution(renderer)
        for tally in tallies:
            frame = renderer.render(tally.method)
            if subject.breaks is None:
                require_visible(sum(frame.visible), "verify")
            causes = attribution.attribute(tally.method, frame.right)
            tally.add(frame, reference, causes.counts)
            if index == 0 and pictures is not None:
                own = reference.image
                name = _file_name(tally.method)
                pictures.write_bytes(f"difference-{name}.png", difference_map(frame.right, own))
                if tally is tallies[0]:
                    _write_pictures(pictures, tally.method, frame, own, causes)
            advance()
    return tallies


def _write_pictures(
    out: OutputDirectory, method: StereoMethod, frame: StereoFrame, own: Any, causes: CauseMap
) -> None:
    """Of the first method: the maps of its causes, and what one sees."""
    counts = [causes.counts[name].pixels if name in causes.counts else 0 for name in LABELS]
    name = _file_name(method)
    out.write_bytes(f"causes-{name}.png", cause_map(causes.labels, LABELS, counts))
    titles = ("left eye", f"right eye by {method.name}", "right eye on its own")
    sheet = side_by_side((frame.left, frame.right, own), titles)
    out.write_bytes(f"side-by-side-{name}.png", sheet)


def _file_name(method: StereoMethod) -> str:
    return "".join(c if c.isalnum() or c in "-_+" else "-" for c in method.name)


def _describe(
    options: VerifyOptions,
    subjects: Sequence[_Subject],
    rows: Sequence[dict[str, Any]],
    baselines: Sequence[dict[str, Any]],
    missing: Sequence[str],
) -> dict[str, Any]:
    rig = subjects[0].views[0].rig
    shown = {
        "width": rig.display.width,
        "height": rig.display.height,
        "fx_px": rig.display.fx,
        "baseline_m": rig.baseline_m,
        "near_m": rig.near_m,
    }
    return {
        "mode": options.mode or "methods",
        "reference": str(PRESETS["independent"]),
        "views": sum(len(subject.views) for subject in subjects),
        "rig": None if options.mode == "hostile" else shown,
        "tile_px": options.tile_px,
        "inputs": describe_files(subjects[0].files),
        "causes": {c.name: f"({c.numeral}) {c.description}" for c in CAUSES},
        "rows": rows,
        "baselines": baselines,
        "missing": missing,
    }
