"""Where the real scenes and traces of docs/data.md lie on this machine."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def data_root() -> Path:
    """``$NEBULA_DATA``, by default ``./data`` of the checkout."""
    return Path(__file__).resolve().parents[2] / os.environ.get("NEBULA_DATA", "data")


def data_file(name: str) -> Path:
    """A file or folder of the data; the test skips, naming it, where it is missing."""
    path = data_root() / name
    if not path.exists():
        pytest.skip(f"needs {path}; see docs/data.md")
    return path
