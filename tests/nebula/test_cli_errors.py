"""The command line: options become one object, every error one line and an exit status."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nebula.progress
from gaussians import parallel
from gaussians.cameras import DISPLAYS
from gaussians.errors import InputError
from nebula import options as nebula_options
from nebula.cli import cli
from nebula.options import SceneOptions
from nebula.output import CommandResult
from nebula.program import main
from nebula.progress import progress

COMMANDS = {
    "simulate": ([], "SimulateOptions"),
    "render": ([], "RenderOptions"),
    "verify": ([], "VerifyOptions"),
    "info": ([], "InfoOptions"),
    "convert": (["in.sog", "out.ply"], "ConvertOptions"),
    "build-tree": (["--out", "tree"], "BuildTreeOptions"),
    "search": (["--tree", "tree"], "SearchOptions"),
    "stream": ([], "StreamOptions"),
    "area": ([], "AreaOptions"),
    "energy": ([], "EnergyOptions"),
    "figure": (["formats", "--out", "figures"], "FigureOptions"),
}

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: Any) -> Iterator[Run]:
    """Call ``nebula ARGUMENTS`` in this process: exit status, standard output, standard error."""

    def call(*arguments: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            main(arguments)
        written = capsys.readouterr()
        return int(end.value.code or 0), written.out, written.err

    before = signal.getsignal(signal.SIGTERM)
    yield call
    signal.signal(signal.SIGTERM, before)


@pytest.fixture
def command(monkeypatch: Any) -> Callable[[str, Callable[[Any], Any]], None]:
    """Replace the module of a command by one function."""

    def replace(name: str, function: Callable[[Any], Any]) -> None:
        module = types.ModuleType(f"nebula.{name}")
        module.run = function  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, module.__name__, module)

    return replace


def noting(seen: list[Any], note: Callable[[Any], Any]) -> Callable[[Any], CommandResult]:
    """A command that keeps something about its options."""

    def work(options: Any) -> CommandResult:
        seen.append(note(options))
        return CommandResult({}, "")

    return work


def one_line(text: str) -> str:
    assert text.startswith("nebula: error: ") and text.count("\n") == 1, text
    return text[len("nebula: error: ") : -1]


# ---------------------------------------------------------------- options


def test_the_commands_are_the_documented_ones() -> None:
    assert set(cli.commands) == set(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_hands_its_options_to_its_module(name: str, run: Run, command: Any) -> None:
    seen = []

    def work(options: Any) -> CommandResult:
        seen.append(options)
        return CommandResult({"fps": 70.1}, "seventy")

    command(name.replace("-", "_"), work)
    arguments, kind = COMMANDS[name]
    assert run(name, *arguments) == (0, "seventy\n", "")
    assert isinstance(seen[0], getattr(nebula_options, kind))


def test_options_arrive_with_their_values(run: Run, command: Any) -> None:
    seen: list[Any] = []
    command("simulate", noting(seen, lambda options: options))
    line = (
        "--scene a.ply --level 2 --up +x --units-per-metre 10 --seed 5 --view 1,2,3:4,5,6 "
        "--near 0.5 --display quest3 --trace t.csv --frames 3 --search-every 2 --tau 12 "
        "--baseline 0.07 --trace-fov --method paper "
        "--accelerator gscore_nebula --rate-mbps 50 --latency-ms 0 --out o --no-html"
    )
    assert run("simulate", *line.split())[0] == 0
    assert seen == [
        nebula_options.SimulateOptions(
            scene=SceneOptions(
                scene=Path("a.ply"),
                level=2,
                up="+x",
                units_per_metre=10.0,
                view="1,2,3:4,5,6",
                near_m=0.5,
                display=DISPLAYS["quest3"],
                trace="t.csv",
            ),
            seed=5,
            frames=3,
            method="paper",
            tau_px=12.0,
            search_every=2,
            accelerator="gscore_nebula",
            rate_mbps=50.0,
            latency_ms=0.0,
            baseline_m=0.07,
            trace_fov=True,
            out=Path("o"),
            html=False,
        )
    ]


def test_threads_are_set_for_the_kernels(run: Run, command: Any) -> None:
    before = parallel.threads()
    seen: list[Any] = []
    command("render", noting(seen, lambda options: parallel.threads()))
    try:
        assert run("render", "--threads", "3")[0] == 0
        assert seen == [3]
        assert "0 is not in the range 1<=x<=1024" in run("render", "--threads", "0")[2]
    finally:
        parallel.set_threads(before)


def test_json_goes_to_a_file_beside_the_text(run: Run, command: Any, tmp_path: Path) -> None:
    command("area", lambda options: CommandResult({"mm2": np.float64(2.5)}, "text"))
    target = tmp_path / "a.json"
    assert run("area", "--json", str(target)) == (0, "text\n", "")
    assert json.loads(target.read_text()) == {"mm2": 2.5}


def test_json_on_standard_output_stands_alone(run: Run, command: Any) -> None:
    def work(options: Any) -> CommandResult:
        with progress("working"):
            return CommandResult({"mm2": 2.5}, "text")

    command("area", work)
    status, out, _ = run("area", "--json", "-")
    assert (status, json.loads(out)) == (0, {"mm2": 2.5})


# ---------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (InputError("tau must be >= 0, not -1"), 2, "tau must be >= 0, not -1"),
        (InputError("two\nlines"), 2, "two lines"),
        (FileNotFoundError(2, "No such file or directory", "a.ply"), 2, "a.ply: No such file"),
        (PermissionError(13, "Permission denied", "out"), 2, "out: Permission denied"),
        (OSError("no space left"), 2, "no space left"),
        (MemoryError("Unable to allocate 9 TiB"), 2, "not enough memory: Unable to allocate 9 TiB"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (KeyError("dram"), 1, "KeyError: 'dram' (a fault of the program"),
        (ValueError("broadcast"), 1, "ValueError: broadcast (a fault of the program"),
    ],
)
def test_an_error_is_one_line_and_a_status(
    error: BaseException, status: int, message: str, run: Run, command: Any, monkeypatch: Any
) -> None:
    def fail(options: Any) -> CommandResult:
        raise error

    monkeypatch.delenv("NEBULA_TRACEBACK", raising=False)
    command("area", fail)
    found, out, err = run("area")
    assert (found, out) == (status, "")
    assert one_line(err).startswith(message)


def test_a_traceback_is_there_for_the_asking(command: Any, monkeypatch: Any, run: Run) -> None:
    def fail(options: Any) -> CommandResult:
        raise InputError("wrong")

    command("area", fail)
    monkeypatch.setenv("NEBULA_TRACEBACK", "1")
    with pytest.raises(InputError, match="wrong"):
        main(["area"])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("", "Missing command"),
        ("simulat", "No such command 'simulat'"),
        ("simulate --frame 3", "No such option '--frame'"),
        ("simulate --frames 0", "0 is not in the range x>=1"),
        ("simulate --frames many", "'many' is not a valid integer"),
        ("simulate --tau nan", "nan is not a finite number"),
        ("simulate --tau -1", "-1.0 is not in the range x>=0"),
        ("simulate --rate-mbps inf", "inf is not a finite number"),
        ("simulate --method best", "'best' is not one of 'exact', 'paper', 'independent'"),
        ("simulate --up z", "'z' is not one of '+x', '-x'"),
        ("simulate --display tv", "display must be one of prototype, quest3, not 'tv'"),
        ("simulate --width 0", "0 is not in the range 1<=x<=16384"),
        ("simulate --fov 200", "200.0 is not in the range 1<=x<=170"),
        ("simulate --config nowhere", "no configuration named 'nowhere'"),
        ("simulate --config no.yaml", "no.yaml: no such configuration file"),
        ("simulate --json /", "--json /: must be a file, not a directory"),
        ("build-tree", "Missing option '--out'"),
        ("search", "Missing option '--tree'"),
        ("area --node 5", "'5' is not one of '16', '8'"),
    ],
)
def test_wrong_options_are_one_line_and_status_2(
    line: str, message: str, run: Run, command: Any
) -> None:
    command("simulate", lambda options: pytest.fail("the work began"))
    status, out, err = run(*line.split())
    assert (status, out) == (2, "")
    assert message in one_line(err)


def test_an_unknown_yaml_key_is_named_with_its_place(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "hall.yaml"
    path.write_text("levels: 3\n")
    status, _, err = run("info", "--config", str(path))
    assert status == 2
    assert one_line(err).startswith("hall: unknown key 'levels'; known keys are scene, level, up")


PLY_HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    "property float z\nend_header\n"
)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("missing.ply", None),
        ("empty.ply", b""),
        ("noise.ply", bytes(range(256)) * 8),
        ("truncated.ply", PLY_HEADER.encode() + b"\0" * 13),
        ("short.splat", b"\0" * 31),
        ("empty.splat", b""),
        ("noise.sog", b"PK\3\4" + b"\0" * 60),
        ("scene.xyz", b"1 2 3\n"),
    ],
)
def test_a_bad_scene_is_one_line_with_its_name(
    name: str, content: bytes | None, run: Run, tmp_path: Path
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    target = tmp_path / "out"
    status, out, err = run("render", "--scene", str(path), "--out", str(target))
    assert (status, out) == (2, "")
    assert name in one_line(err)
    assert not target.exists()


# ---------------------------------------------------------------- as a process of its own


def python(code: str, **keywords: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, **keywords
    )


def test_help_is_quick_and_imports_nothing_heavy() -> None:
    code = """
import sys, time
start = time.perf_counter()
import nebula
from nebula.program import main
try:
    main(["--help"])
except SystemExit as end:
    assert not end.code, end.code
seconds = time.perf_counter() - start
heavy = {"numba", "matplotlib", "sklearn", "scipy", "skimage", "PIL", "rich", "yaml", "numpy"}
print("\\n", seconds, sorted(heavy & set(sys.modules)))
"""
    runs = [python(code) for _ in range(3)]
    assert all(r.returncode == 0 and not r.stderr for r in runs), runs[0].stderr
    last = [r.stdout.splitlines()[-1].split(maxsplit=1) for r in runs]
    assert {loaded for _, loaded in last} == {"[]"}
    assert min(float(seconds) for seconds, _ in last) < 0.3


WAITING = """
import os, signal, sys, types, time
from nebula.program import main
from nebula.output import OutputDirectory
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored by processes in the background
module = types.ModuleType("nebula.area")
def run(options):
    with OutputDirectory(sys.argv[1]) as out:
        out.write_text("half", "written")
        os.kill(os.getpid(), getattr(signal, sys.argv[2]))
        time.sleep(30)
module.run = run
sys.modules["nebula.area"] = module
main(["area"])
"""


@pytest.mark.parametrize(("name", "status"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_a_signal_leaves_nothing_half_written(name: str, status: int, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", WAITING, str(tmp_path / "out"), name],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == status
    assert done.stderr == ("nebula: error: interrupted\n" if name == "SIGINT" else "")
    assert list(tmp_path.iterdir()) == []


def test_a_reader_that_has_seen_enough_is_no_error() -> None:
    code = """
import subprocess, sys, types
from nebula.program import main
from nebula.output import CommandResult
def run(options):
    for _ in range(1000):
        print("line\\n" * 4000, end="")
    return CommandResult({}, "")
module = types.ModuleType("nebula.area")
module.run = run
sys.modules["nebula.area"] = module
main(["area"])
"""
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout and process.stderr
        assert process.stdout.readline() == b"line\n"
        process.stdout.close()
        assert process.wait(timeout=60) == 0
        assert process.stderr.read() == b""


def test_the_module_runs_as_a_program() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "nebula", "--version"], capture_output=True, text=True, timeout=60
    )
    assert re.fullmatch(r"nebula \d+\.\d+\.\d+\n", done.stdout) and done.returncode == 0


# ---------------------------------------------------------------- progress


def test_progress_says_what_took_long_on_standard_error(capsys: Any, monkeypatch: Any) -> None:
    with progress("quick work", total=2) as step:
        step()
    assert capsys.readouterr() == ("", "")
    monkeypatch.setattr(nebula.progress, "QUIET_S", 0.0)
    with progress("slow work"):
        pass
    out, err = capsys.readouterr()
    assert out == "" and re.fullmatch(r"slow work: \d+\.\d s\n", err)


def test_progress_on_a_terminal_goes_to_standard_error(capsys: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with progress("long work", total=3) as step:
        step()
    out, err = capsys.readouterr()
    assert out == "" and "long work" in err
