"""What commands write: output directories, JSON, and what a command hands back to the command line.

Every file appears complete or not at all: it is written beside its place and renamed onto it.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from gaussians.errors import InputError

STDOUT = "-"


@dataclass(frozen=True)
class CommandResult:
    """What a command found: ``data`` for ``--json``, ``text`` for people."""

    data: dict[str, Any]
    text: str


def text_table(
    heads: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = ()
) -> str:
    """A table for the terminal: columns aligned, those in ``numbers`` to the right."""
    lines = [heads, *rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(heads))]
    return "\n".join(
        "  ".join(
            text.rjust(width) if i in numbers else text.ljust(width)
            for i, (text, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


class OutputDirectory:
    """A directory that receives all files of a run at its end, or none.

    ``with OutputDirectory(path) as out`` creates the directory and finds out at once whether it
    can be written. Files are made under ``out.file(name)``, in a hidden directory inside the
    target. When the block ends well they replace files of the same name, one by one and each
    atomically; other files stay as they are. When it ends with an exception nothing in the target
    has changed.

    Owns the hidden directory only; does not lock the target against a second run.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._created: list[Path] = []
        self._hidden: Path | None = None

    def __enter__(self) -> OutputDirectory:
        try:
            self._created = _make_directories(self.path)
            self._hidden = Path(tempfile.mkdtemp(prefix=".nebula-", dir=self.path))
        except OSError as error:
            self._remove()
            raise InputError(f"{self.path}: cannot be written ({error.strerror})") from error
        return self

    def file(self, name: str) -> Path:
        """Where to write the file that will be ``name`` (may contain folders) in the directory."""
        if self._hidden is None:
            raise RuntimeError("OutputDirectory.file is for use inside the with block")
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise ValueError(f"output file must lie inside the output directory, not at {name}")
        path = self._hidden / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def write_text(self, name: str, text: str) -> None:
        """Write one text file, UTF-8."""
        self.file(name).write_text(text, encoding="utf-8")

    def write_bytes(self, name: str, content: bytes) -> None:
        """Write one binary file."""
        self.file(name).write_bytes(content)

    def write_json(self, name: str, data: Any) -> None:
        """Write one strict JSON file; see ``json_text``."""
        self.write_text(name, json_text(data, name))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self._publish()
                self._created = []
        finally:
            self._remove()

    def _publish(self) -> None:
        assert self._hidden is not None
        files = sorted(p for p in self._hidden.rglob("*") if p.is_file())
        names = [p.relative_to(self._hidden) for p in files]
        for name in names:
            if (self.path / name).is_dir():
                raise InputError(
                    f"{self.path / name}: must be a file, but a directory stands there"
                )
        for file, name in zip(files, names, strict=True):
            (self.path / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, self.path / name)

    def _remove(self) -> None:
        if self._hidden is not None:
            shutil.rmtree(self._hidden, ignore_errors=True)
            self._hidden = None
        for directory in reversed(self._created):
            directory.rmdir()
        self._created = []


def _make_directories(path: Path) -> list[Path]:
    """Create ``path`` with its parents; the directories that were new, outermost first."""
    missing = [p for p in (path, *path.parents) if not p.exists()][::-1]
    path.mkdir(parents=True, exist_ok=True)
    return missing


# ---------------------------------------------------------------- JSON


def check_json_target(target: str | None) -> None:
    """Raise InputError now if ``write_json(target, ...)`` could not write later."""
    if target is None or target == STDOUT:
        return
    path = Path(target)
    if path.is_dir():
        raise InputError(f"--json {target}: must be a file, not a directory")
    try:
        with tempfile.NamedTemporaryFile(prefix=".nebula-", dir=path.parent):
            pass
    except OSError as error:
        raise InputError(f"--json {target}: cannot be written ({error.strerror})") from error


def write_json(target: str, data: Any) -> None:
    """Write strict JSON to a file, atomically, or to standard output (``-``)."""
    text = json_text(data, "json")
    if target == STDOUT:
        sys.stdout.write(text)
        return
    path = Path(target)
    hidden = path.parent / f".nebula-{os.getpid()}-{path.name}"
    try:
        hidden.write_text(text, encoding="utf-8")
        os.replace(hidden, path)
    finally:
        hidden.unlink(missing_ok=True)


def json_text(data: Any, name: str) -> str:
    """Strict JSON with the keys in their order of insertion, numpy values as plain ones.

    Raises ValueError naming the place (``name.key[3]``) of a number that is not finite, and
    TypeError for what JSON cannot hold.
    """
    return json.dumps(_plain(data, name), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _plain(value: Any, path: str) -> Any:
    if hasattr(value, "tolist"):  # numpy scalars and arrays, without importing numpy
        value = value.tolist()
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise TypeError(f"{path}: a key must be text, not {key!r}")
        return {key: _plain(item, f"{path}.{key}") for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item, f"{path}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{path}: must be a finite number, not {value}")
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"{path}: JSON cannot hold a {type(value).__name__}")
