"""What a measurement was taken on."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

CPU_INFO = Path("/proc/cpuinfo")


def describe() -> dict[str, Any]:
    """CPU, cores this process may use, load averages of the last 1, 5, 15 minutes, versions."""
    return {
        "cpu": _cpu(),
        "cores": len(os.sched_getaffinity(0)),
        "load_average": [round(load, 2) for load in os.getloadavg()],
        "python": platform.python_version(),
        "numba": version("numba"),
        "numpy": version("numpy"),
    }


def in_words(machine: dict[str, Any]) -> str:
    loads = ", ".join(str(load) for load in machine["load_average"])
    return (
        f"{machine['cpu']}, {machine['cores']} cores, load average {loads}; "
        f"Python {machine['python']}, numba {machine['numba']}, NumPy {machine['numpy']}"
    )


def _cpu() -> str:
    if CPU_INFO.exists():
        for line in CPU_INFO.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
