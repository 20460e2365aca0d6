"""Technology scaling: what an area, a delay or an energy becomes at another node, and by whose
model.

Two published models disagree by a factor of 2 to 5 between the same nodes, so every result names
its model and carries the band over models. Nodes between those of a table are interpolated, log
value over log node size (neither model has 8 nm; DeepScaleTool has no 16 nm). Nothing is
extrapolated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from arch.provenance import Provenance
from gaussians.errors import InputError

Model = Literal["deepscaletool", "stillmaker_baas", "none"]
Quantity = Literal["area", "delay", "energy"]
MODELS: tuple[Model, ...] = ("deepscaletool", "stillmaker_baas")


def _check_nodes(name: str, nodes: tuple[float, ...], *columns: tuple[float, ...]) -> None:
    if len(nodes) < 2 or list(nodes) != sorted(set(nodes), reverse=True) or nodes[-1] <= 0:
        raise InputError(f"{name}: nodes_nm must be at least two positive sizes, largest first")
    if any(len(column) != len(nodes) for column in columns):
        raise InputError(f"{name}: every column must have {len(nodes)} values, one per node")


@dataclass(frozen=True, kw_only=True)
class DeepScaleTable(Provenance):
    """DeepScaleTool: relative values per node; only ratios within a column mean anything."""

    nodes_nm: tuple[float, ...]
    area: tuple[float, ...]
    delay: tuple[float, ...]
    energy: tuple[float, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_nodes("DeepScaleTable", self.nodes_nm, self.area, self.delay, self.energy)

    def value(self, quantity: Quantity, node_nm: float) -> float:
        """Relative area, delay or energy at this node."""
        column = {"area": self.area, "delay": self.delay, "energy": self.energy}[quantity]
        return interpolate(node_nm, self.nodes_nm, column)


@dataclass(frozen=True, kw_only=True)
class StillmakerTable(Provenance):
    """Stillmaker and Baas: area factors, and polynomials in the supply voltage (high performance).

    Energy a V^2 + b V + c, delay d3 V^3 + d2 V^2 + d1 V + d0, each at the node's nominal voltage.
    """

    nodes_nm: tuple[float, ...]
    voltage_v: tuple[float, ...]
    area: tuple[float, ...]
    energy_abc: tuple[tuple[float, float, float], ...]
    delay_d3210: tuple[tuple[float, float, float, float], ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_nodes("StillmakerTable", self.nodes_nm, self.voltage_v, self.area)
        if not len(self.energy_abc) == len(self.delay_d3210) == len(self.nodes_nm):
            raise InputError(
                f"StillmakerTable: every column must have {len(self.nodes_nm)} values, one per node"
            )

    def value(self, quantity: Quantity, node_nm: float) -> float:
        """Relative area, delay or energy at this node and its nominal voltage."""
        if quantity == "area":
            return interpolate(node_nm, self.nodes_nm, self.area)
        polynomials = self.energy_abc if quantity == "energy" else self.delay_d3210
        column = tuple(_polynomial(p, v) for p, v in zip(polynomials, self.voltage_v, strict=True))
        return interpolate(node_nm, self.nodes_nm, column)


@dataclass(frozen=True, kw_only=True)
class BitcellTable(Provenance):
    """Area of a six-transistor SRAM cell: SRAM does not shrink like logic."""

    nodes_nm: tuple[float, ...]
    area_um2: tuple[float, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_nodes("BitcellTable", self.nodes_nm, self.area_um2)


@dataclass(frozen=True, kw_only=True)
class TechnologyChoice(Provenance):
    """Which model gives the point value, and the nodes results are reported at."""

    model: Model
    area_node_nm: float
    energy_node_nm: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_choice("model", (*MODELS, "none"))
        self.require_positive("area_node_nm", "energy_node_nm")


@dataclass(frozen=True)
class Technology:
    """Both scaling models, the SRAM cell table, and the choice among them."""

    choice: TechnologyChoice
    deepscaletool: DeepScaleTable
    stillmaker_baas: StillmakerTable
    sram_bitcell: BitcellTable

    def factor(
        self, quantity: Quantity, from_nm: float, to_nm: float, model: Model | None = None
    ) -> float:
        """What a value at ``from_nm`` is multiplied by at ``to_nm``; 1 for the model `none`.

        Raises InputError for a node outside the model's table.
        """
        name = model or self.choice.model
        if name == "none" or from_nm == to_nm:
            return 1.0
        table = self.deepscaletool if name == "deepscaletool" else self.stillmaker_baas
        return table.value(quantity, to_nm) / table.value(quantity, from_nm)

    def sram_area_factor(self, from_nm: float, to_nm: float, model: Model | None = None) -> float:
        """Ratio of SRAM cell areas; 1 for the model `none`."""
        if (model or self.choice.model) == "none" or from_nm == to_nm:
            return 1.0
        cell = self.sram_bitcell
        return interpolate(to_nm, cell.nodes_nm, cell.area_um2) / interpolate(
            from_nm, cell.nodes_nm, cell.area_um2
        )

    def band_models(self) -> tuple[Model, ...]:
        """The models whose spread is the band of a result; the chosen one is always among them."""
        return tuple(dict.fromkeys((*MODELS, self.choice.model)))

    def node_label(self, from_nm: float, to_nm: float) -> str:
        """For example "8 nm (deepscaletool from 45 nm)"."""
        if self.choice.model == "none" or from_nm == to_nm:
            return f"{from_nm:g} nm"
        return f"{to_nm:g} nm ({self.choice.model} from {from_nm:g} nm)"


def interpolate(node_nm: float, nodes: tuple[float, ...], values: tuple[float, ...]) -> float:
    """Value at a node: the table's own at its nodes, log-log linear between, InputError outside."""
    if node_nm in nodes:
        return values[nodes.index(node_nm)]
    if not nodes[-1] < node_nm < nodes[0]:
        raise InputError(
            f"technology node must lie in {nodes[-1]:g}..{nodes[0]:g} nm, not {node_nm:g}"
        )
    below = next(i for i, node in enumerate(nodes) if node < node_nm)
    high, low = nodes[below - 1], nodes[below]
    share = math.log(node_nm / low) / math.log(high / low)
    return values[below] * (values[below - 1] / values[below]) ** share


def _polynomial(coefficients: tuple[float, ...], voltage: float) -> float:
    """Highest power first."""
    value = 0.0
    for coefficient in coefficients:
        value = value * voltage + coefficient
    return value
