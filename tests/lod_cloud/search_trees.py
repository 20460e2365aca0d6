"""Trees without Gaussians, of every shape, and paths of cameras through them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from lod_cloud.criterion import SearchRequest
from lod_cloud.search import SearchTree
from tests.lod_cloud.trees import random_tree

MARGIN = 1.0 + 2.0**-19
FOCAL_PX = 200.0
TAUS_PX = (0.0, 3.0, 6.0, 15.0, 60.0, 1e6)


def _fan_outs(kind: str, nodes: int, rng: np.random.Generator) -> list[int]:
    """Children of every node, breadth-first; 0 for leaves."""
    if kind == "one leaf":
        return [0]
    if kind == "chain":  # one child each: decisions that bring no other nodes
        return [1] * (nodes - 1) + [0]
    if kind == "comb":
        return [2, *([0, 2] * ((nodes - 3) // 2)), 0, 0]
    counts: list[int] = []
    known = 1
    while len(counts) < known:
        if known >= nodes:
            counts.append(0)
            continue
        leaf = len(counts) > 0 and known > len(counts) + 1 and rng.random() < 0.3
        wide = rng.random() < 0.1
        counts.append(0 if leaf else int(rng.integers(30, 201) if wide else rng.integers(2, 6)))
        known += counts[-1]
    return counts


def shaped_tree(kind: str, nodes: int, seed: int) -> SearchTree:
    """A tree of about ``nodes`` nodes: "irregular" fan-out 2..200, "comb", "chain", "one leaf".

    Leaves lie in clusters, some of them exactly on top of each other, some without size.
    """
    rng = np.random.default_rng(seed)
    child_count = np.array(_fan_outs(kind, nodes, rng), np.int32)
    count = len(child_count)
    inner = child_count > 0
    first_child = np.full(count, -1, np.int32)
    first_child[inner] = 1 + np.concatenate([[0], np.cumsum(child_count[inner])[:-1]])
    parent = np.full(count, -1, np.int32)
    parent[1:] = np.repeat(np.flatnonzero(inner), child_count[inner])
    offsets = [0, 1]
    while offsets[-1] < count:
        offsets.append(offsets[-1] + int(child_count[offsets[-2] : offsets[-1]].sum()))
    means = np.empty((count, 3), np.float32)
    radius, extent = np.empty(count, np.float32), np.empty(count, np.float32)
    homes = rng.uniform(-10, 10, (max(1, count // 40), 3))
    for node in range(count - 1, -1, -1):
        side = 0.0 if rng.random() < 0.1 else float(np.exp(rng.normal(-2, 1)))
        below = slice(first_child[node], first_child[node] + child_count[node])
        if child_count[node]:
            means[node] = means[below].mean(axis=0)
        else:
            home = homes[rng.integers(len(homes))]
            means[node] = home if rng.random() < 0.2 else home + rng.normal(0, 0.5, 3)
        away = np.linalg.norm(means[below].astype(float) - means[node].astype(float), axis=1)
        spheres = (radius[below].astype(float) + away) * MARGIN
        extents = extent[below].astype(float) * MARGIN
        radius[node] = _up(max([0.8 * side, *spheres]))
        extent[node] = _up(max([side, *extents]))
    return SearchTree(
        parent, first_child, child_count, np.array(offsets, np.int32), means, radius, extent
    )


def _up(value: float) -> np.float32:
    rounded = np.float32(value)
    return rounded if rounded >= value else np.nextafter(rounded, np.float32(np.inf))


TREES: dict[str, Callable[[], SearchTree]] = {
    "binary": lambda: SearchTree.of(random_tree(300, 5)),
    "large binary": lambda: SearchTree.of(random_tree(3000, 6)),
    "irregular": lambda: shaped_tree("irregular", 900, 1),
    "large irregular": lambda: shaped_tree("irregular", 6000, 2),
    "comb": lambda: shaped_tree("comb", 101, 3),
    "chain": lambda: shaped_tree("chain", 40, 4),
    "one leaf": lambda: shaped_tree("one leaf", 1, 5),
    "two leaves": lambda: SearchTree.of(random_tree(2, 1)),
}
PATHS = ("stand", "walk", "flight", "teleport", "spheres", "settings")


def requests_along(
    path: str, tree: SearchTree, count: int, rng: np.random.Generator
) -> Iterator[SearchRequest]:
    """Cameras of one kind of motion; "spheres" stand on the very spheres of the node test,
    "settings" also change tau and the focal length.
    """
    position = rng.uniform(-5, 5, 3)
    heading = rng.normal(size=3)
    tau, focal = 6.0, FOCAL_PX
    for step in range(count):
        if path == "stand":
            position = position + rng.normal(0, 0.003, 3) * (rng.random() < 0.8)
        elif path in ("walk", "settings"):
            heading = heading + rng.normal(0, 0.2, 3)
            position = position + 0.06 * heading / np.linalg.norm(heading)
        elif path == "flight":
            position = 20 * np.array([np.cos(0.05 * step), np.sin(0.05 * step), 0.3])
        elif path == "teleport" and rng.random() < 0.3:
            position = rng.uniform(-30, 30, 3)
        elif path == "spheres" and len(tree) > 1:
            position = _on_a_sphere(tree, rng)
        if path == "settings" and rng.random() < 0.2:
            tau, focal = float(rng.choice(TAUS_PX)), float(rng.choice([90.0, 200.0, 929.2]))
        x, y, z = (float(v) for v in position)
        yield SearchRequest((x, y, z), focal, tau)


def _on_a_sphere(tree: SearchTree, rng: np.random.Generator) -> np.ndarray:
    """A point within a few float32 steps of distance T from an interior node."""
    k = SearchRequest((0, 0, 0), FOCAL_PX, 6.0).factor
    node = rng.choice(np.flatnonzero(tree.child_count))
    direction = rng.normal(size=3)
    if rng.random() < 0.5:  # where distance and T agree to the last bit
        direction = np.eye(3)[rng.integers(3)]
    t = float(tree.radius[node] + k * tree.extent[node]) * (1 + rng.integers(-3, 4) * 2.0**-24)
    return tree.means[node] + direction / np.linalg.norm(direction) * t
