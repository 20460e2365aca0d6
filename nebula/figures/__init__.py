"""Figures: ``nebula figure NAME`` measures something and writes NAME.json, NAME.csv and NAME.png.

A figure is a module with ``make(options) -> Figure``; this table says which there are.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from gaussians.errors import InputError

FIGURES = {
    "formats": ("nebula.figures.formats", "how far each number format is from float32"),
    "format-widths": ("nebula.figures.format_widths", "format hw with each width changed by a bit"),
    "stereo-similarity": ("nebula.figures.stereo_similarity", "what the two eyes share"),
}


def figure_module(name: str) -> Any:
    """The module of a figure; InputError with the known names for any other."""
    if name not in FIGURES:
        raise InputError(f"no figure named '{name}'; it must be one of: {', '.join(FIGURES)}")
    return import_module(FIGURES[name][0])
