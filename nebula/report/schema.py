"""The schema of report.json: the validator, and the table of the documentation.

One table serves three ends: ``validate_report`` checks a report against it, docs/report.md shows
it (``python -m nebula.report.schema`` prints it), and the HTML page relies on it.

A path is written ``timing.utilisation.*`` (keys are free, one per unit) and ``frames[].index`` (one
per item of a list). Every key must be there; a type ending in ``?`` may be null.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from gaussians.errors import InputError
from nebula.report.keys import KEYS, Key

SCHEMA_VERSION = 1


@dataclass
class _Node:
    """One place in the report: a leaf has a key, a group has children, a list or a map one item."""

    key: Key | None = None
    children: dict[str, _Node] = field(default_factory=dict)


def _tree() -> _Node:
    root = _Node()
    for key in KEYS:
        node = root
        for step in re.findall(r"[^.\[\]]+|\[\]", key.path):
            node = node.children.setdefault(step, _Node())
        if node.key or node.children:
            raise ValueError(f"report schema: {key.path} stands there twice")
        node.key = key
    return root


def validate_report(report: Any, name: str = "report") -> None:
    """Check that a report has exactly the keys of the schema, with their types, and adds up.

    Raises InputError naming the first place that is wrong, for example
    ``report.timing: missing key 'fps'``.
    """
    _check(_tree(), report, name)
    if report["schema_version"] != SCHEMA_VERSION:
        raise InputError(
            f"{name}.schema_version: must be {SCHEMA_VERSION}, not {report['schema_version']}"
        )
    for place, value, expected, rule in _sums(report):
        if not math.isclose(value, expected, rel_tol=1e-6, abs_tol=1e-12):
            raise InputError(f"{name}.{place}: must be {rule}, {expected:.9g}, not {value:.9g}")


def _sums(report: Mapping[str, Any]) -> Iterator[tuple[str, float, float, str]]:
    """Totals that must fit their parts: place, value, expected value, the rule in words."""
    timing, energy, area = report["timing"], report["energy"], report["area"]
    parts = math.fsum(energy["parts"].values()) + energy["radio"]["mj_per_frame"]
    yield "energy.total_mj_per_frame", energy["total_mj_per_frame"], parts, "parts plus radio"
    yield "area.total_mm2", area["total_mm2"], math.fsum(area["parts"].values()), "the sum of parts"
    traffic = math.fsum(timing["dram_bytes"].values())
    yield (
        "timing.dram_bytes_per_frame",
        timing["dram_bytes_per_frame"],
        traffic,
        "the sum of streams",
    )
    rate = timing["clock_ghz"] * 1e9 / timing["cycles_per_frame"]
    yield "timing.fps", timing["fps"], rate, "clock over cycles"
    for suffix in ("", "_8bit"):
        key = f"right_mismatching_pixels{suffix}"
        total = sum(frame[key] for frame in report["frames"])
        yield f"stereo.{key}", report["stereo"][key], total, "the sum over frames"


def _check(node: _Node, value: Any, path: str) -> None:
    if node.key is not None:
        if not _fits(node.key.type, value):
            raise InputError(f"{path}: must be of type '{node.key.type}', not {value!r:.60}")
    elif "[]" in node.children:
        if not isinstance(value, list):
            raise InputError(f"{path}: must be a list, not {value!r:.60}")
        for index, item in enumerate(value):
            _check(node.children["[]"], item, f"{path}[{index}]")
    elif not isinstance(value, Mapping):
        raise InputError(f"{path}: must be a group of keys, not {value!r:.60}")
    elif "*" in node.children:
        for key, item in value.items():
            _check(node.children["*"], item, f"{path}.{key}")
    else:
        _check_group(node, value, path)


def _check_group(node: _Node, value: Mapping[str, Any], path: str) -> None:
    for key in node.children:
        if key not in value:
            raise InputError(f"{path}: missing key '{key}'")
    for key in value:
        if key not in node.children:
            raise InputError(
                f"{path}: unknown key '{key}'; known keys are {', '.join(node.children)}"
            )
    for key, child in node.children.items():
        _check(child, value[key], f"{path}.{key}")


def _fits(kind: str, value: Any) -> bool:
    if kind.endswith("?"):
        return value is None or _fits(kind[:-1], value)
    if kind.startswith("list of "):
        return isinstance(value, list) and all(_fits(kind[8:-1], item) for item in value)
    if kind == "integer":
        return isinstance(value, int) and not isinstance(value, bool)
    if kind == "number":
        plain = isinstance(value, (int, float)) and not isinstance(value, bool)
        return plain and math.isfinite(value)
    if kind == "string":
        return isinstance(value, str)
    if kind == "boolean":
        return isinstance(value, bool)
    if kind == "any":
        return True
    raise ValueError(f"report schema: unknown type '{kind}'")


def stable_part(report: Mapping[str, Any]) -> Any:
    """The report without what differs between runs of one job: machine, dates, measured times."""
    return _stable(_tree(), report)


def _stable(node: _Node, value: Any) -> Any:
    if "[]" in node.children:
        return [_stable(node.children["[]"], item) for item in value]
    if "*" in node.children:
        varies = node.children["*"].key is not None and node.children["*"].key.varies
        return {} if varies else dict(value)
    if not node.children:
        return value
    kept = {k: child for k, child in node.children.items() if not (child.key and child.key.varies)}
    return {key: _stable(child, value[key]) for key, child in kept.items()}


def table() -> str:
    """The table of docs/report.md, in Markdown."""
    lines = ["| key | type | unit | meaning |", "|---|---|---|---|"]
    for key in KEYS:
        meaning = f"{key.meaning} (varies from run to run)" if key.varies else key.meaning
        lines.append(f"| `{key.path}` | {key.type} | {key.unit} | {meaning} |".replace("  ", " "))
    return "\n".join(lines) + "\n"
