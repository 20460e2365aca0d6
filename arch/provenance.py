"""Where a number comes from: every group of numbers in a configuration carries its source."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from gaussians.errors import InputError

SOURCES = (
    "paper",
    "datasheet",
    "literature",
    "synthesis",
    "derived",
    "calibrated",
    "assumption",
)
# A: read in the primary text; B: read in a secondary text; C: computed from A and B values;
# M: from memory or judgement, unverified. Best first.
CONFIDENCES = ("A", "B", "C", "M")
_SOURCE_FIELDS = ("source", "reference", "confidence")


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Base of every group that holds numbers: where they were found and how far to trust them.

    Raises InputError for a source or confidence that is not listed above, or an empty reference.
    """

    source: str
    reference: str
    confidence: str

    def __post_init__(self) -> None:
        name = type(self).__name__
        if self.source not in SOURCES:
            raise InputError(
                f"{name}: source must be one of {', '.join(SOURCES)}, not {self.source!r}"
            )
        if self.confidence not in CONFIDENCES:
            raise InputError(
                f"{name}: confidence must be one of {', '.join(CONFIDENCES)}, "
                f"not {self.confidence!r}"
            )
        if not self.reference.strip():
            raise InputError(
                f"{name}: reference must say where the numbers were found, not nothing"
            )

    def require_integers(self, minimum: int, *fields: str) -> None:
        """Raise InputError unless each named field is an integer of at least ``minimum``."""
        for field in fields:
            value = getattr(self, field)
            if isinstance(value, bool) or not isinstance(value, int) or value < minimum:
                raise InputError(
                    f"{type(self).__name__}: {field} must be an integer of at least {minimum}, "
                    f"not {value!r}"
                )

    def require_positive(self, *fields: str) -> None:
        """Raise InputError unless each named field is a finite number above zero."""
        for field in fields:
            value = getattr(self, field)
            if not (isinstance(value, (int, float)) and math.isfinite(value) and value > 0):
                raise InputError(
                    f"{type(self).__name__}: {field} must be a positive number, not {value!r}"
                )

    def require_not_negative(self, *fields: str) -> None:
        """Raise InputError unless each named field is a finite number of at least zero."""
        for field in fields:
            value = getattr(self, field)
            if not (isinstance(value, (int, float)) and math.isfinite(value) and value >= 0):
                raise InputError(f"{type(self).__name__}: {field} must be >= 0, not {value!r}")

    def require_choice(self, field: str, choices: tuple[str, ...]) -> None:
        """Raise InputError unless the named field is one of the choices."""
        value = getattr(self, field)
        if value not in choices:
            raise InputError(
                f"{type(self).__name__}: {field} must be one of {', '.join(choices)}, not {value!r}"
            )


@dataclass(frozen=True)
class SourcedGroup:
    """One group of numbers of a configuration, for the list of sources in a report."""

    path: str  # for example "projection_unit.timing"
    values: str  # "cycles_per_splat 1, right_eye_cycles 1"
    source: str
    reference: str
    confidence: str


def sourced_groups(config: object, path: str = "") -> Iterator[SourcedGroup]:
    """Every group of numbers below a configuration dataclass, in the order of its fields.

    Raises InputError naming the path of a number that stands in a group without a source.
    """
    if not dataclasses.is_dataclass(config) or isinstance(config, type):
        return
    own = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    if isinstance(config, Provenance):
        shown = {key: _shown(value) for key, value in own.items() if key not in _SOURCE_FIELDS}
        text = ", ".join(f"{key} {value}" for key, value in shown.items() if value)
        yield SourcedGroup(path, text, config.source, config.reference, config.confidence)
    elif any(isinstance(value, (int, float)) for value in own.values()):
        raise InputError(f"{path or type(config).__name__}: numbers must carry a source")
    for key, value in own.items():
        below = f"{path}.{key}" if path else key
        for index, item in enumerate(value if isinstance(value, tuple) else ()):
            if isinstance(item, (int, float)) and not isinstance(config, Provenance):
                raise InputError(f"{below}: numbers must carry a source")
            yield from sourced_groups(item, f"{below}[{index}]")
        yield from sourced_groups(value, below)


def _shown(value: object) -> str:
    """A number, a text, numbers in a row, or numbers by name; nothing for anything else."""
    if isinstance(value, (int, float, str)):
        return str(value)
    if isinstance(value, Mapping):
        return " + ".join(f"{number} {name}" for name, number in value.items())
    if isinstance(value, tuple) and all(isinstance(item, (int, float)) for item in value):
        return " ".join(map(str, value))
    return ""


def weakest(*confidences: str) -> str:
    """The least trustworthy of several confidence marks: a result is only as good as that."""
    return max(confidences, key=CONFIDENCES.index)
