"""Energy of a frame = activity x prices + time x standing power.

On-chip parts are scaled to the report node by the named model; DRAM and radio are not on the chip
and do not scale. Each part carries the weakest confidence among the numbers it is made of.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from arch.activity import Activity
from arch.area import area
from arch.config import AcceleratorConfig
from arch.costs import CostTable
from arch.memory.dram_energy import DramEnergy, dram_energy
from arch.memory.sram import MEMORY_COUNTERS, Memory, macro, memories
from arch.provenance import weakest
from arch.results import FrameTiming
from arch.technology import Model, Technology

MJ_PER_PJ = 1e-9
MODEL_REFERENCE = {
    "deepscaletool": "scaled with DeepScaleTool",
    "stillmaker_baas": "scaled with Stillmaker and Baas",
    "none": "not scaled",
}


@dataclass(frozen=True)
class EnergyPart:
    """One line of the bill."""

    name: str
    component: str
    kind: Literal["dynamic", "static"]
    value_mj: float
    node: str
    source: str
    reference: str
    confidence: str


@dataclass(frozen=True)
class EnergyReport:
    """Energy of one stereo frame; the total is the sum of all parts, radio included."""

    node_nm: float
    model: str
    parts: tuple[EnergyPart, ...]
    total_mj_per_frame: float
    on_chip_mj_per_frame: float
    dram_mj_per_frame: float
    radio_mj_per_frame: float
    band_mj_per_frame: tuple[float, float]  # over the scaling models
    mean_power_mw: float


@dataclass(frozen=True)
class _Bill:
    """What the parts are computed from."""

    config: AcceleratorConfig
    activity: Activity
    timing: FrameTiming
    costs: CostTable
    technology: Technology
    node_nm: float
    model: Model

    def scale(self, from_nm: float) -> float:
        return self.technology.factor("energy", from_nm, self.node_nm, self.model)

    def label(self, from_nm: float) -> str:
        return self.technology.node_label(from_nm, self.node_nm)

    @property
    def frame_s(self) -> float:
        return self.timing.frame_ms * 1e-3


def frame_energy(
    config: AcceleratorConfig,
    activity: Activity,
    timing: FrameTiming,
    costs: CostTable,
    technology: Technology,
    node_nm: float | None = None,
) -> EnergyReport:
    """Energy of the frame, part by part, at ``node_nm`` (default: the technology's energy node).

    The point value uses the technology's chosen model; the band is the smallest and largest total
    over all models. Raises InputError for a node or a memory size outside the tables.
    """
    node = node_nm or technology.choice.energy_node_nm
    bills = {
        model: _parts(_Bill(config, activity, timing, costs, technology, node, model))
        for model in technology.band_models()
    }
    parts = bills[technology.choice.model]
    totals = [math.fsum(part.value_mj for part in bill) for bill in bills.values()]
    total = math.fsum(part.value_mj for part in parts)
    radio = _sum(parts, "radio")
    memory = _sum(parts, "dram")
    return EnergyReport(
        node,
        technology.choice.model,
        parts,
        total,
        math.fsum(p.value_mj for p in parts if p.component not in ("dram", "radio")),
        memory,
        radio,
        (min(totals), max(totals)),
        total / (timing.frame_ms * 1e-3),
    )


def _sum(parts: tuple[EnergyPart, ...], component: str) -> float:
    return math.fsum(part.value_mj for part in parts if part.component == component)


def _parts(bill: _Bill) -> tuple[EnergyPart, ...]:
    logic = _logic_parts(bill)
    sram = [part for memory in memories(bill.config) for part in _sram_parts(bill, memory)]
    dynamic = math.fsum(p.value_mj for p in (*logic, *sram) if p.kind == "dynamic")
    off_chip = (*_dram_parts(bill), _radio_part(bill))
    return (*logic, *sram, *_overhead_parts(bill, dynamic), *off_chip)


def _logic_parts(bill: _Bill) -> list[EnergyPart]:
    """Counter x operations x library."""
    parts = []
    for action in bill.costs.actions:
        leaves = [bill.costs.operation(name) for name in action.operations]
        pj = math.fsum(
            count * leaf.value * bill.scale(leaf.node_nm)
            for leaf, count in zip(leaves, action.operations.values(), strict=True)
        )
        references = dict.fromkeys((action.reference, *(leaf.reference for leaf in leaves)))
        references[MODEL_REFERENCE[bill.model]] = None
        parts.append(
            EnergyPart(
                action.counter,
                action.component,
                "dynamic",
                bill.activity[action.counter] * pj * MJ_PER_PJ,
                bill.label(leaves[0].node_nm),
                "derived",
                "; ".join(references),
                weakest(action.confidence, *(leaf.confidence for leaf in leaves)),
            )
        )
    return parts


def _sram_parts(bill: _Bill, memory: Memory) -> list[EnergyPart]:
    """Reads, writes and leakage of one memory."""
    cell = macro(bill.costs.sram, memory.macro_kib, memory.ports)
    scale = bill.scale(cell.node_nm)
    reads, writes = MEMORY_COUNTERS[memory.name]
    lines: list[tuple[str, Literal["dynamic", "static"], float]] = [
        (reads, "dynamic", bill.activity[reads] * cell.read_pj * scale * MJ_PER_PJ),
    ]
    if writes:
        energy = bill.activity[writes] * cell.write_pj * scale * MJ_PER_PJ
        lines.append((writes, "dynamic", energy))
    leakage = memory.macros * cell.leakage_mw * bill.frame_s * scale
    lines.append((f"{memory.name}_leakage", "static", leakage))
    reference = f"{cell.reference}; {MODEL_REFERENCE[bill.model]}"
    label = bill.label(cell.node_nm)
    return [
        EnergyPart(name, memory.name, kind, value, label, "derived", reference, cell.confidence)
        for name, kind, value in lines
    ]


def _overhead_parts(bill: _Bill, dynamic_mj: float) -> list[EnergyPart]:
    """Clock tree, interconnect and leakage of logic: stated shares, not measured."""
    shares = bill.costs.overheads
    logic_mm2 = area(bill.config, bill.costs, bill.technology, shares.node_nm).logic_mm2
    leakage = (
        shares.logic_leakage_mw_per_mm2 * logic_mm2 * bill.frame_s * bill.scale(shares.node_nm)
    )
    lines: list[tuple[str, Literal["dynamic", "static"], float]] = [
        ("clock_tree", "dynamic", dynamic_mj * shares.clock_share),
        ("interconnect", "dynamic", dynamic_mj * shares.interconnect_share),
        ("logic_leakage", "static", leakage),
    ]
    label = bill.label(shares.node_nm)
    return [
        EnergyPart(
            name, "overhead", kind, value, label, shares.source, shares.reference, shares.confidence
        )
        for name, kind, value in lines
    ]


def _dram_parts(bill: _Bill) -> list[EnergyPart]:
    """Activation, read, write, input/output, standby and refresh from the IDD currents."""
    costs, activity = bill.costs, bill.activity
    device: DramEnergy = dram_energy(bill.config.dram, costs.dram_rails)
    read_bits, write_bits = 8 * activity["dram_bytes_read"], 8 * activity["dram_bytes_written"]
    channels = bill.config.dram.channels.count
    standing_mw = channels * device.active_standby_mw
    refresh_mw = channels * device.refresh_mw
    rail = costs.dram_rails[0]
    core = ("derived", rail.reference, rail.confidence)
    io = (costs.dram_io.source, costs.dram_io.reference, costs.dram_io.confidence)
    lines: list[tuple[str, Literal["dynamic", "static"], float, tuple[str, str, str]]] = [
        ("dram_activations", "dynamic", activity["dram_activations"] * device.activate_pj, core),
        ("dram_bytes_read", "dynamic", read_bits * device.read_pj_per_bit, core),
        ("dram_bytes_written", "dynamic", write_bits * device.write_pj_per_bit, core),
        ("dram_io", "dynamic", (read_bits + write_bits) * costs.dram_io.value, io),
        ("dram_standby", "static", standing_mw * bill.frame_s / MJ_PER_PJ, core),
        ("dram_refresh", "static", refresh_mw * bill.frame_s / MJ_PER_PJ, core),
    ]
    return [
        EnergyPart(name, "dram", kind, pj * MJ_PER_PJ, "off chip", *sources)
        for name, kind, pj, sources in lines
    ]


def _radio_part(bill: _Bill) -> EnergyPart:
    radio = bill.costs.radio
    energy = bill.activity["radio_bytes_received"] * radio.nj_per_byte * 1e3 * MJ_PER_PJ
    return EnergyPart(
        "radio_bytes_received",
        "radio",
        "dynamic",
        energy,
        "off chip",
        radio.source,
        radio.reference,
        radio.confidence,
    )
