"""The accelerator's configuration, its prices and the technology scaling, from configs/."""

from __future__ import annotations

import dataclasses

from arch import AcceleratorConfig, CostTable, Technology
from arch.technology import Model
from nebula.config import config_path, load_config


def load_accelerator(name: str) -> AcceleratorConfig:
    """A shipped accelerator (``nebula``, ``gscore_nebula``) or a YAML file of one's own."""
    path = config_path(name)
    return load_config(AcceleratorConfig, path, path.stem)


def load_costs() -> CostTable:
    """The price list of configs/technology/costs.yaml."""
    return load_config(CostTable, config_path("costs", "technology"), "costs")


def load_technology(model: Model | None = None) -> Technology:
    """The scaling models of configs/technology/scaling.yaml; ``model`` replaces its choice."""
    technology = load_config(Technology, config_path("scaling", "technology"), "scaling")
    if model is None:
        return technology
    return dataclasses.replace(
        technology, choice=dataclasses.replace(technology.choice, model=model)
    )
