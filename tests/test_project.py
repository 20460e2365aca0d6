"""Rules that hold for the project as a whole."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import njit

import arch
from gaussians.kernel_cache import SHARED_SOURCES
from tests.kernel_types import float64_variables, foreign_calls

ROOT = Path(__file__).resolve().parents[1]
LARGEST_FILE_BYTES = 1_000_000
NJIT_IS_OFF = os.environ.get("NUMBA_DISABLE_JIT") == "1"
HALF = np.float32(0.5)

needs_jit = pytest.mark.skipif(NJIT_IS_OFF, reason="needs numba's compiler")


def test_arch_is_ours() -> None:
    """A package of the same name on PyPI holds volatility models."""
    assert Path(arch.__file__).resolve() == ROOT / "arch" / "__init__.py"


def test_imports_point_one_way() -> None:
    program = shutil.which("lint-imports", path=str(Path(sys.executable).parent))
    assert program, "lint-imports must be installed beside python: pip install -e .[dev]"
    done = subprocess.run([program, "--no-cache"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def tracked_files() -> list[Path]:
    """Files that git knows or would add; in a copy without git, all but hidden folders and data."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    if (ROOT / ".git").exists() and shutil.which("git"):
        listed = subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout
        return [
            path for name in listed.decode().split("\0") if name and (path := ROOT / name).is_file()
        ]
    skipped = ("out", "data", "dist")
    return [
        path
        for path in ROOT.rglob("*")
        if path.is_file()
        and path.relative_to(ROOT).parts[0] not in skipped
        and not any(part.startswith(".") for part in path.relative_to(ROOT).parts)
    ]


def test_no_file_is_large() -> None:
    files = tracked_files()
    assert len(files) > 20
    large = [
        f"{p.relative_to(ROOT)}: {p.stat().st_size} B"
        for p in files
        if p.stat().st_size > LARGEST_FILE_BYTES
    ]
    assert large == []


def test_every_test_folder_is_a_package() -> None:
    """Without, tests/arch would hide arch."""
    folders = {p.parent for p in (ROOT / "tests").rglob("*.py")}
    assert [str(f) for f in folders if not (f / "__init__.py").exists()] == []


# ---------------------------------------------------------------- kernels


def test_kernels_call_only_kernels_of_their_own_file() -> None:
    assert list(foreign_calls(ROOT, allowed=SHARED_SOURCES)) == []


@pytest.mark.parametrize(
    ("imports", "use", "found"),
    [
        ("from gaussians.low import low", "low(x)", True),
        ("from gaussians.low import low as other", "other(x)", True),
        ("from gaussians import low", "low.low(x)", True),
        ("import gaussians.low as quick", "quick.low(x)", True),
        ("import gaussians.low", "gaussians.low.low(x)", True),
        ("from gaussians.low import plain", "plain(x)", False),
        ("from gaussians.shared import shared", "shared(x)", False),
        ("from gaussians.low import low", "x", False),
    ],
)
def test_a_call_to_another_files_kernel_is_found(
    tmp_path: Path, imports: str, use: str, found: bool
) -> None:
    kernel = "from numba import njit\n{}\n\n\n@njit(cache=True)\ndef {}(x):\n    return {}\n"
    for package in ("gaussians", "arch"):
        (tmp_path / package).mkdir()
    low = kernel.format("", "low", "x") + "\n\ndef plain(x):\n    return x\n"
    (tmp_path / "gaussians" / "low.py").write_text(low)
    (tmp_path / "gaussians" / "shared.py").write_text(kernel.format("", "shared", "x"))
    (tmp_path / "arch" / "top.py").write_text(kernel.format(imports, "top", use))
    calls = list(foreign_calls(tmp_path, allowed=["gaussians/shared.py"]))
    assert calls == (["arch/top.py:7 calls gaussians.low.low"] if found else [])


@njit(error_model="numpy")
def _pure(x):  # type: ignore[no-untyped-def] # a kernel
    total = np.float32(0.25)
    for value in x:
        total += HALF * np.sqrt(value)
    return total


@njit(error_model="numpy")
def _promoting(x):  # type: ignore[no-untyped-def] # a kernel
    total = np.float32(0)
    for value in x:
        scaled = value * 0.5
        total += np.float32(scaled)
    return total


@njit(error_model="numpy")
def _late_rounding(x):  # type: ignore[no-untyped-def] # a kernel
    return np.float32(x[0] * np.float64(0.5))


@njit(error_model="numpy")
def _mixing(x, count):  # type: ignore[no-untyped-def] # a kernel
    pair = (x[0] * count, count)
    return np.float32(pair[0])


@needs_jit
@pytest.mark.parametrize(
    ("kernel", "arguments", "expected"),
    [
        (_pure, (np.ones(3, np.float32),), set()),
        (_pure, (np.ones(3, np.float64),), {"x", "value", "total"}),
        (_promoting, (np.ones(3, np.float32),), {"scaled"}),
        (_late_rounding, (np.ones(3, np.float32),), set()),  # in temporaries only
        (_mixing, (np.ones(3, np.float32), 2), {"pair"}),  # float32 * int64 is float64
    ],
)
def test_float64_in_a_kernel_is_found(kernel: Any, arguments: Any, expected: set[str]) -> None:
    fresh = njit(error_model="numpy")(kernel.py_func)
    fresh(*arguments)
    found = float64_variables(fresh)
    named = {name for name in found if not name.startswith("line ")}
    assert named == expected
    assert bool(found) == (kernel is not _pure or arguments[0].dtype == np.float64)


@needs_jit
def test_a_kernel_that_was_not_called_cannot_be_checked() -> None:
    with pytest.raises(AssertionError, match="has not been called"):
        float64_variables(njit(_pure.py_func))
