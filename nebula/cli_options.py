"""Options that several commands share, and the kinds of values they take."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

Function = TypeVar("Function", bound=Callable[..., Any])


class Finite(click.FloatRange):
    """A finite number in a range; click alone lets nan pass."""

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


POSITIVE = Finite(min=0, min_open=True)
NOT_NEGATIVE = Finite(min=0)
COUNT = click.IntRange(min=1)
LEAVES = click.IntRange(1_000, 20_000_000)
PIXELS = click.IntRange(1, 16_384)
FOV_DEG = Finite(min=1, max=170)
METHODS = click.Choice(["exact", "paper", "independent"])
SHARE = Finite(min=0, max=1)
_EXACT = ("flat", "depth_first", "streaming", "temporal", "validity", "wheel", "auto")
EXACT_METHODS = click.Choice(_EXACT)
SEARCH_METHODS = click.Choice([*_EXACT, "octree_gs", "city_gaussian"])
UP_AXES = click.Choice(["+x", "-x", "+y", "-y", "+z", "-z"])


def options(*options: Callable[[Function], Function]) -> Callable[[Function], Function]:
    """One decorator from several, in the order of the help text."""

    def decorate(function: Function) -> Function:
        for option in reversed(options):
            function = option(function)
        return function

    return decorate


scene_options = options(
    click.option(
        "--scene", metavar="PATH", help="PLY, SPZ, .splat, SOG, lod-meta, layout; else a city."
    ),
    click.option("--config", metavar="NAME|FILE", help="Scene and placement from configs/scenes/."),
    click.option("--city-leaves", "--city", type=LEAVES, help="Generated city.  [default: 300000]"),
    click.option("--level", type=click.IntRange(min=0), help="Level of a scene; 0 is the finest."),
    click.option("--up", type=UP_AXES, help="Up axis.  [default: -y for files, +z for the city]"),
    click.option("--units-per-metre", type=POSITIVE, help="Scene units per metre.  [default: 1]"),
)
seed_option = click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
view_option = click.option(
    "--view", metavar="EX,EY,EZ:LX,LY,LZ", help="Eye and look-at, scene units."
)
display_options = options(
    click.option("--fov", "fov_deg", type=FOV_DEG, help="Horizontal, degrees.  [default: 96]"),
    click.option("--width", type=PIXELS, help="Pixels per eye.  [default: 1024]"),
    click.option("--height", type=PIXELS, help="Pixels per eye.  [default: 1024]"),
    click.option("--display", metavar="NAME", help="prototype or quest3, instead of the three."),
)
view_options = options(
    view_option,
    click.option("--near", "near_m", type=POSITIVE, help="Near plane, m.  [default: 0.2]"),
    display_options,
)
baseline_option = click.option(
    "--baseline",
    "baseline_m",
    type=NOT_NEGATIVE,
    default=0.06,
    show_default=True,
    help="Between the eyes, m.",
)
trace_option = click.option(
    "--trace",
    metavar="NAME|CSV",
    help="stand, walk, flight, teleport or an EyeNavGS recording.  [default: walk]",
)
tau_option = click.option(
    "--tau", "tau_px", type=NOT_NEGATIVE, default=6.0, show_default=True, help="LoD, px."
)
trace_options = options(
    trace_option,
    click.option("--frames", type=COUNT, default=12, show_default=True),
    click.option("--search-every", type=COUNT, default=4, show_default=True, help="Frames."),
    tau_option,
)
paced_option = click.option(
    "--paced",
    is_flag=True,
    help="Messages within what the link carries between two searches, coarse to fine.",
)
method_option = click.option("--method", type=METHODS, default="exact", show_default=True)
accelerator_option = click.option(
    "--accelerator",
    metavar="NAME|FILE",
    default="nebula",
    show_default=True,
    help="Or gscore_nebula.",
)
threads_option = click.option(
    "--threads", type=click.IntRange(1, 1024), help="CPU threads.  [default: all cores]"
)
json_option = click.option(
    "--json", "json_target", metavar="FILE", help="Write the result as JSON; - is standard output."
)


def out_option(default: str | None) -> Callable[[Function], Function]:
    """``--out DIR``; without a default it must be given."""
    given: dict[str, Any] = {"required": True} if default is None else {"default": default}
    return click.option(
        "--out",
        type=click.Path(path_type=Path),
        show_default=True,
        metavar="DIR",
        help="Files of the same name are replaced, others stay.",
        **given,
    )


def hysteresis_option(default: float) -> Callable[[Function], Function]:
    """``--hysteresis H``."""
    return click.option(
        "--hysteresis",
        type=Finite(min=0, max=0.05),
        default=default,
        show_default=True,
        help="Share of its switching distance by which a node stays refined.",
    )
