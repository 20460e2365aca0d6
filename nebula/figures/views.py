"""The views a figure looks at: one that is asked for, or the figure's own few."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gaussians.cameras import Display, StereoRig
from gaussians.errors import InputError
from gaussians.projection import ProjectedSplats, project
from gaussians.spherical_harmonics import fill_colours
from gaussians.tiling import RowSpans, TileGrid, row_spans
from nebula.config import config_path, data_root, load_yaml
from nebula.options import FigureOptions, SceneOptions, scene_options
from nebula.scene_input import SceneInput, describe_files, load, require_visible

DISPLAY = "prototype"  # where neither command line nor scene file says another
TILE_PX = 4  # the accelerator's


@dataclass(frozen=True)
class View:
    """A loaded scene and the rig that looks at it."""

    name: str
    place: SceneInput
    rig: StereoRig

    @property
    def labels(self) -> dict[str, str]:
        """What every row of this view begins with."""
        source = "generated" if self.place.generated else "file"
        return labels(self.name, self.rig.display, f"{source}: {self.place.name}")

    @property
    def description(self) -> dict[str, Any]:
        """Where scene and view come from, for the JSON file."""
        pose = self.rig.pose
        return {
            **self.labels,
            "splats": len(self.place.scene),
            "inputs": describe_files(self.place.files),
            "eye_m": pose.position,
            "forward": pose.rotation[:, 2],
            "near_m": self.rig.near_m,
            "baseline_m": self.rig.baseline_m,
        }

    def binned(self, eyes: int) -> tuple[ProjectedSplats, RowSpans]:
        """Coloured splats of the left or of both eyes, and their tiles by exact ellipses.

        Raises InputError where nothing is visible.
        """
        scene, display = self.place.scene, self.rig.display
        splats = project(scene, self.rig, eyes=eyes)
        rows = row_spans(splats, TileGrid(display.width, display.height, TILE_PX))
        needed = np.any(rows.visible, axis=0)
        require_visible(int(needed.sum()), f"scene {self.name}")
        positions = np.stack([self.rig.left_position, self.rig.right_position])[:eyes]
        fill_colours(splats.features, splats.ids, needed, scene.means, scene.sh, positions)
        return splats, rows


@dataclass(frozen=True)
class Views:
    """The views of a figure, loaded one after the other, and the scenes that are not here."""

    options: FigureOptions
    chosen: dict[str, SceneOptions]
    missing: tuple[dict[str, str], ...]

    def __iter__(self) -> Iterator[View]:
        for name, scene in self.chosen.items():
            place = load(scene, self.options.seed)
            near_m = place.placement.near_m
            rig = StereoRig(scene.display, place.view, self.options.baseline_m, near_m)
            yield View(name, place, rig)

    @property
    def missing_text(self) -> str:
        """A line for the terminal about every scene that is not here."""
        return "".join(f"\nnot measured: {m['scene']} ({m['reason']})" for m in self.missing)


def labels(name: str, display: Display, source: str) -> dict[str, str]:
    """Scene, display and source, as every row of every figure names them."""
    shown = f"{display.width} x {display.height} px, f {display.fx:.1f} px"
    return {"scene": name, "display": shown, "source": source}


def scene_name(options: FigureOptions) -> str | None:
    """Short name of the scene the command line asks for, if it does."""
    given = options.given
    named = next((given[k] for k in ("scene", "city_leaves") if given.get(k) is not None), None)
    if named is None and options.config is None:
        return None
    name = f"city of {named}" if isinstance(named, int) else str(named or options.config)
    return Path(name).stem


def choose_views(options: FigureOptions, defaults: Sequence[str]) -> Views:
    """The one scene the command line names, else the ``defaults`` whose files are here.

    Raises InputError when a named scene, or every default, is not here.
    """
    given = {**options.given, "trace": "stand"}
    name = scene_name(options)
    if name is not None:
        scene = scene_options(options.config, given, default_display=DISPLAY)
        return Views(options, {name: scene}, ())
    missing = {name: reason for name in defaults if (reason := _missing(name)) is not None}
    chosen = {
        name: scene_options(name, given, default_display=DISPLAY)
        for name in defaults
        if name not in missing
    }
    if not chosen:
        raise InputError(f"none of the scenes {', '.join(defaults)} is here; see docs/data.md")
    named_missing = tuple({"scene": n, "reason": reason} for n, reason in missing.items())
    return Views(options, chosen, named_missing)


def _missing(config: str) -> str | None:
    """Why a shipped scene configuration cannot be used: its file is not in the data folder."""
    scene = load_yaml(config_path(config, "scenes")).get("scene")
    if not isinstance(scene, str) or (data_root() / scene).exists():
        return None
    return f"no file {data_root() / scene}; $NEBULA_DATA must be the folder that holds it"
