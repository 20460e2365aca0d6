"""Trees of tiled cities have the statistics searches are measured on, already at small scale."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gaussians.errors import InputError
from gaussians.scene import concatenate
from gaussians.synthetic import TiledCity
from lod_cloud import LodTree, build_tree
from lod_cloud.walk_statistics import walk_statistics
from tests.lod_cloud.trees import random_tree


def tree_of(city: TiledCity) -> LodTree:
    path = tuple((float(x), float(y), float(z)) for x, y, z in city.path)
    return build_tree(concatenate(list(city.tiles())), up=(0.0, 0.0, 1.0), path=path)


@pytest.mark.parametrize(
    ("density", "leaves", "expected"),
    [
        (
            "dense",
            600_000,  # some metres of street: at full size three times as much changes
            {
                "leaves_per_m2": (1200, 1550),
                "sigma_m": (0.021, 0.029),
                "large_leaf_share": (0.35, 0.43),
                "added_per_m": (18_000, 29_000),
            },
        ),
        (
            "city",
            200_000,
            {
                "leaves_per_m2": (14, 21),
                "sigma_m": (0.17, 0.25),
                "large_leaf_share": (0.30, 0.38),
                "added_per_m": (200, 600),
            },
        ),
    ],
)
def test_statistics_at_small_scale(density: str, leaves: int, expected: dict) -> None:
    found = walk_statistics(tree_of(TiledCity(leaves, density, sh_degree=0)))
    for name, (low, high) in expected.items():
        assert low <= found[name] <= high, (name, found)


def test_statistics_count_what_they_say() -> None:
    """A cloud of points of known density beside a path of 20 m."""
    tree = random_tree(3000, 1, size_m=10.0)
    along = dataclasses.replace(tree.metadata, path=((-10.0, 0.0, 0.0), (10.0, 0.0, 0.0)))
    tree = dataclasses.replace(tree, metadata=along)
    found = walk_statistics(tree, focal_px=200.0)
    g, leaves = tree.gaussians, tree.leaf_nodes()
    x, y, _ = g.means[leaves].T
    near = leaves[(np.abs(x) <= 10) & (np.abs(y) <= 7.5)]
    assert found["leaves_per_m2"] == pytest.approx(len(near) / 300)
    assert found["sigma_m"] == pytest.approx(np.median(g.scales[near].max(axis=1)))
    large = tree.extent[leaves] >= 0.95 * tree.extent[tree.parent[leaves]]
    assert found["large_leaf_share"] == pytest.approx(large.mean(), abs=1e-3)
    assert found["added_per_m"] > 0
    with pytest.raises(InputError, match="need a tree with a path"):
        walk_statistics(random_tree(10, 1))
