"""Trees on disk: round trip, atomic replacement, refusal of everything damaged."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from gaussians import parallel
from gaussians.errors import InputError
from gaussians.scene import FIELDS
from lod_cloud import build, search_files, tree_files
from lod_cloud.build import BuildOptions, build_tree, build_tree_files
from lod_cloud.criterion import SearchRequest
from lod_cloud.leaf_spool import LeafSpool
from lod_cloud.lod_tree import ARRAYS
from lod_cloud.search import SearchTree, flat_search
from lod_cloud.search_arrays import SearchArrays
from lod_cloud.search_files import SEARCH_FILES
from lod_cloud.tree_files import load_tree, save_tree, verify_tree
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

    monkeypatch.setattr(os, "pwrite", full_disk)
    with pytest.raises(InputError, match="No space left"):
        save_tree(random_tree(7, 1), target)
    assert load_tree(target).leaves == 5
    assert [p.name for p in tmp_path.iterdir()] == ["tree"]


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    save_tree(random_tree(20, 3), tmp_path / "tree")
    return tmp_path / "tree"


@pytest.mark.parametrize("name", [*ARRAYS, *FIELDS, *SEARCH_FILES])
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
        (json.dumps(version), "version must be 1 or 2, not 99"),
        ("{}", "format must be"),
        ("[]", "format must be"),
    ):
        path.write_text(content)
        with pytest.raises(InputError, match=message):
            load_tree(saved)
    path.unlink()
    with pytest.raises(InputError, match="cannot be read"):
        load_tree(saved)


@pytest.mark.parametrize("name", [*ARRAYS, *FIELDS])
def test_large_undisturbed_files_are_opened_without_reading_them(
    saved: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only `verify_tree` finds an alteration that restores the modification time."""
    monkeypatch.setattr(tree_files, "_ALWAYS_CHECKED_BYTES", 0)
    read = []
    digest = tree_files._sha256
    monkeypatch.setattr(tree_files, "_sha256", lambda path: read.append(path) or digest(path))
    load_tree(saved)
    assert read == []
    assert time.time() - (saved / "tree.json").stat().st_mtime > 5  # later changes get later times
    path = saved / f"{name}.npy"
    data = path.read_bytes()
    stamp = path.stat().st_mtime_ns
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))  # at once: the clock hardly moved
    with pytest.raises(InputError, match=f"{name}.npy: checksum must match"):
        load_tree(saved)
    assert read == [path]
    os.utime(path, ns=(stamp, stamp))
    load_tree(saved)
    with pytest.raises(InputError, match=f"{name}.npy: checksum must match"):
        verify_tree(saved)
    path.write_bytes(data[:-1])
    os.utime(path, ns=(stamp, stamp))
    with pytest.raises(InputError, match=f"{name}.npy: must have {len(data)} bytes"):
        load_tree(saved)
    path.write_bytes(data)
    verify_tree(saved)


def test_a_copied_tree_is_read_once_more(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tree_files, "_ALWAYS_CHECKED_BYTES", 0)
    now = time.time_ns()
    for number, path in enumerate(sorted(saved.iterdir())):
        os.utime(path, ns=(now + number, now + number))
    assert load_tree(saved).leaves == 20


@pytest.mark.parametrize("options", [BuildOptions(), BuildOptions(1), BuildOptions(16, 0.7)])
def test_a_tree_built_into_files_is_the_one_built_in_memory(
    tmp_path: Path, options: BuildOptions
) -> None:
    """On any number of threads, from memory or from a spool filled in pieces."""
    scene = random_scene(40_000, 9)
    before = parallel.threads()
    try:
        for count in (1, 3):
            parallel.set_threads(count)
            build_tree_files(scene, tmp_path / f"by {count}", options=options)
    finally:
        parallel.set_threads(before)
    (tmp_path / "spool").mkdir()
    spool = LeafSpool(tmp_path / "spool", len(scene), scene.sh_degree)
    for low in range(0, len(scene), 7777):
        spool.append(scene.take(np.arange(low, min(low + 7777, len(scene)))))
    build_tree_files(spool.scene(), tmp_path / "spooled", options=options, release=spool.release)
    save_tree(build_tree(scene, options=options), tmp_path / "memory")
    for path in (tmp_path / "memory").iterdir():
        for other in ("by 1", "by 3", "spooled"):
            assert path.read_bytes() == (tmp_path / other / path.name).read_bytes(), path.name
    verify_tree(tmp_path / "by 1")


@pytest.mark.parametrize("leaves", [1, 2, 8, 20, 500])
def test_stored_search_arrays_are_those_made_in_memory(
    tmp_path: Path, leaves: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(search_files, "_BLOCK_NODES", 64)
    tree = random_tree(leaves, 4)
    save_tree(tree, tmp_path / "tree")
    stored = load_tree(tmp_path / "tree").search_arrays
    made = SearchTree.of(tree)
    assert stored is not None
    assert np.array_equal(stored.groups.view(np.int32), made.groups.view(np.int32))
    assert np.array_equal(stored.records.view(np.int32), made.records[1])
    assert made.records[1].shape == (len(tree), 8)
    verify_tree(tmp_path / "tree")


def test_a_tree_of_version_1_has_no_search_arrays_and_is_searched_like_others(saved: Path) -> None:
    request = SearchRequest((1, 1, 1), 100, 6)
    cut = flat_search(load_tree(saved), request)
    path = saved / "tree.json"
    description = json.loads(path.read_text())
    for name in SEARCH_FILES:
        (saved / f"{name}.npy").unlink()
        del description["arrays"][name]
    for version, message in ((1, ""), (2, "must list the arrays")):
        description["version"] = version
        description["sha256"] = tree_files._digest(description)
        path.write_text(json.dumps(description))
        if message:
            with pytest.raises(InputError, match=message):
                load_tree(saved)
            continue
        tree = verify_tree(saved)
        assert tree.search_arrays is None
        assert np.array_equal(flat_search(tree, request).node_ids, cut.node_ids)


def test_search_arrays_that_do_not_follow_from_the_tree_are_refused(tmp_path: Path) -> None:
    """Whole files with right checksums, but not of this tree."""
    tree = random_tree(20, 3)
    for index, name in enumerate(SEARCH_FILES):
        save_tree(tree, tmp_path / name)
        stored = load_tree(tmp_path / name).search_arrays
        assert stored is not None
        path = tmp_path / name / f"{name}.npy"
        other = np.array(stored[index])
        other.reshape(-1)[1] += 1
        np.save(path, other)
        description = json.loads((tmp_path / name / "tree.json").read_text())
        description["arrays"][name]["sha256"] = tree_files._sha256(path)
        description["sha256"] = tree_files._digest(description)
        (tmp_path / name / "tree.json").write_text(json.dumps(description))
        with pytest.raises(InputError, match=f"{name}.npy: must follow from the other arrays"):
            verify_tree(tmp_path / name)


def test_search_arrays_of_another_tree_are_refused() -> None:
    small, large = random_tree(20, 3), SearchTree.of(random_tree(40, 3))
    stored = SearchArrays(large.groups, large.records[0])
    with pytest.raises(InputError, match="search tree: stored arrays must be"):
        SearchTree.of(dataclasses.replace(small, search_arrays=stored))


def test_released_pages_come_back(tmp_path: Path) -> None:
    save_tree(random_tree(500, 3), tmp_path / "tree")
    tree = SearchTree.of(load_tree(tmp_path / "tree"))
    before = tree.groups.copy()
    tree.release_groups()
    assert np.array_equal(tree.groups.view(np.int32), before.view(np.int32))
    SearchTree.of(random_tree(5, 3)).release_groups()  # nothing is mapped


@pytest.mark.skipif(
    not Path("/sys/kernel/mm/transparent_hugepage").exists(), reason="needs a Linux with huge pages"
)
def test_stored_records_may_be_mapped_in_huge_pages(tmp_path: Path) -> None:
    save_tree(random_tree(5, 3), tmp_path / "tree")
    tree = SearchTree.of(load_tree(tmp_path / "tree"))
    file = tmp_path / "tree" / "search_records.npy"
    assert "hg" not in _mapping_flags(file)
    records, _ = tree.records
    assert "hg" in _mapping_flags(file)
    assert np.array_equal(records, SearchTree.of(random_tree(5, 3)).records[0], equal_nan=True)


def _mapping_flags(file: Path) -> list[str]:
    """VmFlags of the mapping of a file (proc(5))."""
    mappings = Path("/proc/self/smaps").read_text().partition(str(file))[2]
    return mappings.partition("VmFlags:")[2].partition("\n")[0].split()


def test_a_spool_is_filled_exactly(tmp_path: Path) -> None:
    with LeafSpool(tmp_path, 10, 1) as spool:
        spool.append(random_scene(6, 1))
        with pytest.raises(InputError, match="must hold 10 leaves, not 6"):
            spool.scene()
        with pytest.raises(InputError, match="a spool of 10 leaves must not be given 12"):
            spool.append(random_scene(6, 2))


@pytest.mark.parametrize("most", [1, 100_000, 1 << 29])
def test_leaves_are_let_go_of_when_enough_were_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    """In every step and at the end; no release changes a bit."""
    monkeypatch.setattr(build, "_MAPPED_BYTES", most)
    scene, released = random_scene(3000, 8), []
    with LeafSpool(tmp_path, len(scene), 1) as spool:
        spool.append(scene)

    def release() -> None:
        spool.release()
        released.append(spool)

    build_tree_files(spool.scene(), tmp_path / "tree", release=release)
    read = 4 * 3000 * (11 + 12) * 4  # bytes: checked, merged, finished, and their harmonics
    assert len(released) <= 1 + read // most
    assert most > read or len(released) >= 4
    tree, wanted = load_tree(tmp_path / "tree"), build_tree(scene)
    for name in FIELDS:
        assert np.array_equal(getattr(tree.gaussians, name), getattr(wanted.gaussians, name))


MEMORY = """
import sys
from pathlib import Path
import numpy as np
import lod_cloud.build
from gaussians.parallel import set_threads
from gaussians.scene import Scene
from lod_cloud import LeafSpool, SearchRequest, build_tree_files, load_tree
from lod_cloud.search import SearchTree, flat_search
from lod_cloud.search_arrays import SearchArrays
from lod_cloud.search_files import SEARCH_FILES
from tests.lod_cloud.trees import random_scene

def peak_mb():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1e3

def build(count, folder):
    folder.mkdir()
    spool = LeafSpool(folder, count, 3)
    for number in range(count // 10_000):
        piece = random_scene(10_000, number, sh_degree=3)
        piece.means[:, 0] += 100 * number  # neighbours in the spool are neighbours in space
        spool.append(piece)
    build_tree_files(spool.scene(), folder / "tree", release=spool.release)
    return peak_mb()

def search(folder):
    flat_search(load_tree(folder / "tree"), SearchRequest((0, 0, 0), 900, 6))
    return peak_mb()

set_threads(2)
lod_cloud.build._MAPPED_BYTES = 1 << 22  # up to so much of the leaves in memory, however many
folder = Path(sys.argv[1])
if sys.argv[2] == "build":
    print(build(10_000, folder / "small"), build(200_000, folder / "large"))
else:
    print(search(folder / "small"), search(folder / "large"))
"""


def test_neither_building_nor_searching_holds_the_harmonics(tmp_path: Path) -> None:
    """Peak memory per leaf added, where a leaf and its share of nodes are 790 B on disk."""
    for what, most in (("build", 400), ("search", 150)):
        done = subprocess.run(
            [sys.executable, "-c", MEMORY, str(tmp_path), what],
            capture_output=True,
            text=True,
            check=True,
        )
        small, large = (float(value) for value in done.stdout.split())
        assert (large - small) * 1e6 / 190_000 < most, what
