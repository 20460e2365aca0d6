"""Figures: ``nebula figure NAME`` measures something and writes NAME.json, NAME.csv and NAME.png.

A figure is a module with ``make(options) -> Figure``; this table says which there are.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

from gaussians.errors import InputError

if TYPE_CHECKING:
    from nebula.options import FigureOptions


class FigureKind(NamedTuple):
    """Where a figure is made, what it shows, and which of the options below it has use for."""

    module: str
    about: str
    takes: tuple[str, ...]


_VIEW = ("near_m",)
_TREE = ("tree", "trace", "tau_px", "frames")
_EVERY = (*_TREE, "search_every")

FIGURES = {
    "formats": FigureKind("formats", "how far each number format is from float32", _VIEW),
    "format-widths": FigureKind(
        "format_widths", "format hw with each width changed by a bit", _VIEW
    ),
    "stereo-similarity": FigureKind("stereo_similarity", "what the two eyes share", _VIEW),
    "lod-search": FigureKind("lod_search", "every LoD search: time, nodes, bytes, A100", _EVERY),
    "temporal-similarity": FigureKind(
        "temporal_similarity", "what cuts some frames apart share", _TREE
    ),
    "frame-interval": FigureKind("frame_interval", "a search every 1 to 64 frames", _TREE),
    "memory-by-stage": FigureKind(
        "memory_by_stage", "Gaussians and bytes by stage, local and split", (*_EVERY, *_VIEW)
    ),
    "bandwidth": FigureKind(
        "bandwidth", "H.265 against the Δcut stream", (*_EVERY, *_VIEW, "shrink")
    ),
}

_OPTIONS = {  # that not every figure has use for
    "tree": "--tree",
    "trace": "--trace",
    "tau_px": "--tau",
    "search_every": "--every",
    "frames": "--frames",
    "shrink": "--shrink",
    "near_m": "--near",
}


def figure_module(options: FigureOptions) -> Any:
    """The module of the figure asked for.

    Raises InputError with the known names for any other, and for an option it has no use for.
    """
    name = options.name
    if name not in FIGURES:
        raise InputError(f"no figure named '{name}'; it must be one of: {', '.join(FIGURES)}")
    kind = FIGURES[name]
    values = {key: getattr(options, key, options.given.get(key)) for key in _OPTIONS}
    idle = [
        flag for key, flag in _OPTIONS.items() if values[key] is not None and key not in kind.takes
    ]
    if idle:
        raise InputError(f"figure {name}: {', '.join(idle)}: not of use here")
    return import_module(f"nebula.figures.{kind.module}")
