"""Who made a report, from what, on which machine."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from gaussians.parallel import threads

_PACKAGES = ("numpy", "numba", "llvmlite", "scikit-learn", "scikit-image", "zstandard", "pillow")


def commit() -> str | None:
    """Commit of the checkout this package runs from, ``+changes`` if edited; None if installed."""
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return None
    head = _git(root, "rev-parse", "HEAD")
    changed = _git(root, "status", "--porcelain", "--untracked-files=no")
    return head and head + ("+changes" if changed else "")


def machine() -> dict[str, Any]:
    """Platform, processor, cores, threads and package versions."""
    packages = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            packages[name] = "not installed"
    return {
        "platform": platform.platform(),
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0,
        "threads": threads(),
        "packages": packages,
    }


def nebula_version() -> str:
    """Version of the installed distribution."""
    return version("nebula-splat")


def command_line() -> str:
    """The command as it was typed."""
    name = Path(sys.argv[0]).name
    return " ".join(["python -m nebula" if name == "__main__.py" else name, *sys.argv[1:]])


def now_utc() -> str:
    """ISO 8601, seconds."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def _git(root: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(root), *arguments], capture_output=True, text=True, timeout=10
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
