"""The tree: structure, merge, node spheres, nesting."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gaussians.errors import InputError
from gaussians.scene import FIELDS, Scene
from lod_cloud import build
from lod_cloud.build import BuildOptions, build_tree
from lod_cloud.criterion import SearchRequest, prove_nesting
from lod_cloud.lod_tree import LodTree
from lod_cloud.merge import merge_leaves
from tests.lod_cloud.trees import random_scene, random_tree
from tests.naive import lod_merge as naive


def leaves_below(tree: LodTree) -> set[frozenset[int]]:
    below: list[set[int]] = [set() for _ in range(len(tree))]
    for node in range(len(tree) - 1, -1, -1):
        if tree.leaf_id[node] >= 0:
            below[node].add(int(tree.leaf_id[node]))
        if node:
            below[tree.parent[node]] |= below[node]
    return {frozenset(b) for b in below}


@pytest.mark.nojit
@given(st.integers(1, 80), st.integers(0, 9999))
@settings(max_examples=40, deadline=None)
def test_structure_equals_naive(count: int, seed: int) -> None:
    scene = random_scene(count, seed)
    tree = build_tree(scene, options=BuildOptions(pair_within=1)).validate()
    assert len(tree) == 2 * count - 1
    assert leaves_below(tree) == naive.leaf_sets(scene, list(range(count)))


@pytest.mark.nojit
@given(st.integers(1, 40), st.integers(0, 9999), st.sampled_from([2, 5, 8, 16, 64]))
@settings(max_examples=15, deadline=None)
def test_neighbours_merge_the_cheapest_pair(count: int, seed: int, pair_within: int) -> None:
    scene = solid_scene(count, seed)
    tree = build_tree(scene, options=BuildOptions(pair_within=pair_within)).validate()
    assert len(tree) == 2 * count - 1
    assert leaves_below(tree) == naive.paired_leaf_sets(scene, list(range(count)), pair_within)


def solid_scene(count: int, seed: int) -> Scene:
    """Nothing equal, nothing flat: every pair has a cost of its own."""
    scene = random_scene(count, seed)
    rng = np.random.default_rng(seed)
    scene.means[:] = rng.normal(0, 3, (count, 3))
    scene.scales[:] = np.exp(rng.normal(-1, 0.7, (count, 3)))
    scene.opacities[:] = rng.uniform(0.1, 1, count)
    return scene


@pytest.mark.nojit
@given(st.integers(2, 40), st.integers(0, 9999))
@settings(max_examples=40, deadline=None)
def test_interior_nodes_are_the_merge_of_their_children(count: int, seed: int) -> None:
    scene = random_scene(count, seed)
    scene.scales[:] = np.maximum(scene.scales, 1e-3)  # lines have a mass but no surface to keep it
    tree = build_tree(scene)
    g = tree.gaussians
    for node in np.flatnonzero(tree.child_count):
        first = tree.first_child[node]
        wanted = naive.merge(g.take(np.arange(first, first + tree.child_count[node])))
        size = max(np.sqrt(np.trace(wanted.covariance)), 1e-6)
        assert np.allclose(g.means[node], wanted.mean, rtol=1e-6, atol=1e-6)
        ours = naive.covariance(g.quaternions[node], g.scales[node])
        assert np.abs(ours - wanted.covariance).max() < 2e-6 * size * size
        assert g.sh[node] == pytest.approx(wanted.sh, rel=1e-5, abs=1e-6)
        # the surface of a line or a point is rounding noise, and so is its opacity
        if naive.surface(g.scales[node]) > 1e-5 * size * size:
            assert g.opacities[node] == pytest.approx(wanted.opacity, rel=1e-3)


def test_leaves_are_the_input_bit_for_bit() -> None:
    scene = random_scene(777, 3, sh_degree=3)
    tree = build_tree(scene)
    leaves = tree.gaussians.take(tree.leaf_nodes())
    for name in FIELDS:
        assert getattr(leaves, name).tobytes() == getattr(scene, name).tobytes()


@pytest.mark.parametrize("ratio", [1.0, 0.6])
def test_node_spheres_follow_the_definition(ratio: float) -> None:
    tree = build_tree(random_scene(200, 5), options=BuildOptions(fan_out_ratio=ratio))
    g = tree.gaussians
    margin = 1 + 2.0**-19
    for node in range(len(tree)):
        variances = np.diag(naive.covariance(g.quaternions[node], g.scales[node]))
        radius, extent = 3 * np.sqrt(variances.sum()), 6 * np.sqrt(variances.max())
        for child in np.flatnonzero(tree.parent == node):
            gap = np.linalg.norm(g.means[child].astype(float) - g.means[node].astype(float))
            radius = max(radius, (float(tree.radius[child]) + gap) * margin)
            extent = max(extent, float(tree.extent[child]) * margin)
        # rounded up; a node's own box is that of the merge before its axes were rounded
        for ours, wanted in ((tree.radius[node], radius), (tree.extent[node], extent)):
            assert wanted * (1 - 1e-6) <= ours <= wanted * (1 + 1e-6)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_tiny_scenes(count: int) -> None:
    tree = random_tree(count, 1).validate()
    assert (tree.leaves, len(tree)) == (count, 2 * count - 1)
    assert prove_nesting(tree) == 0


def point_scene(scales: float, opacities: list[float], spread: float = 1.0) -> Scene:
    count = len(opacities)
    means = np.zeros((count, 3), np.float32)
    means[:, 0] = spread * np.arange(count)
    quaternions = np.zeros((count, 4), np.float32)
    quaternions[:, 0] = 1
    size = np.full((count, 3), scales, np.float32)
    return Scene(
        means,
        quaternions,
        size,
        np.array(opacities, np.float32),
        np.ones((count, 1, 3), np.float32),
    )


def test_children_without_weight_get_equal_weights() -> None:
    for scales, opacities in ((0.0, [0.25, 0.75]), (0.1, [0.0, 0.0])):
        root = build_tree(point_scene(scales, opacities)).gaussians.take(np.array([0]))
        root.validate()
        assert root.means[0].tolist() == [0.5, 0.0, 0.0]
        assert root.opacities[0] == np.float32(np.mean(opacities))
        assert np.sort(root.scales[0])[2] == pytest.approx(np.hypot(scales, 0.5))


def test_points_on_one_spot_merge_to_a_point() -> None:
    root = build_tree(point_scene(0.0, [0.5] * 5, spread=0.0)).gaussians
    assert root.scales[0].tolist() == [0.0, 0.0, 0.0]
    assert root.opacities[0] == np.float32(0.5)


def test_equal_splats_on_one_spot_add_up_beyond_one() -> None:
    tree = build_tree(point_scene(0.1, [0.75] * 8, spread=0.0))
    assert tree.gaussians.opacities[0] == pytest.approx(6.0)


def test_needles_keep_their_thin_axis() -> None:
    scene = point_scene(0.0, [0.5, 0.5], spread=0.0)
    scene.scales[:] = (100.0, 1e-4, 1e-5)
    turn = np.array([0.8, 0.36, 0.48, 0.0], np.float32)
    scene.quaternions[:] = turn / np.linalg.norm(turn)
    root = np.sort(build_tree(scene).gaussians.scales[0].astype(float))
    assert root[2] == pytest.approx(100.0, rel=1e-6)
    assert root[:2].max() < 1e-3  # eigenvalues are exact to 1e-16 of the largest one


@given(st.integers(2, 300), st.integers(0, 9999), st.sampled_from([0.01, 10.0, 3000.0]))
@settings(max_examples=25, deadline=None)
def test_nesting_holds_everywhere(count: int, seed: int, size_m: float) -> None:
    assert prove_nesting(random_tree(count, seed, size_m=size_m)) == 0


def test_nesting_breaks_without_the_margin(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounding up alone is not enough: the float32 node test rounds as well."""
    scene = random_scene(20_000, 7)
    assert prove_nesting(build_tree(scene)) == 0
    monkeypatch.setattr(build, "merge_leaves", partial(merge_leaves, margin=1.0))
    assert prove_nesting(build_tree(scene)) > 100


def nasty_scenes() -> dict[str, Scene]:
    spread = random_scene(600, 5)
    duplicates = spread.take(np.repeat(np.arange(30), 20))
    outliers = random_scene(600, 6)
    outliers.means[::97] *= 2000.0  # 20 km away
    points = random_scene(300, 7)
    points.scales[:] = 0.0
    invisible = random_scene(300, 8)
    invisible.opacities[:] = 0.0
    needles = random_scene(300, 9)
    needles.scales[:] = (30.0, 1e-4, 1e-5)
    return {
        "duplicates": duplicates,
        "outliers": outliers,
        "points": points,
        "invisible": invisible,
        "needles": needles,
        "one": spread.take(np.arange(1)),
        "two": spread.take(np.arange(2)),
        "a group": spread.take(np.arange(16)),
        "a group and one": spread.take(np.arange(17)),
    }


@pytest.mark.parametrize("ratio", [1.0, 0.7, 0.3])
@pytest.mark.parametrize("group", [1, 16])
@pytest.mark.parametrize("name", nasty_scenes())
def test_nasty_scenes_give_valid_nested_trees(name: str, group: int, ratio: float) -> None:
    scene = nasty_scenes()[name]
    tree = build_tree(scene, options=BuildOptions(group, ratio)).validate()
    assert prove_nesting(tree) == 0 and tree.leaves == len(scene)
    leaves = tree.gaussians.take(tree.leaf_nodes())
    assert all(np.array_equal(getattr(leaves, f), getattr(scene, f)) for f in FIELDS)


def masses(tree: LodTree) -> np.ndarray:
    g = tree.gaussians
    return g.opacities.astype(float) * [naive.surface(s) for s in g.scales]


MASS_BOUND = 2e-7  # of the mass: opacity and scales are float32, 3 times half a step


@given(
    st.integers(2, 600),
    st.integers(0, 9999),
    st.sampled_from(["solid", "discs", "needles", "mixed"]),
    st.sampled_from([1, 16]),
    st.sampled_from([1.0, 0.7]),
)
@settings(max_examples=40, deadline=None)
def test_mass_is_conserved(
    count: int, seed: int, shape: str, pair_within: int, ratio: float
) -> None:
    """Opacity times surface of every node is that of its leaves, wherever these have any."""
    scene = random_scene(count, seed)
    rng = np.random.default_rng(seed)
    if shape != "mixed":
        scene.scales[:] = np.exp(rng.normal(-2, 2, (count, 3)))
    if shape in ("discs", "mixed"):
        scene.scales[: count // 2, 2] = 0.0
    if shape == "needles":
        scene.scales[:, 1:] *= 1e-5
    if shape == "mixed":  # lines, points and what cannot be seen, beside all the others
        scene.scales[::7, 1:] = 0.0
        scene.scales[::11] = 0.0
        scene.opacities[::5] = 0.0
    tree = build_tree(scene, options=BuildOptions(pair_within, ratio))
    mass = masses(tree)
    below = np.where(tree.child_count == 0, mass, 0.0)
    for node in range(len(tree) - 1, 0, -1):
        below[tree.parent[node]] += below[node]
    some = below > 0
    assert shape == "mixed" or some.any()
    assert np.abs(mass[some] / below[some] - 1).max(initial=0) < MASS_BOUND


def rows(tree: LodTree) -> np.ndarray:
    g = tree.gaussians
    return np.column_stack([g.means, g.quaternions, g.scales, g.opacities])


@pytest.mark.parametrize("ratio", [0.7, 0.5])
def test_irregular_trees_leave_small_steps_out(ratio: float) -> None:
    scene = solid_scene(4000, 12)
    whole = build_tree(scene)
    tree = build_tree(scene, options=BuildOptions(fan_out_ratio=ratio)).validate()
    inner = np.flatnonzero(tree.child_count)
    assert len(inner) < 0.8 * (len(scene) - 1) and tree.child_count.max() > 3
    # every kept node is a node of the binary tree, with the same Gaussian and a tighter sphere
    assert leaves_below(tree) <= leaves_below(whole)
    place = {row.tobytes(): node for node, row in enumerate(rows(whole))}
    same = np.array([place[row.tobytes()] for row in rows(tree)])
    wide, size = whole.radius[same], whole.extent[same]
    assert (tree.radius <= wide * (1 + 1e-6)).all() and (tree.radius[inner] < wide[inner]).any()
    assert (tree.extent <= size * (1 + 1e-6)).all()
    assert (size[inner[1:]] <= np.float32(ratio) * size[tree.parent[inner[1:]]]).all()
    gap = np.linalg.norm(
        tree.gaussians.means[1:].astype(float) - tree.gaussians.means[tree.parent[1:]], axis=1
    )
    assert (tree.radius[tree.parent[1:]] >= tree.radius[1:] + gap).all()
    assert prove_nesting(tree) == 0


@pytest.mark.parametrize("options", [{"pair_within": 0}, {"pair_within": 65}])
def test_groups_have_limits(options: dict) -> None:
    with pytest.raises(InputError, match=r"pair_within must lie in 1\.\.64"):
        BuildOptions(**options)
    for ratio in (0.0, -1.0, 1.5, np.nan):
        with pytest.raises(InputError, match=r"fan_out_ratio must lie in 0\.\.1"):
            BuildOptions(fan_out_ratio=ratio)


def test_bad_input_is_refused() -> None:
    scene = random_scene(4, 0)
    with pytest.raises(InputError, match="the scene is empty"):
        build_tree(scene.take(np.arange(0)))
    scene.means[2, 1] = np.nan
    with pytest.raises(InputError, match="means must be finite"):
        build_tree(scene)
    scene.means[2, 1] = 1e13
    with pytest.raises(InputError, match="within 1e\\+12 m"):
        build_tree(scene)
    dense = point_scene(0.1, [1e6, 1e6], spread=0.0)
    with pytest.raises(InputError, match="merged opacities must not exceed"):
        build_tree(dense)


@pytest.mark.parametrize(
    ("position", "focal", "tau", "message"),
    [
        ((0, 0, np.nan), 900, 6, "position must be three numbers"),
        ((0, 0, 1e300), 900, 6, "position must be three numbers"),
        ((0, 0), 900, 6, "position must be three numbers"),
        ((0, 0, 0), 0, 6, "focal length must lie in"),
        ((0, 0, 0), np.inf, 6, "focal length must lie in"),
        ((0, 0, 0), 900, -1, "tau must be a finite number"),
        ((0, 0, 0), 900, np.inf, "tau must be a finite number"),
    ],
)
def test_requests_are_checked(position: tuple, focal: float, tau: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        SearchRequest(position, focal, tau)


def test_validate_names_the_broken_rule() -> None:
    tree = random_tree(9, 2)
    parent = tree.parent.copy()
    parent[5] = 7
    with pytest.raises(InputError, match="smaller number than its child"):
        dataclasses.replace(tree, parent=parent).validate()
    leaf_id = tree.leaf_id.copy()
    leaf_id[leaf_id == 3] = 4
    with pytest.raises(InputError, match="leaf_id must number the leaves"):
        dataclasses.replace(tree, leaf_id=leaf_id).validate()
