"""Configuration files: YAML to validated frozen dataclasses. The only file that knows YAML.

A YAML file holds data only: YAML 1.2 core types (so ``1e-3`` is a number, ``no`` a string), no
tags, no merge keys, no repeated keys. Which keys exist is said by the dataclass that is asked for,
in the package that uses it.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from gaussians.errors import InputError

T = TypeVar("T")

SUFFIXES = (".yaml", ".yml")


# ---------------------------------------------------------------- finding files


def configs_root() -> Path:
    """The folder of the shipped configs: inside the installed package, or at the checkout's top."""
    package = Path(__file__).resolve().parent
    inside = package / "configs"
    return inside if inside.is_dir() else package.parent / "configs"


def config_path(name: str, folder: str = "") -> Path:
    """The file that ``name`` means: a shipped config, or a file of the user's own.

    Parameters
    ----------
    name : a shipped name without suffix (``nebula``), or any path that ends in .yaml or .yml.
    folder : where shipped names are looked up inside configs/, for example ``scenes``.

    Raises InputError when there is no such file; the message lists the shipped names.
    """
    if name.endswith(SUFFIXES):
        if not Path(name).is_file():
            raise InputError(f"{name}: no such configuration file")
        return Path(name)
    root = configs_root() / folder
    path = root / f"{name}.yaml"
    if not path.is_file() or path.parent != root:
        known = ", ".join(sorted(p.stem for p in root.glob("*.yaml"))) or "none"
        raise InputError(
            f"no configuration named '{name}'; it must be a file ending in .yaml or one of: {known}"
        )
    return path


def data_root() -> Path:
    """Where real scenes and traces are: ``$NEBULA_DATA``, by default ``data`` right here."""
    return Path(os.environ.get("NEBULA_DATA") or "data")


def data_path(relative: str, path: str) -> Path:
    """A file named in a configuration: absolute, or relative to ``data_root()``; it must exist.

    ``path`` is the key that names it and starts the message of the InputError.
    """
    found = data_root() / relative
    if not found.exists():
        raise InputError(
            f"{path}: no file {found}; $NEBULA_DATA must be the folder that holds it "
            "(see docs/data.md)"
        )
    return found


# ---------------------------------------------------------------- reading YAML


class _Loader(yaml.SafeLoader):
    """SafeLoader with the YAML 1.2 core types and without repeated keys."""

    yaml_implicit_resolvers: dict[Any, Any] = {}  # noqa: RUF012 - replaces the base's

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if key.tag != "tag:yaml.org,2002:str":
                raise yaml.MarkedYAMLError(
                    problem=f"a key must be text, not {key.value!r}", problem_mark=key.start_mark
                )
            if key.value in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"key '{key.value}' stands here twice", problem_mark=key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep)


for _tag, _pattern, _first in (
    ("bool", r"true|false", "tf"),
    ("null", r"null|~|", "n~"),
    ("int", r"[-+]?[0-9]+", "-+0123456789"),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", "-+.0123456789"),
):
    _resolver = re.compile(rf"^(?:{_pattern})$")
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", _resolver, [*_first])
_Loader.add_implicit_resolver("tag:yaml.org,2002:null", re.compile(r"^$"), [""])
_Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(node.value))
_Loader.add_constructor("tag:yaml.org,2002:float", lambda loader, node: float(node.value))


def load_yaml(path: Path | str) -> dict[str, Any]:
    """The mapping in a YAML file.

    Raises InputError, naming file, line and column, for anything that is not one mapping with text
    keys, each key once; OSError when the file cannot be read.
    """
    try:
        content = yaml.load(Path(path).read_text(encoding="utf-8"), _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f"{path}:{mark.line + 1}:{mark.column + 1}" if mark else str(path)
        raise InputError(f"{place}: {error.problem}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: must be YAML text in UTF-8 ({error})") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: must hold keys and values, not {_kind(content)}")
    return content


# ---------------------------------------------------------------- building dataclasses


def load_dataclass(cls: type[T], mapping: Any, path: str) -> T:
    """``cls`` built from a mapping of its fields; ``path`` names the place in every message.

    Fields may be bool, int, float, str, Literal, other dataclasses, ``tuple[X, ...]``, ``tuple[X,
    Y]``, ``dict[str, X]``, and unions of these with each other or None. An int is taken where a
    float is asked for, nothing else is converted.

    Raises InputError for unknown and missing keys and wrong types, and passes on what
    ``__post_init__`` says, with the path before it.
    """
    if not isinstance(mapping, Mapping):
        raise InputError(f"{path}: must be a group of keys, not {_kind(mapping)}")
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type] # cls is one
    for key in mapping:
        if key not in fields:
            known = ", ".join(fields)
            raise InputError(f"{path}: unknown key {key!r}; known keys are {known}")
    for name, field in fields.items():
        required = field.default is field.default_factory is dataclasses.MISSING
        if required and name not in mapping:
            raise InputError(f"{path}: missing key '{name}'")
    hints = get_type_hints(cls)
    values = {key: _build(hints[key], mapping[key], f"{path}.{key}") for key in mapping}
    try:
        return cls(**values)
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: {error}") from error


def load_config(cls: type[T], path: Path | str, name: str) -> T:
    """``load_dataclass`` on a whole file; ``name`` is the first part of the path in messages."""
    return load_dataclass(cls, load_yaml(path), name)


def _build(hint: Any, value: Any, path: str) -> Any:
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return _build_union(get_args(hint), value, path)
    if origin is Literal:
        return _build_literal(get_args(hint), value, path)
    if origin is tuple:
        return _build_tuple(get_args(hint), value, path)
    if origin in (dict, Mapping):
        return _build_dict(get_args(hint), value, path)
    if dataclasses.is_dataclass(hint):
        return load_dataclass(hint, value, path)  # type: ignore[arg-type] # hint is a class
    return _build_scalar(hint, value, path)


def _build_union(members: tuple[Any, ...], value: Any, path: str) -> Any:
    """The first member that fits; a mapping goes to the dataclass, so its message stays precise."""
    if value is None and type(None) in members:
        return None
    if isinstance(value, Mapping):
        for member in members:
            if dataclasses.is_dataclass(member):
                return _build(member, value, path)
    candidates = [m for m in members if m is not type(None)]
    for member in candidates[:-1]:
        try:
            return _build(member, value, path)
        except InputError:
            continue
    return _build(candidates[-1], value, path)


def _build_literal(choices: tuple[Any, ...], value: Any, path: str) -> Any:
    for choice in choices:
        if value == choice and type(value) is type(choice):
            return choice
    raise InputError(f"{path}: must be one of {', '.join(map(repr, choices))}, not {_kind(value)}")


def _build_tuple(items: tuple[Any, ...], value: Any, path: str) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)):
        raise InputError(f"{path}: must be a list, not {_kind(value)}")
    if len(items) == 2 and items[1] is Ellipsis:
        items = (items[0],) * len(value)
    if len(items) != len(value):
        raise InputError(f"{path}: must be a list of {len(items)}, not of {len(value)}")
    return tuple(
        _build(item, v, f"{path}[{i}]")
        for i, (item, v) in enumerate(zip(items, value, strict=True))
    )


def _build_dict(items: tuple[Any, ...], value: Any, path: str) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{path}: must be a group of keys, not {_kind(value)}")
    for key in value:
        if not (isinstance(key, str) and key.isprintable()):
            raise InputError(f"{path}: a key must be printable text, not {key!r}")
    return {key: _build(items[1], v, f"{path}.{key}") for key, v in value.items()}


_WORDS = {bool: "true or false", int: "an integer", float: "a number", str: "text"}


def _build_scalar(hint: Any, value: Any, path: str) -> Any:
    if hint not in _WORDS:
        raise TypeError(f"{path}: load_dataclass cannot build {hint}")
    if hint is float and type(value) is int:
        value = float(value)
    if type(value) is not hint:
        raise InputError(f"{path}: must be {_WORDS[hint]}, not {_kind(value)}")
    if hint is float and not math.isfinite(value):
        raise InputError(f"{path}: must be a finite number, not {value}")
    return value


def _kind(value: Any) -> str:
    """How a message shows a wrong value."""
    if value is None:
        return "nothing"
    if isinstance(value, Mapping):
        return "a group of keys"
    if isinstance(value, (list, tuple)):
        return "a list"
    return repr(value)
