"""Runs a command on the values of its options: the options object, the result, printing, --json."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import click

from nebula.output import STDOUT, CommandResult, check_json_target, write_json

VIEW_KEYS = ("view", "fov_deg", "width", "height", "display")
SCENE_KEYS = (
    *("scene", "city_leaves", "level", "up", "units_per_metre", "near_m", "trace"),
    *VIEW_KEYS,
)


def execute(
    name: str, options: Callable[..., Any], values: dict[str, Any], json_target: str | None
) -> None:
    """Run ``nebula.<name>.run`` on its options object; print and write what it returns."""
    check_json_target(json_target)
    threads = values.pop("threads", None)
    if "view" in values or "level" in values:
        from nebula.options import scene_options

        given = {key: values.pop(key) for key in SCENE_KEYS if key in values}
        values["scene"] = scene_options(values.pop("config", None), given)
    if threads is not None:
        from gaussians.parallel import set_threads

        set_threads(threads)
    result: CommandResult = import_module(f"nebula.{name}").run(options(**values))
    if json_target != STDOUT:
        click.echo(result.text)
    if json_target is not None:
        write_json(json_target, result.data)
