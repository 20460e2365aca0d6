"""A scene gives the same bits on any number of threads and wherever it lies in memory."""

from __future__ import annotations

import numpy as np
import pytest

from gaussians import parallel
from gaussians.scene import FIELDS, Scene
from lod_cloud.build import BuildOptions, build_tree
from lod_cloud.lod_tree import LodTree
from tests.lod_cloud.trees import random_scene


def assert_same(tree: LodTree, other: LodTree) -> None:
    for name in ("parent", "first_child", "child_count", "leaf_id", "radius", "extent"):
        assert np.array_equal(getattr(tree, name), getattr(other, name)), name
    for name in FIELDS:
        assert np.array_equal(*(getattr(t.gaussians, name) for t in (tree, other))), name


# the large ones: more leaves than are split, merged, numbered or filled with harmonics at a time
@pytest.mark.parametrize(
    ("leaves", "sh_degree", "threads", "pair_within"),
    [(5000, 1, 3, 16), (150_000, 0, 2, 16), (150_000, 0, 2, 1)],
)
def test_no_number_of_threads_changes_a_bit(
    leaves: int, sh_degree: int, threads: int, pair_within: int
) -> None:
    scene = random_scene(leaves, 11, sh_degree=sh_degree)
    before = parallel.threads()
    try:
        trees = []
        for count in (1, threads):
            parallel.set_threads(count)
            trees.append(build_tree(scene, options=BuildOptions(pair_within)))
    finally:
        parallel.set_threads(before)
    assert_same(*trees)


def test_a_scene_may_lie_in_memory_in_any_way() -> None:
    """Arrays that are columns of another one, and arrays nobody may write to."""
    scene = random_scene(3000, 15)
    wanted = build_tree(scene)
    wide = {f: np.repeat(getattr(scene, f)[..., None], 2, axis=-1)[..., 0] for f in FIELDS}
    fixed = {f: getattr(scene, f).copy() for f in FIELDS}
    for array in fixed.values():
        array.flags.writeable = False
    for other in (Scene(**wide), Scene(**fixed)):
        assert_same(build_tree(other), wanted)
