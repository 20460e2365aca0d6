"""YAML files become validated dataclasses, or one line that says what must be what."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nebula.config
from gaussians.cameras import DISPLAYS, Display
from gaussians.errors import InputError
from nebula.config import config_path, data_root, load_config, load_dataclass, load_yaml
from nebula.options import CITY_LEAVES, GeneratedCity, SceneConfig, SceneOptions, scene_options


@dataclass(frozen=True)
class Buffer:
    rows: int
    capacity_kib: float
    organisation: Literal["rows", "pool"] = "rows"

    def __post_init__(self) -> None:
        if self.rows < 1:
            raise InputError(f"rows must be at least 1, not {self.rows}")


@dataclass(frozen=True)
class Core:
    buffer: Buffer
    name: str
    fast: bool
    sizes: tuple[int, ...] = ()
    pair: tuple[float, str] | None = None
    spare: Buffer | None = None
    either: str | float = "none"
    costs: dict[str, float] = field(default_factory=dict)
    buffers: tuple[Buffer, ...] = ()


GOOD: dict[str, Any] = {"buffer": {"rows": 4, "capacity_kib": 16}, "name": "vrc", "fast": True}


def test_a_mapping_becomes_a_dataclass() -> None:
    core = load_dataclass(
        Core,
        {
            **GOOD,
            "sizes": [1, 2],
            "pair": [1, "a"],
            "spare": {"rows": 1, "capacity_kib": 0.5, "organisation": "pool"},
            "either": 3,
            "costs": {"read": 1},
            "buffers": [{"rows": 2, "capacity_kib": 1}],
        },
        "arch.vrc",
    )
    assert core == Core(
        buffer=Buffer(4, 16.0),
        name="vrc",
        fast=True,
        sizes=(1, 2),
        pair=(1.0, "a"),
        spare=Buffer(1, 0.5, "pool"),
        either=3.0,
        costs={"read": 1.0},
        buffers=(Buffer(2, 1.0),),
    )
    assert type(core.buffer.capacity_kib) is float


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"buffer": {"rows": 4, "capacity_kib": 1, "row_count": 4}},
            "arch.vrc.buffer: unknown key 'row_count'; "
            "known keys are rows, capacity_kib, organisation",
        ),
        ({"buffer": {"rows": 4}}, "arch.vrc.buffer: missing key 'capacity_kib'"),
        ({"buffer": 4}, "arch.vrc.buffer: must be a group of keys, not 4"),
        ({"buffer": None}, "arch.vrc.buffer: must be a group of keys, not nothing"),
        ({"name": 4}, "arch.vrc.name: must be text, not 4"),
        ({"fast": 1}, "arch.vrc.fast: must be true or false, not 1"),
        ({"sizes": 4}, "arch.vrc.sizes: must be a list, not 4"),
        ({"sizes": [1, 2.5]}, "arch.vrc.sizes[1]: must be an integer, not 2.5"),
        ({"sizes": [True]}, "arch.vrc.sizes[0]: must be an integer, not True"),
        ({"pair": [1.0]}, "arch.vrc.pair: must be a list of 2, not of 1"),
        ({"pair": ["a", "b"]}, "arch.vrc.pair[0]: must be a number, not 'a'"),
        ({"spare": {"rows": 1}}, "arch.vrc.spare: missing key 'capacity_kib'"),
        ({"either": [1]}, "arch.vrc.either: must be a number, not a list"),
        ({"costs": {"read": "x"}}, "arch.vrc.costs.read: must be a number, not 'x'"),
        ({"buffers": [GOOD["buffer"], 3]}, "arch.vrc.buffers[1]: must be a group of keys, not 3"),
        (
            {"buffer": {"rows": 0, "capacity_kib": 1}},
            "arch.vrc.buffer: rows must be at least 1, not 0",
        ),
        (
            {"buffer": {"rows": 1, "capacity_kib": 1, "organisation": "heap"}},
            "arch.vrc.buffer.organisation: must be one of 'rows', 'pool', not 'heap'",
        ),
        (
            {"buffer": {"rows": 1, "capacity_kib": float("inf")}},
            "arch.vrc.buffer.capacity_kib: must be a finite number, not inf",
        ),
    ],
)
def test_a_wrong_mapping_is_refused_by_path(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as error:
        load_dataclass(Core, {**GOOD, **changes}, "arch.vrc")
    assert str(error.value) == message


texts = st.text("aé\n", max_size=3)
values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=6,
)


@settings(deadline=None)
@given(changes=st.dictionaries(st.sampled_from([f.name for f in dataclasses.fields(Core)]), values))
def test_anything_is_either_built_with_its_types_or_refused_in_one_line(
    changes: dict[str, Any],
) -> None:
    try:
        core = load_dataclass(Core, {**GOOD, **changes}, "core")
    except InputError as error:
        assert str(error).startswith("core")
        assert "\n" not in str(error)
        return
    assert type(core.fast) is bool
    assert all(type(size) is int for size in core.sizes)
    assert all(type(cost) is float for cost in core.costs.values())


# ---------------------------------------------------------------- YAML


def write(folder: Path, text: str) -> Path:
    path = folder / "config.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_yaml_has_the_core_types_only(tmp_path: Path) -> None:
    text = (
        "a: 1e-3\nb: no\nc: 1:30\nd: 2020-01-01\ne: -4\nf: true\ng:\nh: .5\ni: '7'\nj: -y\nk: ~\n"
    )
    loaded = load_yaml(write(tmp_path, text))
    assert loaded == {
        **{"a": 0.001, "b": "no", "c": "1:30", "d": "2020-01-01", "e": -4, "f": True, "g": None},
        **{"h": 0.5, "i": "7", "j": "-y", "k": None},
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\na: 2\n", r":2:1: key 'a' stands here twice"),
        ("x:\n  a: 1\n  b: 2\n  a: 3\n", r":4:3: key 'a' stands here twice"),
        ("1: a\n", r":1:1: a key must be text, not '1'"),
        ("true: a\n", r":1:1: a key must be text, not 'true'"),
        ("[1, 2]: a\n", r":1:1: a key must be text, not "),
        ("a: [1\n", r":2:1: expected ',' or ']'"),
        ("a: b: c\n", r":1:5: mapping values are not allowed here"),
        ("a: !!python/object:os.system x\n", r":1:4: could not determine a constructor"),
        ("", r": must hold keys and values, not nothing"),
        ("- 1\n- 2\n", r": must hold keys and values, not a list"),
        ("a: 1\n---\na: 2\n", r":2:1: but found another document"),
        ("a: \x00\n", r": must be YAML text in UTF-8"),
    ],
)
def test_wrong_yaml_is_refused_by_place(tmp_path: Path, text: str, message: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError, match=re.escape(str(path)) + message) as error:
        load_yaml(path)
    assert "!!python" not in str(error.value) or "constructor" in str(error.value)


def test_bytes_that_are_not_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_bytes(b"a: \xff\xfe")
    with pytest.raises(InputError, match="must be YAML text in UTF-8"):
        load_yaml(path)


# ---------------------------------------------------------------- finding files


def test_shipped_configs_are_found_by_name(tmp_path: Path, monkeypatch: Any) -> None:
    package = tmp_path / "site" / "nebula"
    (package.parent / "configs" / "scenes").mkdir(parents=True)
    monkeypatch.setattr(nebula.config, "__file__", str(package / "config.py"))
    (package.parent / "configs" / "scenes" / "hall.yaml").write_text("level: 1\n")
    assert config_path("hall", "scenes") == package.parent / "configs" / "scenes" / "hall.yaml"
    (package / "configs" / "scenes").mkdir(parents=True)  # an installed package carries its own
    (package / "configs" / "scenes" / "yard.yaml").write_text("level: 2\n")
    assert config_path("yard", "scenes") == package / "configs" / "scenes" / "yard.yaml"
    with pytest.raises(InputError, match=r"no configuration named 'hall'; .* or one of: yard"):
        config_path("hall", "scenes")
    for outside in ("../scenes/yard", "scenes/yard", ""):
        with pytest.raises(InputError, match="no configuration named"):
            config_path(outside, "scenes")


def test_a_configuration_file_of_ones_own_is_taken_as_it_is(tmp_path: Path) -> None:
    path = write(tmp_path, "level: 1\n")
    assert config_path(str(path)) == path
    with pytest.raises(InputError, match=r"absent\.yaml: no such configuration file"):
        config_path(str(tmp_path / "absent.yaml"))


def test_data_root_is_the_variable_or_data(monkeypatch: Any) -> None:
    monkeypatch.setenv("NEBULA_DATA", "/somewhere")
    assert data_root() == Path("/somewhere")
    monkeypatch.setenv("NEBULA_DATA", "")
    assert data_root() == Path("data")
    monkeypatch.delenv("NEBULA_DATA")
    assert data_root() == Path("data")


# ---------------------------------------------------------------- scene options


def options_of(folder: Path, text: str, **given: Any) -> SceneOptions:
    return scene_options(str(write(folder, text)), given)


def test_without_anything_it_is_the_city() -> None:
    options = scene_options(None, {})
    assert options == SceneOptions(
        scene=GeneratedCity(CITY_LEAVES),
        level=None,
        up=None,
        units_per_metre=1.0,
        view=None,
        near_m=0.2,
        display=Display.from_fov(1024, 1024, 96.0),
        trace="walk",
    )


def test_files_of_a_configuration_lie_under_the_data_root(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setenv("NEBULA_DATA", str(tmp_path / "real"))
    text = "scene: donut/fused.ply\ntrace: head.csv\nnear_m: 0.01\nup: +z\nlevel: 2\n"
    with pytest.raises(InputError, match=r"scene: no file .*fused\.ply; \$NEBULA_DATA must be"):
        options_of(tmp_path, text)
    (tmp_path / "real" / "donut").mkdir(parents=True)
    (tmp_path / "real" / "donut" / "fused.ply").touch()
    with pytest.raises(InputError, match=r"trace: no file .*head\.csv"):
        options_of(tmp_path, text)
    (tmp_path / "real" / "head.csv").touch()
    options = options_of(tmp_path, text)
    assert options.scene == tmp_path / "real" / "donut" / "fused.ply"
    assert options.trace == str(tmp_path / "real" / "head.csv")
    assert (options.near_m, options.up, options.level) == (0.01, "+z", 2)


def test_the_command_line_wins_over_the_file(tmp_path: Path) -> None:
    text = "scene: {city: 500}\nnear_m: 0.5\nup: -z\ndisplay: quest3\n"
    options = options_of(tmp_path, text)
    assert options.scene == GeneratedCity(500)
    assert options.display == DISPLAYS["quest3"]
    options = options_of(tmp_path, text, near_m=1.5, city_leaves=7, fov_deg=60.0, view=None)
    assert (options.near_m, options.up, options.scene) == (1.5, "-z", GeneratedCity(7))
    assert options.display == Display.from_fov(1024, 1024, 60.0)
    options = options_of(tmp_path, text, scene="here.ply", display="prototype", trace="x.csv")
    assert (options.scene, options.trace) == (Path("here.ply"), "x.csv")
    assert options.display == DISPLAYS["prototype"]


@pytest.mark.parametrize(
    ("text", "given", "message"),
    [
        ("scenes: x\n", {}, "config: unknown key 'scenes'; known keys are scene, level, up"),
        ("up: up\n", {}, "config.up: must be one of '+x', '-x'"),
        ("near_m: x\n", {}, "config.near_m: must be a number, not 'x'"),
        ("scene: {town: 3}\n", {}, "config.scene: unknown key 'town'; known keys are city"),
        ("display: tv\n", {}, "display must be one of prototype, quest3, not 'tv'"),
        ("display: quest3\nwidth: 3\n", {}, "config: display fixes width, height and fov_deg"),
        ("level: 0\n", {"display": "quest3", "width": 5}, "--display quest3 fixes width"),
        ("level: 0\n", {"width": 0}, "display width must be an integer from 1"),
        ("level: 0\n", {"scene": "a", "city_leaves": 5}, "--scene and --city-leaves exclude"),
    ],
)
def test_wrong_scene_options_are_refused(
    tmp_path: Path, text: str, given: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        options_of(tmp_path, text, **given)


def test_a_scene_file_says_only_what_it_says(tmp_path: Path) -> None:
    assert load_config(SceneConfig, write(tmp_path, "level: 3\n"), "s") == SceneConfig(level=3)
