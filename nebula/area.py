"""``nebula area``: the silicon area of an accelerator, part by part."""

from __future__ import annotations

import dataclasses

from arch import area
from nebula.hardware import load_accelerator, load_costs, load_technology
from nebula.options import AreaOptions
from nebula.output import CommandResult, text_table


def run(options: AreaOptions) -> CommandResult:
    """Parts, total and band at one node; ``--json`` gives the fields of ``arch.AreaReport``."""
    accelerator = load_accelerator(options.accelerator)
    technology = load_technology(options.technology)
    report = area(accelerator, load_costs(), technology, options.node_nm)
    rows = [
        [
            part.name.replace("_", " "),
            str(part.count),
            f"{part.unit_mm2:.4f}",
            f"{part.mm2:.4f}",
            f"{part.mm2 / report.total_mm2:.1%}",
            part.source,
            part.confidence,
            part.reference,
        ]
        for part in report.parts
    ]
    heads = ["part", "count", "mm² each", "mm²", "share", "source", "conf.", "reference"]
    low, high = report.band_mm2
    text = (
        f"{accelerator.name}: {report.total_mm2:.3f} mm² at {report.node_nm:g} nm "
        f"(scaling model {report.model}; models range from {low:.3f} to {high:.3f} mm²), "
        f"logic {report.logic_mm2:.3f} mm², SRAM {report.sram_mm2:.3f} mm², "
        "without DRAM interface\n\n" + text_table(heads, rows, numbers=(1, 2, 3, 4))
    )
    return CommandResult({"accelerator": accelerator.name, **dataclasses.asdict(report)}, text)
