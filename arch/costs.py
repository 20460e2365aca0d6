"""The price list: energy per operation and access, area per part, DRAM currents, static shares.

Logic operations come from one library alone (Horowitz, 45 nm); values of another library, which can
differ by an order of magnitude, must not be added to it. File: configs/technology/costs.yaml.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from arch.activity import COUNTERS
from arch.memory.sram import MEMORY_COUNTERS, SramMacro
from arch.provenance import Provenance
from gaussians.errors import InputError

# Priced from DRAM currents and the radio, not from the operation library.
OUTSIDE_COUNTERS = (
    "radio_bytes_received",
    "dram_activations",
    "dram_bytes_read",
    "dram_bytes_written",
)
LOGIC_COMPONENTS = (
    "decoder",
    "subgraph_unit",
    "projection_unit",
    "binning_unit",
    "sorting_unit",
    "rendering_unit",
    "stereo_reprojection_unit",
    "merge_unit",
)


@dataclass(frozen=True, kw_only=True)
class LeafCost(Provenance):
    """One number of the library."""

    name: str
    value: float
    unit: Literal["pJ", "pJ/bit", "nJ/B"]
    node_nm: float
    voltage_v: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("value", "node_nm", "voltage_v")


@dataclass(frozen=True, kw_only=True)
class ActionCost(Provenance):
    """The operations that one count of a counter stands for."""

    counter: str
    component: str
    operations: dict[str, float]


@dataclass(frozen=True, kw_only=True)
class DramRail(Provenance):
    """Currents of one x32 device on one supply, in mA (JEDEC states)."""

    name: str
    voltage_v: float
    idd0_ma: float
    idd2n_ma: float
    idd3n_ma: float
    idd4r_ma: float
    idd4w_ma: float
    idd5_ma: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("voltage_v", "idd0_ma", "idd3n_ma", "idd4r_ma", "idd4w_ma", "idd5_ma")
        self.require_not_negative("idd2n_ma")


@dataclass(frozen=True, kw_only=True)
class RadioCost(Provenance):
    """Energy of the wireless link."""

    nj_per_byte: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("nj_per_byte")


@dataclass(frozen=True, kw_only=True)
class OverheadShares(Provenance):
    """What no counter sees: clock tree, interconnect, leakage of logic."""

    clock_share: float  # of the dynamic energy on chip
    interconnect_share: float  # of the dynamic energy on chip
    logic_leakage_mw_per_mm2: float
    node_nm: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_not_negative("clock_share", "interconnect_share", "logic_leakage_mw_per_mm2")
        self.require_positive("node_nm")


@dataclass(frozen=True, kw_only=True)
class AreaCost(Provenance):
    """Area of one instance of a logic component."""

    component: str
    mm2: float
    node_nm: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("mm2", "node_nm")


@dataclass(frozen=True, kw_only=True)
class IntegrationShare(Provenance):
    """Top-level routing, control and clock tree, as a share of the sum of the parts."""

    share: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_not_negative("share")


@dataclass(frozen=True)
class CostTable:
    """All prices; InputError where a counter or component has no price, two, or is unknown."""

    name: str
    operations: tuple[LeafCost, ...]
    actions: tuple[ActionCost, ...]
    sram: tuple[SramMacro, ...]
    dram_rails: tuple[DramRail, ...]
    dram_io: LeafCost
    radio: RadioCost
    overheads: OverheadShares
    areas: tuple[AreaCost, ...]
    integration: IntegrationShare

    def __post_init__(self) -> None:
        memory = [name for names in MEMORY_COUNTERS.values() for name in names if name]
        priced = [action.counter for action in self.actions] + memory + list(OUTSIDE_COUNTERS)
        _must_match(self.name, "counter", priced, tuple(COUNTERS))
        components = [area.component for area in self.areas]
        _must_match(self.name, "area component", components, LOGIC_COMPONENTS)
        for action in self.actions:
            for operation in action.operations:
                self.operation(operation)

    def operation(self, name: str) -> LeafCost:
        """The library's entry of this name; InputError when there is none."""
        for leaf in self.operations:
            if leaf.name == name:
                return leaf
        known = ", ".join(leaf.name for leaf in self.operations)
        raise InputError(f"{self.name}: no operation '{name}'; known operations are {known}")

    def area_of(self, component: str) -> AreaCost:
        """Area of one instance of a component; InputError when it has no price."""
        for area in self.areas:
            if area.component == component:
                return area
        raise InputError(f"{self.name}: component '{component}' must have an area")


def _must_match(table: str, what: str, priced: list[str], known: tuple[str, ...]) -> None:
    """Raise InputError unless every known name is priced exactly once and nothing else is."""
    for name in priced:
        if name not in known:
            raise InputError(f"{table}: {what} '{name}' has a price but nobody counts it")
        if priced.count(name) > 1:
            raise InputError(
                f"{table}: {what} '{name}' must have one price, not {priced.count(name)}"
            )
    for name in known:
        if name not in priced:
            raise InputError(f"{table}: {what} '{name}' must have a price")
