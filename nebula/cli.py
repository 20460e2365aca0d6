"""The commands of the command line and their options; those about trees: `nebula.cli_trees`.

Commands import what they need when they run, so that ``nebula --help`` is quick. Each one hands an
options object of ``nebula.options`` to ``run`` of the module of its own name, which returns a
``CommandResult``; printing and ``--json`` are handled in `nebula.execution`, errors in
`nebula.program`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from gaussians.errors import InputError
from nebula.cli_options import (
    COUNT,
    METHODS,
    NOT_NEGATIVE,
    POSITIVE,
    accelerator_option,
    baseline_option,
    display_options,
    json_option,
    method_option,
    out_option,
    paced_option,
    scene_options,
    seed_option,
    threads_option,
    trace_option,
    trace_options,
    view_option,
    view_options,
)
from nebula.cli_trees import build_tree, search, stream
from nebula.execution import SCENE_KEYS, VIEW_KEYS, execute
from nebula.figures import FIGURES

HELP = """NEBULA: stereo Gaussian splatting in the cloud and on an accelerator.

From a scene and a head trace to both images, cycles, energy, area and Mbps.
"""
EPILOG = (
    "Exit status: 0 success; 2 something given is wrong or cannot be read or written; 1 a fault of "
    "the program; 130 interrupted. NEBULA_TRACEBACK=1 shows where an error came from."
)


@click.group(
    help=HELP, epilog=EPILOG, no_args_is_help=False, context_settings={"max_content_width": 100}
)
@click.version_option(package_name="nebula-splat", message="nebula %(version)s")
def cli() -> None:
    """The group of all commands."""


for command in (build_tree, search, stream):
    cli.add_command(command)


@cli.command()
@scene_options
@seed_option
@view_options
@trace_options
@baseline_option
@click.option("--method", type=METHODS, help="Stereo method.  [default: the accelerator's own]")
@accelerator_option
@click.option("--trace-fov", is_flag=True, help="Off-axis windows by the recording's half-angles.")
@click.option("--rate-mbps", type=POSITIVE, default=100.0, show_default=True, help="Link rate.")
@click.option("--latency-ms", type=NOT_NEGATIVE, default=20.0, show_default=True, help="One way.")
@paced_option
@threads_option
@out_option("out/simulate")
@click.option("--html/--no-html", default=True, show_default=True, help="Write report.html too.")
@json_option
def simulate(json_target: str | None, **values: Any) -> None:
    """Replay a head trace through everything and write a report."""
    from nebula.options import SimulateOptions

    execute("simulate", SimulateOptions, values, json_target)


@cli.command()
@scene_options
@seed_option
@view_options
@baseline_option
@method_option
@threads_option
@out_option("out/render")
@json_option
def render(json_target: str | None, **values: Any) -> None:
    """Render one stereo frame as PNG files."""
    from nebula.options import RenderOptions

    execute("render", RenderOptions, values, json_target)


@cli.command()
@scene_options
@seed_option
@view_options
@baseline_option
@click.option("--trace", metavar="NAME|CSV", help="Verify along a head trace, not the view alone.")
@click.option("--frames", type=COUNT, help="Of the trace.  [default: 12 with --trace, else 1]")
@click.option("--ladder", is_flag=True, help="From paper to exact, one fix after the other.")
@click.option("--isolate", is_flag=True, help="Exact with one defect at a time.")
@click.option("--hostile", is_flag=True, help="Paper and exact on scenes built to break them.")
@click.option(
    "--method",
    "methods",
    multiple=True,
    metavar="PRESET[,SWITCH=VALUE...]",
    help="Such as paper,rows=8; may be given several times.  [default: paper and exact]",
)
@click.option(
    "--tile",
    "tile_px",
    type=click.Choice(["4", "8", "16"]),
    default="4",
    show_default=True,
    help="Tile edge, pixels.",
)
@threads_option
@out_option("out/verify")
@json_option
@click.pass_context
def verify(context: click.Context, json_target: str | None, **values: Any) -> None:
    """Check stereo methods against an independent right eye, and say why pixels are wrong."""
    from nebula.options import VerifyOptions

    modes = [mode for mode in ("ladder", "isolate", "hostile") if values.pop(mode)]
    if len(modes) > 1 or (modes and values["methods"]):
        raise InputError("--ladder, --isolate, --hostile and --method exclude each other")
    values["mode"] = modes[0] if modes else None
    if modes == ["hostile"]:
        ours = {"hostile", "tile_px", "threads", "out", "json_target"}
        given = [p for p in context.command.params if _is_given(context, p) and p.name not in ours]
        if given:
            names = ", ".join(p.opts[0] for p in given)
            raise InputError(f"--hostile brings its own scenes and rigs; {names}: not of use")
    values["moving"] = values["trace"] is not None or (values["frames"] or 1) > 1
    values["frames"] = values["frames"] or (12 if values["moving"] else 1)
    values["tile_px"] = int(values["tile_px"])
    execute("verify", VerifyOptions, values, json_target)


@cli.command()
@click.argument("file", required=False)
@scene_options
@seed_option
@click.option("--verify", is_flag=True, help="Read every byte of a tree and check it.")
@json_option
def info(file: str | None, json_target: str | None, **values: Any) -> None:
    """Say what is in a scene or a tree; FILE is the same as --scene FILE."""
    from nebula.options import InfoOptions

    if file is not None and values["scene"] is not None:
        raise InputError("FILE and --scene name the same thing; give one of them")
    values["scene"] = values["scene"] or file
    execute("info", InfoOptions, values, json_target)


@cli.command()
@click.argument("source", metavar="IN")
@click.argument("out", metavar="OUT", type=click.Path(path_type=Path))
@click.option("--config", metavar="NAME|FILE", help="Level, up axis, view from configs/scenes/.")
@click.option("--level", type=click.IntRange(min=0), help="Level of a scene; 0 is the finest.")
@click.option(
    "--crop", metavar="X0,Y0,Z0:X1,Y1,Z1", help="Keep the means in this box, units of IN."
)
@click.option("--sh-degree", type=click.IntRange(0, 3), help="Drop the harmonics above.")
@click.option("--decimate-tau", "decimate_tau_px", type=NOT_NEGATIVE, help="LoD cut at a view, px.")
@view_option
@display_options
@click.option("--up", metavar="FROM:TO", help="Turn the scene, such as -y:+z.")
@click.option("--clamp", is_flag=True, help="Move values OUT cannot hold to its limits, counted.")
@threads_option
@json_option
def convert(source: str, up: str | None, json_target: str | None, **values: Any) -> None:
    """Write scene IN as OUT (.ply, .splat or .spz), whole or in part.

    Applied in this order: level, crop, SH degree, decimation, up axis. View and display serve the
    decimation.
    """
    from nebula.options import ConvertOptions, parse_up_change

    idle = [f"--{key.removesuffix('_deg')}" for key in VIEW_KEYS if values[key] is not None]
    if values["decimate_tau_px"] is None and idle:
        raise InputError(f"{', '.join(idle)}: of use for --decimate-tau only, which is not given")
    old, values["new_up"] = (None, None) if up is None else parse_up_change(up)
    execute("convert", ConvertOptions, values | {"scene": source, "up": old}, json_target)


@cli.command()
@accelerator_option
@click.option("--node", "node_nm", type=click.Choice(["16", "8"]), default="16", show_default=True)
@click.option(
    "--technology",
    type=click.Choice(["deepscaletool", "stillmaker_baas", "none"]),
    default="deepscaletool",
    show_default=True,
    help="Scaling model for a node other than 16 nm.",
)
@json_option
def area(json_target: str | None, **values: Any) -> None:
    """Print the silicon area of an accelerator, part by part."""
    from nebula.options import AreaOptions

    values["node_nm"] = float(values["node_nm"])
    execute("area", AreaOptions, values, json_target)


@cli.command()
@click.option(
    "--report", type=click.Path(path_type=Path), metavar="FILE", help="A run's report.json."
)
@json_option
def energy(json_target: str | None, **values: Any) -> None:
    """Print what every action costs, and the energy of a finished run."""
    from nebula.options import EnergyOptions

    execute("energy", EnergyOptions, values, json_target)


@cli.command(
    epilog="\b\nFigures:\n" + "\n".join(f"  {n:<19} {kind.about}" for n, kind in FIGURES.items())
)
@click.argument("name", metavar="NAME")
@scene_options
@seed_option
@view_options
@baseline_option
@click.option("--tree", type=click.Path(path_type=Path), metavar="DIR", help="Instead of a scene.")
@trace_option
@click.option("--tau", "tau_px", type=NOT_NEGATIVE, help="LoD, px of the display.  [default: 6]")
@click.option("--every", "search_every", type=COUNT, help="Frames per search.  [default: 4]")
@click.option("--frames", type=COUNT, help="Of every trace.  [default: the figure's own]")
@click.option("--shrink", type=COUNT, help="Pictures of 1/N of the display.  [default: 4]")
@threads_option
@out_option(None)
@json_option
def figure(
    name: str, config: str | None, json_target: str | None, threads: int | None, **values: Any
) -> None:
    """Measure a figure; write NAME.json, NAME.csv and NAME.png.

    Without a scene it measures its own few; real ones are looked for in $NEBULA_DATA. Figures of
    searches and streams take a tree of build-tree, or a scene, or make a dense city. The display
    is the prototype's 2064 x 2208 pixels, unless another is given.
    """
    from nebula.options import FigureOptions

    given = {key: values.pop(key) for key in SCENE_KEYS if key in values}
    values |= {"name": name, "config": config, "given": given, "threads": threads}
    execute("figure", FigureOptions, values, json_target)


def _is_given(context: click.Context, parameter: click.Parameter) -> bool:
    source = context.get_parameter_source(parameter.name or "")
    return source not in (None, click.core.ParameterSource.DEFAULT)
