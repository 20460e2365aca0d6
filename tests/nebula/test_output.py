"""Output appears complete or not at all."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.errors import InputError
from nebula.output import OutputDirectory, check_json_target, json_text, write_json


def listing(path: Path) -> dict[str, bytes]:
    return {str(p.relative_to(path)): p.read_bytes() for p in path.rglob("*") if p.is_file()}


def test_files_appear_at_the_end_and_others_stay(tmp_path: Path) -> None:
    target = tmp_path / "out"
    target.mkdir()
    (target / "mine.txt").write_text("keep")
    (target / "report.json").write_text("old")
    with OutputDirectory(target) as out:
        out.write_json("report.json", {"a": 1})
        out.write_text("page.html", "<p>é")
        out.write_bytes("frames/0.png", b"\x89")
        out.file("array.npy").write_bytes(b"array")
        assert (target / "report.json").read_text() == "old"
        assert not (target / "page.html").exists()
    assert listing(target) == {
        "mine.txt": b"keep",
        "report.json": b'{\n  "a": 1\n}\n',
        "page.html": "<p>é".encode(),
        "frames/0.png": b"\x89",
        "array.npy": b"array",
    }


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_a_failure_changes_nothing(tmp_path: Path, error: type[BaseException]) -> None:
    target = tmp_path / "out"
    target.mkdir()
    (target / "report.json").write_text("old")
    with pytest.raises(error), OutputDirectory(target) as out:
        out.write_text("report.json", "new")
        out.write_text("more/page.html", "new")
        raise error
    assert listing(target) == {"report.json": b"old"}
    assert [p.name for p in target.iterdir()] == ["report.json"]


def test_a_failure_removes_the_directories_it_made(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), OutputDirectory(tmp_path / "a" / "b") as out:
        out.write_text("x", "")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
    with OutputDirectory(tmp_path / "a" / "b") as out:
        out.write_text("x", "1")
    assert listing(tmp_path) == {"a/b/x": b"1"}


def test_a_directory_in_the_place_of_a_file_changes_nothing(tmp_path: Path) -> None:
    (tmp_path / "page.html").mkdir()
    (tmp_path / "a.json").write_text("old")
    with (
        pytest.raises(InputError, match=r"page\.html: must be a file, but a directory stands"),
        OutputDirectory(tmp_path) as out,
    ):
        out.write_text("a.json", "new")
        out.write_text("page.html", "new")
    assert listing(tmp_path) == {"a.json": b"old"}
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".nebula")]


def test_what_cannot_be_written_is_known_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for bad in (tmp_path / "file", tmp_path / "file" / "below", Path("/proc/nebula/out")):
        with pytest.raises(InputError, match="cannot be written"), OutputDirectory(bad):
            pytest.fail("the work began")
    assert listing(tmp_path) == {"file": b""}


def test_files_stay_inside_the_directory(tmp_path: Path) -> None:
    with OutputDirectory(tmp_path / "out") as out:
        for bad in ("../x", "/x", "a/../../x"):
            with pytest.raises(ValueError, match="must lie inside"):
                out.file(bad)
    with pytest.raises(RuntimeError, match="inside the with block"):
        out.file("late")


# ---------------------------------------------------------------- JSON


def test_numpy_becomes_plain_and_order_stays() -> None:
    data = {
        "z": np.float32(0.5),
        "a": np.int64(3),
        "flag": np.bool_(True),
        "row": np.arange(3, dtype=np.int32),
        "nothing": None,
        "pair": (1, 2.5),
        "text": "Δ",
    }
    text = json_text(data, "json")
    assert list(json.loads(text)) == list(data)
    assert json.loads(text) == {
        **{"z": 0.5, "a": 3, "flag": True, "row": [0, 1, 2], "nothing": None},
        **{"pair": [1, 2.5], "text": "Δ"},
    }
    assert "Δ" in text and text.endswith("}\n")


@pytest.mark.parametrize(
    ("data", "error", "message"),
    [
        ({"a": {"b": [0, math.nan]}}, ValueError, r"report\.a\.b\[1\]: must be a finite number"),
        ({"a": np.array([1, np.inf])}, ValueError, r"report\.a\[1\]: must be a finite number"),
        ({"a": {1: 2}}, TypeError, r"report\.a: a key must be text, not 1"),
        ({"a": {1, 2}}, TypeError, r"report\.a: JSON cannot hold a set"),
        ({"a": Path()}, TypeError, r"report\.a: JSON cannot hold a PosixPath"),
        ({"a": 1j}, TypeError, r"report\.a: JSON cannot hold a complex"),
    ],
)
def test_what_json_cannot_hold_is_refused_by_place(
    data: Any, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        json_text(data, "report")


texts = st.text('aé"\\\n\x00', max_size=4)
scalars = (
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
)
plain = st.recursive(
    scalars | texts,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=8,
)


@settings(deadline=None)
@given(data=plain)
def test_plain_data_survives(data: Any) -> None:
    assert json.loads(json_text(data, "json")) == data


def test_json_goes_to_a_file_or_to_standard_output(tmp_path: Path, capsys: Any) -> None:
    target = tmp_path / "a.json"
    write_json(str(target), {"a": 1})
    assert json.loads(target.read_text()) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]
    write_json("-", {"a": 2})
    assert json.loads(capsys.readouterr().out) == {"a": 2}


def test_a_reader_of_the_old_file_is_not_disturbed(tmp_path: Path) -> None:
    target = tmp_path / "a.json"
    target.write_text("old")
    with target.open() as reader:
        write_json(str(target), {"a": 1})
        assert reader.read() == "old"
    with target.open() as reader, OutputDirectory(tmp_path) as out:
        out.write_text("a.json", "newer")
    assert target.read_text() == "newer"


def test_a_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: Any) -> None:
    target = tmp_path / "a.json"
    target.write_text("old")
    with pytest.raises(ValueError, match="finite"):
        write_json(str(target), {"a": math.nan})

    def full(self: Path, text: str, encoding: str) -> int:
        self.write_bytes(text.encode()[:3])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="No space"):
        write_json(str(target), {"a": 1})
    assert listing(tmp_path) == {"a.json": b"old"}


def test_a_bad_json_target_is_known_before_the_work(tmp_path: Path) -> None:
    check_json_target(None)
    check_json_target("-")
    check_json_target(str(tmp_path / "a.json"))
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError, match="must be a file, not a directory"):
        check_json_target(str(tmp_path))
    with pytest.raises(InputError, match="cannot be written"):
        check_json_target(str(tmp_path / "absent" / "a.json"))
