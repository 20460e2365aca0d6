"""``nebula energy``: what everything costs, and where the energy of a finished run went."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from arch import CostTable, SourcedGroup, sourced_groups
from gaussians.errors import InputError
from nebula.hardware import load_costs
from nebula.options import EnergyOptions
from nebula.output import CommandResult, text_table
from nebula.report import validate_report


def run(options: EnergyOptions) -> CommandResult:
    """The price list with its sources; with a report, the breakdown of that run as well."""
    costs = load_costs()
    prices = list(_prices(costs))
    heads = ["price", "values", "source", "conf.", "reference"]
    rows = [[p.path, p.values, p.source, p.confidence, p.reference] for p in prices]
    text = f"prices of {costs.name}\n\n{text_table(heads, rows)}"
    data: dict[str, Any] = {
        "costs": costs.name,
        "prices": [dataclasses.asdict(price) for price in prices],
        "run": None,
    }
    if options.report is not None:
        data["run"] = read_report(options.report)["energy"]
        text += f"\n\n{_breakdown(data['run'], options.report)}"
    return CommandResult(data, text)


def _prices(costs: CostTable) -> Iterator[SourcedGroup]:
    """Every group of the price list; an action shows the operations it is made of."""
    operations = {
        f"actions[{index}]": ", ".join(f"{n:g} {name}" for name, n in action.operations.items())
        for index, action in enumerate(costs.actions)
    }
    for group in sourced_groups(costs):
        made_of = operations.get(group.path)
        values = f"{group.values}: {made_of}" if made_of else group.values
        yield dataclasses.replace(group, values=values)


def read_report(path: Path) -> dict[str, Any]:
    """A report.json that follows the schema; InputError otherwise."""
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path}: must be a report in JSON ({error})") from error
    validate_report(report, str(path))
    return dict(report)


def _breakdown(energy: dict[str, Any], path: Path) -> str:
    parts = {**energy["parts"], "radio": energy["radio"]["mj_per_frame"]}
    total = energy["total_mj_per_frame"]
    rows = [
        [name.replace("_", " "), f"{value:.4f}", f"{value / total:.1%}" if total else ""]
        for name, value in sorted(parts.items(), key=lambda part: -part[1])
    ]
    table = text_table(["part", "mJ per frame", "share"], rows, numbers=(1, 2))
    return f"{path}: {total:.3f} mJ per frame, {energy['power_mw']:.0f} mW\n\n{table}"
