"""``nebula figure``: measure one figure and write its numbers and its picture."""

from __future__ import annotations

from nebula.figures import figure_module
from nebula.figures.output import require_matplotlib, write_figure
from nebula.options import FigureOptions
from nebula.output import CommandResult, OutputDirectory


def run(options: FigureOptions) -> CommandResult:
    """Write NAME.json, NAME.csv and NAME.png into the output directory.

    Raises InputError for an unknown name, an option without use for it, and without matplotlib.
    """
    module = figure_module(options)
    require_matplotlib()
    with OutputDirectory(options.out) as out:
        figure = module.make(options)
        data = write_figure(out, options.name, figure)
    picture = options.out / f"{options.name}.png"
    return CommandResult(data, f"{figure.title}\n{figure.text}\n{picture}")
