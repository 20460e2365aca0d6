"""Area = sum of parts x counts, each part scaled from the node it was found at."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

from arch.config import AcceleratorConfig
from arch.costs import CostTable
from arch.memory.sram import macro, memories
from arch.provenance import weakest
from arch.technology import Model, Technology


@dataclass(frozen=True)
class AreaPart:
    """``count`` instances of one part."""

    name: str
    kind: Literal["logic", "sram", "integration"]
    count: int
    unit_mm2: float  # of one instance, at the report's node
    mm2: float
    node: str
    source: str
    reference: str
    confidence: str


@dataclass(frozen=True)
class AreaReport:
    """Area of the accelerator without DRAM interface; the total is the sum of the parts."""

    node_nm: float
    model: str
    parts: tuple[AreaPart, ...]
    total_mm2: float
    logic_mm2: float
    sram_mm2: float
    band_mm2: tuple[float, float]  # over the scaling models


def area(
    config: AcceleratorConfig,
    costs: CostTable,
    technology: Technology,
    node_nm: float | None = None,
) -> AreaReport:
    """Area at ``node_nm`` (default: the technology's area node), by the technology's chosen model.

    Logic scales by the model's area factor, SRAM by the cell area. The band is the smallest and
    largest total over all models. Raises InputError for a component without a price, a node or a
    memory size outside the tables.
    """
    node = node_nm or technology.choice.area_node_nm
    totals = []
    for model in technology.band_models():
        parts = _parts(config, costs, technology, node, model)
        totals.append(math.fsum(part.mm2 for part in parts))
    chosen = _parts(config, costs, technology, node, technology.choice.model)
    return AreaReport(
        node,
        technology.choice.model,
        chosen,
        math.fsum(part.mm2 for part in chosen),
        math.fsum(part.mm2 for part in chosen if part.kind == "logic"),
        math.fsum(part.mm2 for part in chosen if part.kind == "sram"),
        (min(totals), max(totals)),
    )


def with_cores(config: AcceleratorConfig, cores: int) -> AcceleratorConfig:
    """The same accelerator with another number of volume rendering cores (16 RUs each)."""
    core = config.volume_rendering_core
    units = dataclasses.replace(core.units, count=cores)
    return dataclasses.replace(config, volume_rendering_core=dataclasses.replace(core, units=units))


def logic_counts(config: AcceleratorConfig) -> dict[str, int]:
    """Instances of every logic component that is built."""
    cores = config.volume_rendering_core.units.count
    counts = {
        "subgraph_unit": config.subgraph_unit.units.count,
        "projection_unit": config.projection_unit.units.count,
        "binning_unit": config.binning_unit.units.count,
        "sorting_unit": config.sorting_unit.units.count,
        "rendering_unit": cores * config.volume_rendering_core.rendering_units.per_core,
    }
    if config.stereo:
        counts |= {"stereo_reprojection_unit": cores, "merge_unit": cores}
    if config.decoder:
        counts["decoder"] = 1
    return counts


def _parts(
    config: AcceleratorConfig, costs: CostTable, technology: Technology, node: float, model: Model
) -> tuple[AreaPart, ...]:
    parts = [
        _logic_part(name, count, costs, technology, node, model)
        for name, count in logic_counts(config).items()
    ]
    for memory in memories(config):
        cell = macro(costs.sram, memory.macro_kib, memory.ports)
        unit = cell.area_mm2 * technology.sram_area_factor(cell.node_nm, node, model)
        reference = f"{cell.reference}; scaled by cell area ({technology.sram_bitcell.reference})"
        confidence = weakest(cell.confidence, technology.sram_bitcell.confidence)
        parts.append(
            AreaPart(
                memory.name, "sram", memory.macros, unit, unit * memory.macros,
                _sram_label(technology, cell.node_nm, node), "derived", reference, confidence,
            )
        )  # fmt: skip
    share = costs.integration
    whole = math.fsum(part.mm2 for part in parts) * share.share
    label = f"{node:g} nm" if model != "none" else "as found"
    parts.append(
        AreaPart(
            "integration", "integration", 1, whole, whole, label,
            share.source, share.reference, share.confidence,
        )
    )  # fmt: skip
    return tuple(parts)


def _logic_part(
    name: str, count: int, costs: CostTable, technology: Technology, node: float, model: Model
) -> AreaPart:
    cost = costs.area_of(name)
    unit = cost.mm2 * technology.factor("area", cost.node_nm, node, model)
    return AreaPart(
        name, "logic", count, unit, unit * count,
        technology.node_label(cost.node_nm, node), cost.source, cost.reference, cost.confidence,
    )  # fmt: skip


def _sram_label(technology: Technology, from_nm: float, to_nm: float) -> str:
    if technology.choice.model == "none" or from_nm == to_nm:
        return f"{from_nm:g} nm"
    return f"{to_nm:g} nm (cell area, from {from_nm:g} nm)"
