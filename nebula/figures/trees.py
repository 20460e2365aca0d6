"""The tree a figure searches, and how the viewer moves in it.

By default a street of the density of real scans: in the sparse city of the other commands nearly
every cut is all leaves, and a search has nothing to find.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from gaussians.cameras import Display, Pose, StereoRig
from gaussians.errors import InputError
from gaussians.poses import HeadTrace
from gaussians.scene import FIELDS, Scene
from gaussians.synthetic import TiledCity
from lod_cloud import LodTree, SearchRequest, build_tree, load_tree
from lod_cloud.search import SearchTree
from nebula.build_tree import tree_of
from nebula.config import data_root
from nebula.figures.views import DISPLAY, labels, scene_name
from nebula.options import FigureOptions, scene_options
from nebula.progress import progress
from nebula.scene_input import describe_files, head_trace, load
from nebula.search import start_pose
from nebula.session_config import load_session_config

LEAVES = 1_000_000
TAU_PX = 6.0
SEARCH_EVERY = 4  # frames, Sec. 7.4
MOTIONS = ("stand", "walk", "flight")
HEAD_TRACES = ("traces/eyenavgs/user113_alameda.csv",)  # in the data folder
_TREE_SCENE = ("scene", "city_leaves", "level", "up", "units_per_metre")


@dataclass(frozen=True)
class Subject:
    """A tree, a display and a first pose."""

    name: str
    source: str
    tree: LodTree
    view: Pose
    up: str
    display: Display
    near_m: float
    tau_px: float
    seed: int
    files: tuple[Path, ...]

    @cached_property
    def hot(self) -> SearchTree:
        """What searches read of the tree."""
        return SearchTree.of(self.tree)

    @property
    def labels(self) -> dict[str, Any]:
        """What every row begins with."""
        return {**labels(self.name, self.display, self.source), "tau_px": self.tau_px}

    @property
    def description(self) -> dict[str, Any]:
        """For the JSON file."""
        tree = self.tree
        return {
            **self.labels,
            "leaves": tree.leaves,
            "nodes": len(tree),
            "levels": tree.levels,
            "sh_degree": tree.sh_degree,
            "inputs": describe_files(self.files),
            "eye_m": self.view.position,
            "forward": self.view.rotation[:, 2],
        }

    @property
    def title(self) -> str:
        """Tree and tolerance, as they stand in every title."""
        return f"{self.name}, τ = {self.tau_px:g} px"

    def trace(self, motion: str, frames: int) -> HeadTrace:
        """So many poses from the first pose on, at the session's display rate."""
        rate_hz = load_session_config().display_rate.hz
        return head_trace(motion, self.view, self.up, frames, rate_hz, self.seed)

    def request(self, trace: HeadTrace, frame: int) -> SearchRequest:
        """What the viewer asks in a frame."""
        x, y, z = (float(c) for c in trace.positions[frame])
        return SearchRequest((x, y, z), max(self.display.fx, self.display.fy), self.tau_px)

    def rig(self, trace: HeadTrace, frame: int, display: Display, baseline_m: float) -> StereoRig:
        """Both eyes in a frame."""
        return StereoRig(display, trace.pose(frame), baseline_m, self.near_m)


def choose_tree(options: FigureOptions) -> Subject:
    """The tree directory the command line names, or the tree of its scene, or of a dense city.

    Raises InputError for a scene beside a tree directory, and for anything wrong with either.
    """
    given = {**options.given, "trace": "walk"}
    if options.tree is not None:
        idle = [f"--{k.replace('_', '-')}" for k in _TREE_SCENE if given.get(k) is not None]
        idle += [] if options.config is None else ["--config"]
        if idle:
            raise InputError(f"--tree brings its own scene; {', '.join(idle)}: not of use")
    chosen = scene_options(options.config, given, default_display=DISPLAY)
    tau_px = TAU_PX if options.tau_px is None else options.tau_px
    files: tuple[Path, ...] = ()
    name = scene_name(options)
    if options.tree is not None:
        with progress(f"reading {options.tree}"):
            tree = load_tree(options.tree)
        view, up = start_pose(tree, chosen.view, str(options.tree))
        name, source = options.tree.name, f"tree: {options.tree}"
    elif name is not None:
        place = load(chosen, options.seed)
        with progress("building the tree"):
            tree = tree_of(place)
        source = f"{'generated' if place.generated else 'file'}: {place.name}"
        view, up, files = place.view, place.placement.up, place.files
    else:
        name = f"dense city of {LEAVES}"
        tree = _dense_city(options.seed)
        view, up = start_pose(tree, chosen.view, name)
        source = f"generated: {name} leaves, seed {options.seed}"
    near_m, display = chosen.near_m, chosen.display
    return Subject(name, source, tree, view, up, display, near_m, tau_px, options.seed, files)


def _dense_city(seed: int) -> LodTree:
    """A small city as dense as a street scan, in memory."""
    city = TiledCity(LEAVES, "dense", seed)
    with progress(f"generating a dense city of {LEAVES} leaves"):
        tiles = list(city.tiles())
        scene = Scene(*(np.concatenate([getattr(t, field) for t in tiles]) for field in FIELDS))
    path = tuple((float(x), float(y), float(z)) for x, y, z in city.path)
    with progress("building the tree"):
        return build_tree(scene, up=(0.0, 0.0, 1.0), start=path[0], path=path)


def choose_motions(options: FigureOptions, *, recorded: bool) -> tuple[tuple[str, ...], list[str]]:
    """The trace that is asked for, else standing, walking, flying and, with ``recorded``, the
    recordings that are here; and which recordings are not.
    """
    asked = options.given.get("trace")
    if asked is not None:
        return (asked,), []
    found = [data_root() / name for name in HEAD_TRACES] if recorded else []
    here = tuple(str(path) for path in found if path.exists())
    return (*MOTIONS, *here), [str(path) for path in found if not path.exists()]


def motion_name(motion: str) -> str:
    """A generated motion's own name; a recording's without folder and suffix."""
    return Path(motion).stem


def speed_m_s(trace: HeadTrace) -> float:
    """Mean speed of the head over all frames, 0 for a single one."""
    if len(trace) < 2:
        return 0.0
    steps = np.linalg.norm(np.diff(trace.positions, axis=0), axis=1)
    return float(steps.sum() / (trace.times_s[-1] - trace.times_s[0]))
