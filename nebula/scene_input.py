"""From what a command was asked for to a scene in metres, a placed head trace, and provenance."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from gaussians.cameras import Pose
from gaussians.errors import InputError
from gaussians.formats import load_scene
from gaussians.placement import Placement, Point, View, anchor, parse_view, point
from gaussians.poses import GENERATED_RATE_HZ, HeadTrace, generate_trace, read_eyenavgs, resample
from gaussians.scene import Scene
from gaussians.synthetic import BenchmarkView, benchmark_scene, generate_city
from nebula.options import GENERATED_TRACES, GeneratedCity, SceneOptions
from nebula.progress import progress


@dataclass(frozen=True)
class SceneInput:
    """A scene in metres, where the viewer stands in it, and where both came from."""

    name: str
    generated: bool
    scene: Scene
    placement: Placement
    walkable_path: tuple[Point, ...]  # metres; empty for files
    files: tuple[Path, ...]

    @cached_property
    def view(self) -> Pose:
        """Head pose of the first frame, metres; InputError for a scene without extent to frame."""
        units = self.placement.units_per_metre
        return self.placement.view_pose(self.scene if units == 1 else self.scene.scaled(units))


def load(options: SceneOptions, seed: int) -> SceneInput:
    """Read or generate the scene, convert it to metres.

    Raises InputError for anything wrong with file or placement.
    """
    path: tuple[Point, ...] = ()
    files: list[Path] = []
    default_up: str = "-y"
    default_view: View | None = None
    source = options.scene
    if isinstance(source, GeneratedCity):
        with progress(f"generating a city of {source.city} leaves"):
            city = generate_city(source.city, seed)
        name, scene = f"city of {source.city} leaves, seed {seed}", city.scene
        default_up, default_view = city.up, (point(city.eye), point(city.target))
        path = tuple(point(p) for p in city.path)
    elif isinstance(source, BenchmarkView):
        with progress(f"generating the view {source.name}"):
            scene, rig = benchmark_scene(source)
        name, eye = f"benchmark view {source.name}", rig.pose.position
        default_up, default_view = "+z", (point(eye), point(eye + rig.pose.rotation[:, 2]))
    else:
        with progress(f"reading {source}"):
            scene, files = load_scene(source, options.level)
        name = source.name
    placement = Placement(
        up=options.up or default_up,
        units_per_metre=options.units_per_metre,
        view=default_view if options.view is None else parse_view(options.view),
        near_m=options.near_m,
    )
    return SceneInput(
        name=name,
        generated=not isinstance(source, Path),
        scene=scene.scaled(1.0 / placement.units_per_metre),
        placement=placement,
        walkable_path=path,
        files=tuple(files),
    )


def head_trace(name: str, view: Pose, up: str, frames: int, rate_hz: float, seed: int) -> HeadTrace:
    """``frames`` poses at the display rate of a generated or recorded trace, starting at ``view``.

    Raises InputError when a recording cannot be read or is too short.
    """
    if name in GENERATED_TRACES:
        if rate_hz != GENERATED_RATE_HZ:
            raise InputError(
                f"generated traces are of {GENERATED_RATE_HZ:g} Hz; the display rate must be that, "
                f"not {rate_hz:g} Hz"
            )
        relative = generate_trace(name, frames, np.random.default_rng(seed))
    elif not Path(name).exists():
        raise InputError(
            f"trace must be one of {', '.join(GENERATED_TRACES)} or a recording; no file {name}"
        )
    else:
        relative = resample(read_eyenavgs(Path(name)), rate_hz, frames)
    return anchor(relative, view, up)


def describe_files(files: Iterable[Path]) -> list[dict[str, str | int]]:
    """Path, size and SHA-256 of every file read, for the report."""
    described: list[dict[str, str | int]] = []
    for path in files:
        content = path.read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        described.append({"name": path.name, "bytes": len(content), "sha256": digest})
    return described


def require_visible(visible: int, what: str) -> None:
    """A view that sees nothing is a mistake of placement: InputError."""
    if visible == 0:
        raise InputError(
            f"{what}: no splat is visible from this view; "
            "check --view, --up, --near and --units-per-metre"
        )
