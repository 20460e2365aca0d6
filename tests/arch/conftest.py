"""Shipped configurations, loaded once."""

from __future__ import annotations

import pytest

from arch import AcceleratorConfig, CostTable, Technology
from nebula.config import configs_root, load_config


@pytest.fixture(scope="session")
def nebula() -> AcceleratorConfig:
    return load_config(AcceleratorConfig, configs_root() / "nebula.yaml", "arch")


@pytest.fixture(scope="session")
def gscore() -> AcceleratorConfig:
    return load_config(AcceleratorConfig, configs_root() / "gscore_nebula.yaml", "arch")


@pytest.fixture(scope="session")
def costs() -> CostTable:
    return load_config(CostTable, configs_root() / "technology" / "costs.yaml", "costs")


@pytest.fixture(scope="session")
def technology() -> Technology:
    return load_config(Technology, configs_root() / "technology" / "scaling.yaml", "technology")
