"""Every shipped configuration loads, says where its numbers come from, and runs."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import arch
from arch import AcceleratorConfig, CostTable, Technology, analyse_frame, sourced_groups
from arch.provenance import Provenance, weakest
from gaussians.errors import InputError
from nebula.config import configs_root, load_config, load_yaml
from tests.arch.build import changed, client, random_frame

ACCELERATORS = sorted(
    path for path in configs_root().glob("*.yaml") if "volume_rendering_core" in load_yaml(path)
)


def test_arch_is_this_project() -> None:
    """The index holds an unrelated package of the same name."""
    assert Path(arch.__file__).resolve().parent.parent == Path(__file__).resolve().parents[2]


def test_both_presets_are_found() -> None:
    assert {"nebula", "gscore_nebula"} <= {path.stem for path in ACCELERATORS}


@pytest.mark.parametrize("path", ACCELERATORS, ids=lambda path: path.stem)
def test_accelerator_loads_and_runs(path: Path) -> None:
    config = load_config(AcceleratorConfig, path, "arch")
    assert config.name == path.stem
    work = random_frame(np.random.default_rng(0), 5, 7, 20, stereo=config.stereo is not None)
    timing = analyse_frame(config, work, client(work.front_end.submitted)).timing
    assert timing.cycles_per_frame > 0
    assert len(list(sourced_groups(config))) > 20


def test_every_number_of_the_price_list_has_a_source(
    costs: CostTable, technology: Technology
) -> None:
    paths = {group.path for group in (*sourced_groups(costs), *sourced_groups(technology))}
    assert {"operations[0]", "dram_rails[2]", "sram[7]", "radio", "deepscaletool"} <= paths


@pytest.mark.parametrize("key", ["source", "reference", "confidence"])
def test_group_without_a_source_is_refused(key: str, tmp_path: Path) -> None:
    text = (configs_root() / "nebula.yaml").read_text()
    clock = next(line for line in text.splitlines() if line.startswith("clock:"))
    kept = [part for part in clock[8:-1].split(", ") if not part.startswith(f"{key}:")]
    file = tmp_path / "nebula.yaml"
    file.write_text(text.replace(clock, "clock: {" + ", ".join(kept) + "}"))
    with pytest.raises(InputError, match=rf"arch.clock: missing key '{key}'"):
        load_config(AcceleratorConfig, file, "arch")


def test_numbers_outside_a_sourced_group_are_refused() -> None:
    @dataclasses.dataclass(frozen=True)
    class Bare:
        depth: int

    @dataclasses.dataclass(frozen=True)
    class Tables:
        rows: tuple[float, ...]

    with pytest.raises(InputError, match=r"Bare: numbers must carry a source"):
        list(sourced_groups(Bare(4)))
    with pytest.raises(InputError, match=r"rows: numbers must carry a source"):
        list(sourced_groups(Tables((1.0,))))


def test_every_config_class_with_numbers_carries_a_source() -> None:
    import arch.config
    import arch.costs
    import arch.memory.config
    import arch.memory.sram
    import arch.technology

    modules = (arch.config, arch.costs, arch.memory.config, arch.memory.sram, arch.technology)
    for module in modules:
        for cls in vars(module).values():
            if not (isinstance(cls, type) and dataclasses.is_dataclass(cls)):
                continue
            if cls.__name__ == "Memory":  # computed from a configuration, not one
                continue
            plain = [f.name for f in dataclasses.fields(cls) if f.type in ("int", "float")]
            assert not plain or issubclass(cls, Provenance), (cls, plain)


def test_values_are_checked(nebula: AcceleratorConfig) -> None:
    cases = [
        ("clock.source", "guess", r"Clock: source must be one of paper, .*, not 'guess'"),
        ("clock.confidence", "D", r"Clock: confidence must be one of A, B, C, M, not 'D'"),
        ("clock.reference", " ", r"Clock: reference must say where"),
        ("clock.frequency_ghz", 0.0, r"frequency_ghz must be a positive number, not 0.0"),
        ("projection_unit.units.count", 0, r"count must be an integer of at least 1, not 0"),
        ("sorting_unit.timing.network_width", 12, r"must be a power of two, not 12"),
        ("stereo.entries.organisation", "ring", r"must be one of rows, pool, not 'ring'"),
        ("dram.timing.t_rfc_ns", 4000.0, r"t_rfc_ns must be below t_refi_ns"),
    ]
    for path, value, message in cases:
        with pytest.raises(InputError, match=message):
            changed(nebula, path, value)
    compressed = changed(nebula, "splat_record.layout", "compressed_in_dram")
    with pytest.raises(InputError, match="needs a decoder"):
        changed(compressed, "decoder", None)


def test_weakest_confidence_wins() -> None:
    assert weakest("A", "M", "B") == "M"
    assert weakest("A", "B") == "B"
