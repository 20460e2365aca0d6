"""The wheel: what is in it, and that it works outside the checkout."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

from nebula.report import validate_report

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project's wheel, built by its own backend without a network."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with the wheel, and with the dependencies (not the checkout) of this one."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=True, symlinks=os.name != "nt")
    python = folder / "bin" / "python"
    command = [str(python), "-m", "pip", "install", "--no-deps", "--no-index", str(wheel)]
    done = subprocess.run(command, capture_output=True, text=True, env=clean())
    assert done.returncode == 0, done.stderr
    script = "import sysconfig; print(sysconfig.get_path('purelib'))"
    purelib = subprocess.run([str(python), "-c", script], capture_output=True, text=True).stdout
    ours = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    (Path(purelib.strip()) / "dependencies.pth").write_text("\n".join(ours) + "\n")
    return python


def clean(**more: str) -> dict[str, str]:
    """The environment variables without those that would lead back to the checkout."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV"))}
    return {**kept, **more}


def run(python: Path, folder: Path, *arguments: str, **more: str) -> str:
    """Standard output of a command that must succeed, run in a folder outside the checkout."""
    command = [str(python), *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=clean(**more))
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_wheel_holds_the_packages_and_every_config(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    configs = {str(p.relative_to(ROOT)) for p in (ROOT / "configs").rglob("*.yaml")}
    assert configs
    assert {n.removeprefix("nebula/") for n in names if n.startswith("nebula/configs/")} >= configs
    top = {name.split("/")[0] for name in names}
    packages = {"gaussians", "lod_cloud", "arch", "rtl_ref", "nebula"}
    assert {name for name in top if not name.endswith(".dist-info")} == packages
    for package in packages:
        assert f"{package}/py.typed" in names
    assert {"nebula/report/page.css", "nebula/report/page.html"} <= set(names)
    assert any(name.endswith("licenses/LICENSE") for name in names)


def test_the_installed_wheel_is_used_and_knows_its_version(installed: Path, tmp_path: Path) -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    program = installed.parent / "nebula"
    assert run(installed, tmp_path, str(program), "--version") == f"nebula {version}\n"
    where = run(
        installed, tmp_path, "-c", "import nebula, arch; print(nebula.__file__, arch.__file__)"
    )
    for path in where.split():
        assert Path(path).is_relative_to(installed.parents[1])


def test_the_installed_wheel_finds_its_configs(installed: Path, tmp_path: Path) -> None:
    assert "mm² at 16 nm" in run(installed, tmp_path, "-m", "nebula", "area")


def test_the_installed_wheel_runs_the_main_job(installed: Path, tmp_path: Path) -> None:
    size = ["--city-leaves", "3000", "--width", "96", "--height", "96", "--frames", "3"]
    run(
        installed,
        tmp_path,
        "-m",
        "nebula",
        "simulate",
        *size,
        "--out",
        "out",
        NEBULA_DATA="nowhere",
    )
    report = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    validate_report(report)
    assert report["provenance"]["commit"] is None
    assert report["stereo"]["right_mismatching_pixels"] == 0
    assert "data:image/png" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
