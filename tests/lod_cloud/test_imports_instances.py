"""Layouts as trees: what each instance holds, where it stands, and nesting far from the origin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussians import parallel
from gaussians.composition import Composition, Instances
from gaussians.errors import InputError
from gaussians.formats.layout import read_composition
from gaussians.scene import FIELDS, Scene
from lod_cloud import BuildOptions, SearchRequest, build_tree, load_tree, prove_nesting, verify_tree
from lod_cloud.imports import build_instanced_files, instances
from lod_cloud.search import SEARCHES, SearchTree, make_search
from tests.gaussians.real_data import data_file
from tests.lod_cloud.trees import random_scene


def composition(count: int, seed: int = 0, reach: float = 50.0) -> Composition:
    """Copies of three bases of different size and SH degree, one of them a single Gaussian."""
    rng = np.random.default_rng(seed)
    bases = [random_scene(60, 1), random_scene(9, 2, sh_degree=0), random_scene(1, 3, sh_degree=2)]
    turns = rng.normal(size=(count, 4))
    turns /= np.linalg.norm(turns, axis=1)[:, None]
    which, scales = rng.integers(0, 3, count), np.exp(rng.normal(0, 1, count))
    return Composition(bases, Instances(which, scales, turns, rng.normal(0, reach, (count, 3))))


def near(found: Scene, wanted: Scene) -> None:
    for name in FIELDS:
        got, right = getattr(found, name), getattr(wanted, name)
        assert np.allclose(got, right, rtol=3e-7, atol=1e-6), name


@pytest.mark.parametrize("count", [1, 2, 3, 40])
@pytest.mark.parametrize("ratio", [1.0, 0.6])
def test_leaves_are_the_composition(tmp_path: Path, count: int, ratio: float) -> None:
    sea = composition(count)
    build_instanced_files(sea, tmp_path / "tree", options=BuildOptions(fan_out_ratio=ratio))
    tree = verify_tree(tmp_path / "tree")
    near(tree.gaussians.take(tree.leaf_nodes()), sea.compose())
    assert prove_nesting(tree) == 0 and tree.metadata.build["structure"] == "instances"
    low, high = np.array(tree.metadata.bounds)
    means = sea.compose().means
    assert (low <= means.min(axis=0) + 1e-4).all() and (high >= means.max(axis=0) - 1e-4).all()


def test_a_copy_is_the_placed_tree_of_its_base(tmp_path: Path) -> None:
    """One copy, not moved: the tree of the base itself, node for node."""
    base = random_scene(300, 7)
    still = Instances(np.zeros(1, int), np.ones(1), np.eye(4)[:1], np.zeros((1, 3)))
    build_instanced_files(Composition([base], still), tmp_path / "tree")
    tree, own = load_tree(tmp_path / "tree"), build_tree(base)
    for name in ("parent", "first_child", "child_count", "level_offsets", "leaf_id"):
        assert np.array_equal(getattr(tree, name), getattr(own, name)), name
    near(tree.gaussians, own.gaussians)
    # spheres start from the stored, rounded axes here, from the merge itself there
    assert np.allclose(tree.radius, own.radius, rtol=1e-5)
    assert np.allclose(tree.extent, own.extent, rtol=1e-5, atol=1e-7)


def test_units_and_threads(tmp_path: Path) -> None:
    sea, before = composition(9), parallel.threads()
    for name, count in (("one", 1), ("three", 3)):
        parallel.set_threads(count)
        build_instanced_files(sea, tmp_path / name, units_per_metre=0.25)
    parallel.set_threads(before)
    one, three = (verify_tree(tmp_path / name) for name in ("one", "three"))
    for field in FIELDS:
        assert getattr(one.gaussians, field).tobytes() == getattr(three.gaussians, field).tobytes()
    wanted = sea.compose()
    assert np.allclose(one.gaussians.take(one.leaf_nodes()).means, 4 * wanted.means, rtol=1e-6)
    with pytest.raises(InputError, match="units per metre must be a positive number, not 0"):
        build_instanced_files(sea, tmp_path / "none", units_per_metre=0)


def test_too_many_nodes_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(instances, "_NODE_LIMIT", 100)
    with pytest.raises(InputError, match="a tree must have at most 100 nodes, not"):
        build_instanced_files(composition(20), tmp_path / "tree")
    assert list(tmp_path.iterdir()) == []


def test_nesting_holds_far_from_the_origin(tmp_path: Path) -> None:
    """At 1e5 m rounding moves means by millimetres, more than small nodes are wide."""
    build_instanced_files(composition(30, reach=1e5), tmp_path / "tree")
    assert prove_nesting(verify_tree(tmp_path / "tree")) == 0


def test_all_searches_agree(tmp_path: Path) -> None:
    build_instanced_files(composition(40, reach=10.0), tmp_path / "tree")
    tree = SearchTree.of(load_tree(tmp_path / "tree"))
    searches = [make_search(name, tree) for name in SEARCHES]
    sizes = set()
    for step in range(30):
        request = SearchRequest((0.4 * step - 6.0, 1.0, 0.5), 200.0, 15.0)
        cuts = [search.search(request).cut for search in searches]
        assert all(np.array_equal(cut, cuts[0]) for cut in cuts)
        sizes.add(len(cuts[0]))
    assert len(sizes) > 10


@pytest.mark.slow
@pytest.mark.real_data
def test_a_corner_of_the_donut_sea(tmp_path: Path) -> None:
    sea, _, _ = read_composition(data_file("scenes/donut/DonutSea.json"))
    few = sea.instances
    corner = Instances(few.bases[:12], few.scales[:12], few.quaternions[:12], few.positions[:12])
    part = Composition(sea.bases, corner)
    build_instanced_files(part, tmp_path / "tree", up=(0.0, 0.0, 1.0), units_per_metre=0.1)
    tree = verify_tree(tmp_path / "tree")
    assert tree.leaves == 12 * 45_624 and prove_nesting(tree) == 0
    wanted = part.compose()
    leaves = tree.gaussians.take(tree.leaf_nodes())
    assert np.allclose(leaves.means, 10 * wanted.means, rtol=1e-6, atol=1e-5)
