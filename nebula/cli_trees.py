"""The commands about level-of-detail trees: build one, search it, stream it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from gaussians.errors import InputError
from nebula.cli_options import (
    COUNT,
    EXACT_METHODS,
    NOT_NEGATIVE,
    POSITIVE,
    SEARCH_METHODS,
    SHARE,
    Finite,
    hysteresis_option,
    json_option,
    out_option,
    paced_option,
    scene_options,
    seed_option,
    tau_option,
    threads_option,
    trace_option,
    view_options,
)
from nebula.execution import SCENE_KEYS, execute

_TREE_KEYS = ("scene", "city_leaves", "level", "up", "units_per_metre", "config")


@click.command("build-tree")
@scene_options
@click.option(
    "--tiled",
    metavar="NAME|FILE",
    help="Large city from configs/trees/: city, dense_city. --city-leaves changes its size.",
)
@click.option("--sh-degree", type=click.IntRange(0, 3), help="Of a tiled city.  [default: 3]")
@click.option(
    "--pair-within",
    type=click.IntRange(1, 64),
    default=16,
    show_default=True,
    help="The cheapest pair of so many neighbours merges first; 1: the halves of a split.",
)
@click.option(
    "--fan-out-ratio",
    type=Finite(min=0, max=1, min_open=True),
    default=1.0,
    show_default=True,
    help="Leave out nodes above this share of their parent's size, such as 0.7.",
)
@click.option(
    "--structure",
    type=click.Choice(["merged", "blocks", "instances", "octree"]),
    default="merged",
    show_default=True,
    help="Pairs merged; levels of a lod-meta.json; a subtree per copy of a layout; voxels.",
)
@seed_option
@threads_option
@out_option(None)
@json_option
def build_tree(
    tiled: str | None, sh_degree: int | None, json_target: str | None, **values: Any
) -> None:
    """Build the level-of-detail tree of a scene."""
    from nebula.options import BuildTreeOptions, tiled_tree

    if tiled is None and sh_degree is not None:
        raise InputError("--sh-degree: of use for --tiled only, which is not given")
    if tiled is not None:
        leaves = values.pop("city_leaves")
        idle = [key for key in (*SCENE_KEYS, "config") if values.get(key) is not None]
        idle += ["structure"] if values["structure"] != "merged" else []
        if idle:
            names = ", ".join(f"--{key.replace('_', '-')}" for key in idle)
            raise InputError(f"--tiled brings its own scene; {names}: not of use")
        values |= {"tiled": tiled_tree(tiled, leaves, sh_degree), "city_leaves": None}
    execute("build_tree", BuildTreeOptions, values, json_target)


@click.command()
@click.option("--tree", required=True, type=click.Path(path_type=Path), metavar="DIR")
@seed_option
@view_options
@trace_option
@click.option("--frames", type=COUNT, help="Of the trace.  [default: enough for 460 searches]")
@click.option("--every", "search_every", type=COUNT, default=4, show_default=True, help="Frames.")
@tau_option
@click.option("--method", type=SEARCH_METHODS, default="auto", show_default=True, metavar="NAME")
@click.option("--compare", is_flag=True, help="All methods and baseline rules, one after another.")
@hysteresis_option(0.0)
@threads_option
@json_option
def search(json_target: str | None, **values: Any) -> None:
    """Search a stored tree along a head trace; time methods and compare their cuts."""
    from nebula.options import SearchOptions

    execute("search", SearchOptions, values, json_target)


@click.command()
@click.option("--tree", type=click.Path(path_type=Path), metavar="DIR", help="Instead of a scene.")
@scene_options
@seed_option
@view_options
@trace_option
@click.option("--frames", type=COUNT, help="Of the trace.  [default: enough for 450 searches]")
@click.option("--every", "search_every", type=COUNT, default=4, show_default=True, help="Frames.")
@tau_option
@click.option("--method", type=EXACT_METHODS, default="auto", show_default=True, metavar="NAME")
@hysteresis_option(0.02)
@click.option(
    "--codec",
    type=click.Choice(["paper", "compact"]),
    default="compact",
    show_default=True,
    help="Coding of the nodes.",
)
@click.option("--rate-mbps", type=POSITIVE, default=100.0, show_default=True, help="Link rate.")
@click.option("--latency-ms", type=NOT_NEGATIVE, default=5.0, show_default=True, help="One way.")
@paced_option
@click.option("--loss", type=SHARE, default=0.0, help="Share of the messages lost, either way.")
@click.option("--reorder", type=SHARE, default=0.0, help="Share that arrive one search later.")
@click.option("--corruption", type=SHARE, default=0.0, help="Share with a bit flipped.")
@threads_option
@json_option
def stream(tree: Path | None, json_target: str | None, **values: Any) -> None:
    """Play a head trace through cloud, link and client, without rendering.

    The scene's tree is built first, unless --tree names a stored one.
    """
    from nebula.options import StreamOptions

    idle = [key for key in _TREE_KEYS if tree is not None and values.get(key) is not None]
    if idle:
        names = ", ".join(f"--{key.replace('_', '-')}" for key in idle)
        raise InputError(f"--tree brings its own scene; {names}: not of use")
    execute("stream", StreamOptions, values | {"tree": tree}, json_target)
