"""Random scenes and trees for the tests of this folder."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from gaussians.scene import Scene, normalised_quaternions
from lod_cloud.build import build_tree
from lod_cloud.criterion import SearchRequest
from lod_cloud.lod_tree import LodTree


def random_scene(count: int, seed: int, *, sh_degree: int = 1, size_m: float = 10.0) -> Scene:
    """Gaussians in clusters, some exactly equal, some without surface, some transparent."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-size_m, size_m, (max(1, count // 8), 3))
    means = centres[rng.integers(0, len(centres), count)] + rng.normal(0, 0.2, (count, 3))
    means[rng.random(count) < 0.1] = centres[0]  # equal positions
    scales = np.exp(rng.normal(-3, 1, (count, 3)))
    scales[rng.random(count) < 0.1, 0] = 0.0
    scales[rng.random(count) < 0.05] = 0.0
    opacities = rng.beta(0.8, 0.8, count)
    opacities[rng.random(count) < 0.05] = 0.0
    sh = rng.normal(0, 0.3, (count, (sh_degree + 1) ** 2, 3))
    return Scene(
        means.astype(np.float32),
        normalised_quaternions(rng.normal(size=(count, 4))),
        scales.astype(np.float32),
        opacities.astype(np.float32),
        sh.astype(np.float32),
    )


def random_tree(count: int, seed: int, *, sh_degree: int = 1, size_m: float = 10.0) -> LodTree:
    return build_tree(random_scene(count, seed, sh_degree=sh_degree, size_m=size_m))


def requests(size_m: float = 12.0) -> st.SearchStrategy[SearchRequest]:
    """Anywhere in and around the scene; tau from the finest to one node."""
    coordinate = st.floats(-size_m, size_m, width=32)
    return st.builds(
        SearchRequest,
        st.tuples(coordinate, coordinate, coordinate),
        st.sampled_from([929.2, 20.0, 300.0]),
        st.sampled_from([0.0, 1.0, 6.0, 15.0, 60.0, 1e9]),
    )


def trees(max_leaves: int = 60) -> st.SearchStrategy[LodTree]:
    return st.builds(random_tree, st.integers(1, max_leaves), st.integers(0, 10_000))


def walk(seed: int, steps: int, *, teleports: bool = True) -> list[SearchRequest]:
    """A random walk with standstills and, every now and then, a jump."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(-5, 5, 3)
    path = []
    for _ in range(steps):
        kind = rng.random()
        if teleports and kind < 0.1:
            position = rng.uniform(-30, 30, 3)
        elif kind < 0.8:
            position = position + rng.normal(0, 0.5, 3)
        path.append(SearchRequest(tuple(position), 200.0, 6.0))
    return path
