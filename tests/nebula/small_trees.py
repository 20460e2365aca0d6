"""A stored tree small enough for figures of searches and streams."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gaussians.scene import FIELDS, Scene
from gaussians.synthetic import TiledCity
from lod_cloud import build_tree, save_tree
from nebula.options import FigureOptions

DISPLAY = {"width": 96, "height": 64, "fov_deg": 90.0}


def small_street(place: Path) -> Path:
    """Some metres of street, harmonics of degree 1, written to ``place``."""
    city = TiledCity(4000, "city", 3, 1)
    tiles = list(city.tiles())
    scene = Scene(*(np.concatenate([getattr(t, f) for t in tiles]) for f in FIELDS))
    path = tuple((float(x), float(y), float(z)) for x, y, z in city.path)
    save_tree(build_tree(scene, up=(0.0, 0.0, 1.0), start=path[0], path=path), place)
    return place


def figure_options(name: str, out: Path, tree: Path | None, **changes: Any) -> FigureOptions:
    """Of a figure on a small display; ``given`` in the changes is added to the display."""
    given = {**DISPLAY, **changes.pop("given", {})}
    basis = FigureOptions(name, None, given, seed=1, baseline_m=0.06, out=out, tree=tree)
    return replace(basis, **changes)
