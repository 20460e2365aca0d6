"""Trees on disk: round trip, atomic replacement, refusal of everything damaged."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gaussians.errors import InputError
from gaussians.scene import FIELDS
from lod_cloud.build import build_tree
from lod_cloud.criterion import SearchRequest
from lod_cloud.full_search import flat_search
from lod_cloud.lod_tree import ARRAYS
from lod_cloud.tree_files import load_tree, save_tree
from tests.lod_cloud.trees import random_scene, random_tree


def test_round_trip(tmp_path: Path) -> None:
    walk = ((0.0, 0.1, 0.2), (1.0, 2.0, 3.0))
    tree = build_tree(
        random_scene(100, 1, sh_degree=2),
        up=(0.0, 0.0, 1.0),
        units_per_metre=2.5,
        start=walk[0],
        path=walk,
    )
    save_tree(tree, tmp_path / "tree")
    loaded = load_tree(tmp_path / "tree").validate()
    assert loaded.metadata == tree.metadata
    for name in ARRAYS:
        assert np.array_equal(getattr(loaded, name), getattr(tree, name))
    for name in FIELDS:
        assert np.array_equal(getattr(loaded.gaussians, name), getattr(tree.gaussians, name))
    request = SearchRequest((1, 1, 1), 100, 6)
    assert np.array_equal(
        flat_search(loaded, request).node_ids, flat_search(tree, request).node_ids
    )
    assert [p.name for p in tmp_path.iterdir()] == ["tree"]


def test_replaces_trees_and_empty_folders_only(tmp_path: Path) -> None:
    target = tmp_path / "tree"
    target.mkdir()
    save_tree(random_tree(5, 1), target)
    save_tree(random_tree(7, 1), target)
    assert load_tree(target).leaves == 7
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.txt").write_text("precious")
    file = tmp_path / "file"
    file.write_text("x")
    for place in (other, file):
        with pytest.raises(InputError, match="must not exist, be empty, or hold a tree"):
            save_tree(random_tree(5, 1), place)
    assert (other / "thesis.txt").read_text() == "precious"
    with pytest.raises(InputError, match="cannot be written"):
        save_tree(random_tree(5, 1), file / "below")


def test_a_failed_save_leaves_the_old_tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "tree"
    save_tree(random_tree(5, 1), target)

    def full_disk(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "save", full_disk)
    with pytest.raises(InputError, match="No space left"):
        save_tree(random_tree(7, 1), target)
    assert load_tree(target).leaves == 5
    assert [p.name for p in tmp_path.iterdir()] == ["tree"]


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    save_tree(random_tree(20, 3), tmp_path / "tree")
    return tmp_path / "tree"


@pytest.mark.parametrize("name", [*ARRAYS, *FIELDS])
def test_truncated_altered_and_missing_arrays(saved: Path, name: str) -> None:
    path = saved / f"{name}.npy"
    data = path.read_bytes()
    path.write_bytes(data[:-1])
    with pytest.raises(InputError, match=f"{name}.npy: must have {len(data)} bytes"):
        load_tree(saved)
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(InputError, match=f"{name}.npy: checksum must match"):
        load_tree(saved)
    path.unlink()
    with pytest.raises(InputError, match=f"{name}.npy: cannot be read"):
        load_tree(saved)


def test_damaged_descriptions(saved: Path) -> None:
    path = saved / "tree.json"
    text = path.read_text()
    version = json.loads(text) | {"version": 99}
    for content, message in (
        (text[: len(text) // 2], "must be JSON"),
        (text.replace('"leaves": 20', '"leaves": 21'), "checksum must match"),
        (json.dumps(version), "version must be 1, not 99"),
        ("{}", "format must be"),
        ("[]", "format must be"),
    ):
        path.write_text(content)
        with pytest.raises(InputError, match=message):
            load_tree(saved)
    path.unlink()
    with pytest.raises(InputError, match="cannot be read"):
        load_tree(saved)
