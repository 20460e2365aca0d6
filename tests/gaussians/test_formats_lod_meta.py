"""lod-meta.json: one level, all levels, leaves, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gaussians.errors import InputError
from gaussians.formats import load_lod_set, load_scene
from tests.gaussians.real_data import data_file
from tests.gaussians.test_formats_sog import as_archive, as_folder, random_sog

BOX = {"min": [-9, -9, -9], "max": [99, 99, 99]}


def pyramid(folder: Path, **changes: object) -> Path:
    """Two levels: level 0 has 9 + 5 Gaussians in two files, level 1 has 4 in one, with a gap."""
    as_folder(folder / "0_0", random_sog(9, 1, seed=1))
    as_folder(folder / "0_1", random_sog(5, 1, seed=2))
    as_archive(folder / "1_0.sog", random_sog(6, 0, seed=3))

    def leaf(**lods: tuple[int, int, int]) -> dict[str, object]:
        keys = ("file", "offset", "count")
        return {
            "bound": BOX,
            "lods": {level[1:]: dict(zip(keys, v, strict=True)) for level, v in lods.items()},
        }

    leaves = [
        leaf(L0=(2, 0, 5), L1=(1, 4, 2)),
        leaf(L0=(0, 6, 3)),
        leaf(L0=(0, 0, 6), L1=(1, 0, 2)),
    ]
    meta = {
        "lodLevels": 2,
        "environment": None,
        "filenames": ["0_0/meta.json", "1_0.sog", "0_1/meta.json"],
        "tree": {"children": [{"children": leaves[:2]}, leaves[2]]},
        **changes,
    }
    (folder / "lod-meta.json").write_text(json.dumps(meta))
    return folder


def test_one_level_is_the_union_of_its_leaf_ranges(tmp_path):
    folder = pyramid(tmp_path)
    first, second = load_scene(tmp_path / "0_0")[0], load_scene(tmp_path / "0_1")[0]
    coarse = load_scene(tmp_path / "1_0.sog")[0]
    scene, files = load_scene(folder)
    expected = [second.means, first.means[6:9], first.means[:6]]
    assert np.array_equal(scene.means, np.concatenate(expected))
    assert tmp_path / "1_0.sog" not in files
    assert files[0] == tmp_path / "lod-meta.json"
    assert len(files) == 1 + 2 * 8
    scene, files = load_scene(folder / "lod-meta.json", level=1)
    assert np.array_equal(scene.means, coarse.means[[4, 5, 0, 1]])
    assert files == [tmp_path / "lod-meta.json", tmp_path / "1_0.sog"]


def lone(level: str, **entry: object) -> dict[str, object]:
    lods = {level: {"file": 0, "offset": 0, "count": 1, **entry}}
    return {"tree": {"bound": BOX, "lods": lods}}


TWO_RANGES = {"children": [lone("0", count=5)["tree"], lone("0", offset=4)["tree"]]}
BAD_PYRAMID = {
    "environment": ({"environment": "env.sog"}, 0, "environment must be null, not 'env.sog'"),
    "names": ({"filenames": ["../x", "b", "c"]}, 0, "relative paths inside the folder"),
    "names absolute": ({"filenames": ["/x", "b", "c"]}, 0, "relative paths inside the folder"),
    "level 2": ({}, 2, r"level must be one of 0 \(finest\) to 1, not 2"),
    "level -1": ({}, -1, r"level must be one of 0 \(finest\) to 1, not -1"),
    "end": (lone("0", count=10), 0, "must end within its 9 Gaussians, not at 10"),
    "overlap": ({"tree": TWO_RANGES}, 0, "ranges of 0_0/meta.json must not overlap"),
    "file": (lone("0", file=3), 0, "file must be an integer from 0 to 2, not 3"),
    "offset": (lone("0", offset=-1), 0, "offset must be an integer"),
    "version": ({"version": 2}, 0, "version must be 1, not 2"),
    "counts": ({"counts": [13, 4]}, 0, r"the 14 Gaussians .* level 0, not \[13, 4\]"),
    "repeated": ({"filenames": ["a", "b", "a"]}, 0, "filenames must not repeat"),
    "no bound": ({"tree": {"lods": {}}}, 0, "must have the key 'bound'"),
    "bound": (
        {"tree": {"lods": {}, "bound": {"min": [0, 1, 0], "max": [0, 0, 0]}}},
        *(0, "min must not exceed max"),
    ),
    "no lods": ({"tree": {}}, 0, "must have the key 'lods'"),
    "no range": (lone("1"), 0, "level 0 is empty"),
    "empty range": (lone("0", count=0), 0, "level 0 is empty"),
    "file left out": (
        {"filenames": ["9_9/meta.json", "b", "c"]},
        0,
        "9_9/meta.json: cannot be read",
    ),
}


@pytest.mark.parametrize("case", BAD_PYRAMID)
def test_bad_levels_are_refused(tmp_path, case):
    changes, level, message = BAD_PYRAMID[case]
    folder = pyramid(tmp_path, **changes)
    with pytest.raises(InputError, match=message):
        load_scene(folder, level=level)

    with pytest.raises(InputError, match=message):
        load_lod_set(folder / "lod-meta.json", [level])


def test_all_levels_that_are_present_with_their_leaves(tmp_path):
    path = pyramid(tmp_path) / "lod-meta.json"
    lod_set = load_lod_set(str(path))
    assert (lod_set.level_count, sorted(lod_set.levels)) == (2, [0, 1])
    assert lod_set.leaf_boxes.tolist() == [[[-9] * 3, [99] * 3]] * 3
    assert lod_set.leaf_ranges[0].tolist() == [[0, 5], [5, 3], [8, 6]]
    assert lod_set.leaf_ranges[1].tolist() == [[0, 2], [2, 0], [2, 2]]
    assert len(lod_set.files) == len(set(lod_set.files)) == 1 + 2 * 8 + 1
    for level in (0, 1):
        scene, _ = load_scene(path, level)
        leaves = [lod_set.leaf(leaf, level) for leaf in range(3)]
        assert [len(leaf) for leaf in leaves] == lod_set.leaf_ranges[level][:, 1].tolist()
        assert np.array_equal(np.concatenate([leaf.means for leaf in leaves]), scene.means)
    stored = load_scene(tmp_path / "0_0")[0]
    assert np.array_equal(lod_set.leaf(1, 0).means, stored.means[6:9])


def test_levels_without_files_are_left_out_but_not_levels_that_lack_some(tmp_path):
    path = pyramid(tmp_path) / "lod-meta.json"
    (tmp_path / "1_0.sog").unlink()
    assert sorted(load_lod_set(path).levels) == [0]
    with pytest.raises(InputError, match=r"1_0\.sog: cannot be read"):
        load_lod_set(path, [1])
    (tmp_path / "0_1" / "meta.json").unlink()
    with pytest.raises(InputError, match=r"0_1/meta\.json: cannot be read"):
        load_lod_set(path)
    (tmp_path / "0_0" / "meta.json").unlink()
    with pytest.raises(InputError, match="no level of the scene is present"):
        load_lod_set(path)


def test_a_folder_with_two_scenes_must_be_named_by_file(tmp_path):
    pyramid(tmp_path)
    as_folder(tmp_path, random_sog(9, 1))
    with pytest.raises(InputError, match="not both"):
        load_scene(tmp_path)


@pytest.mark.real_data
def test_playbot_levels_have_their_known_counts():
    folder = data_file("scenes/playbot_lod")
    counts = [500_000, 250_000, 125_000, 31_000, 8_406, 3_000, 1_873]
    for level in range(1, 7):
        scene, files = load_scene(folder, level)
        assert (len(scene), scene.sh_degree, len(files)) == (counts[level], 2, 9)
    lod_set = load_lod_set(folder / "lod-meta.json", range(2, 7))
    assert {level: len(scene) for level, scene in lod_set.levels.items()} == dict(
        zip(range(2, 7), counts[2:], strict=True)
    )
    for level, ranges in lod_set.leaf_ranges.items():
        assert ranges[:, 1].sum() == counts[level]
        for leaf, (low, high) in enumerate(lod_set.leaf_boxes):
            means = lod_set.leaf(leaf, level).means
            assert (means >= low).all()
            assert (means <= high).all()
    with pytest.raises(InputError, match=r"0 \(finest\) to 6, not 7"):
        load_scene(folder, 7)
