"""``nebula energy``: what everything costs, and where the energy of a finished run went."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from arch import sourced_groups
from gaussians.errors import InputError
from nebula.hardware import load_costs
from nebula.options import EnergyOptions
from nebula.output import CommandResult, text_table
from nebula.report import validate_report


def run(options: EnergyOptions) -> CommandResult:
    """The price list with its sources; with a report, the breakdown of that run as well."""
    costs = load_costs()
    prices = list(sourced_groups(costs))
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
