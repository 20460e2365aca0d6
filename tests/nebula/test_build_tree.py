"""``nebula build-tree`` and what ``nebula info`` says of its result."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lod_cloud import load_tree
from nebula.config import configs_root
from nebula.options import TiledTree, tiled_tree
from nebula.program import main


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(list(arguments))
    return int(end.value.code or 0)


def test_a_tiled_city_is_built_and_described(tmp_path: Path, capsys) -> None:
    out, report = tmp_path / "tree", tmp_path / "build.json"
    size = ("--city-leaves", "100000", "--sh-degree", "1", "--fan-out-ratio", "0.7", "--seed", "5")
    line = ("build-tree", "--tiled", "dense_city", *size, "--out", str(out), "--json", str(report))
    assert run(*line) == 0
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []
    data = json.loads(report.read_text())
    assert (data["leaves"], data["sh_degree"], data["nesting_violations"]) == (100_000, 1, 0)
    assert data["build"]["fan_out_ratio"] == 0.7 and data["build"]["pair_within"] == 16
    for name in ("generate_s", "spool_s", "build_s", "proof_s", "disk_s", "peak_rss_bytes"):
        assert data[name] > 0
    text = capsys.readouterr().out
    assert "s per million leaves" in text and "peak memory" in text
    tree = load_tree(out)
    assert tree.metadata.up == (0.0, 0.0, 1.0) and len(tree.metadata.path) > 5

    assert run("info", str(out), "--verify", "--json", str(report)) == 0
    data = json.loads(report.read_text())
    assert data["verified"] and data["nesting_violations"] == 0
    assert sum(data["bytes_of_files"].values()) == data["bytes_on_disk"]
    text = capsys.readouterr().out
    assert "every byte matches its checksum" in text and "fan_out_ratio 0.7" in text

    path = out / "sh.npy"
    path.write_bytes(path.read_bytes()[:-4])
    assert run("info", str(out)) == 2
    assert "sh.npy: must have" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--sh-degree", "1"), "--sh-degree: of use for --tiled only"),
        (("--tiled", "city", "--up", "+y"), "--tiled brings its own scene; --up: not of use"),
        (("--tiled", "town"), "no configuration named 'town'"),
        (("--fan-out-ratio", "0"), "--fan-out-ratio"),
        (("--pair-within", "65"), "--pair-within"),
    ],
)
def test_what_contradicts_itself_is_refused(
    arguments: tuple[str, ...], message: str, tmp_path: Path, capsys
) -> None:
    assert run("build-tree", *arguments, "--out", str(tmp_path / "tree")) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_only_trees_can_be_verified(capsys) -> None:
    assert run("info", "--city", "1000", "--verify") == 2
    assert "--verify checks a tree directory" in capsys.readouterr().err


@pytest.mark.parametrize("path", sorted((configs_root() / "trees").glob("*.yaml")), ids=str)
def test_shipped_trees_are_of_20_million_leaves(path: Path) -> None:
    tree = tiled_tree(path.stem, None, None)
    assert isinstance(tree, TiledTree)
    assert tree.leaves == 20_000_000 and tree.sh_degree == 3
    assert all(low < high for low, high in tree.expected.values())
