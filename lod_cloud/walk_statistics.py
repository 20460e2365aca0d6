"""What a tree is like where its path leads: numbers that make or break a level-of-detail search."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from lod_cloud.criterion import SearchRequest
from lod_cloud.lod_tree import LodTree
from lod_cloud.search import SearchTree, make_search

_CORRIDOR_M = 7.5  # to both sides of the path: a street
_NOT_SMALLER = 0.95  # of the parent's extent
_STEP_M = 4 * 1.4 / 90  # a search every 4 frames at walking speed


def walk_statistics(
    tree: LodTree, *, focal_px: float = 929.2, tau_px: float = 6.0, searches: int = 12
) -> dict[str, float]:
    """Density, sizes and changes of the cut along the straight path of a tree (up is +z).

    ``leaves_per_m2`` of ground and ``sigma_m``, the median largest standard deviation, within
    7.5 m of the path; ``large_leaf_share``: leaves of at least 95 % of their parent's extent;
    ``added_per_m``: nodes that enter the cut per metre, from the middle of the path on. Reads all
    means and scales. Raises InputError for a tree without a path.
    """
    path = np.array(tree.metadata.path)
    if len(path) < 2:
        raise InputError("walk statistics need a tree with a path")
    leaves = np.flatnonzero(tree.child_count == 0)
    near = leaves[_beside(tree.gaussians.means, path)[leaves]]
    largest = tree.gaussians.scales[near].max(axis=1)
    ground = 2 * _CORRIDOR_M * float(np.linalg.norm(path[-1, :2] - path[0, :2]))
    parents = tree.extent[tree.parent[leaves]]
    return {
        "leaves_per_m2": len(near) / ground,
        "sigma_m": float(np.median(largest)) if len(near) else 0.0,
        "large_leaf_share": float((tree.extent[leaves] >= _NOT_SMALLER * parents).mean()),
        "added_per_m": _added_per_m(tree, path, focal_px, tau_px, searches),
    }


def _beside(means: NDArray[np.float32], path: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points stand beside the path, seen from above."""
    length = float(np.linalg.norm(path[-1, :2] - path[0, :2]))
    ahead = (path[-1, :2] - path[0, :2]) / length
    away = means[:, :2] - path[0, :2].astype(np.float32)
    along = away @ ahead.astype(np.float32)
    aside = away @ np.array([-ahead[1], ahead[0]], np.float32)
    beside: NDArray[np.bool_] = (along >= 0) & (along <= length) & (np.abs(aside) <= _CORRIDOR_M)
    return beside


def _added_per_m(
    tree: LodTree, path: NDArray[np.float64], focal_px: float, tau_px: float, searches: int
) -> float:
    step = (path[-1] - path[0]) / np.linalg.norm(path[-1] - path[0]) * _STEP_M
    start = path[len(path) // 2]
    search = make_search("flat", SearchTree.of(tree))
    added = 0
    for number in range(searches + 1):
        x, y, z = (float(c) for c in start + number * step)
        found = search.search(SearchRequest((x, y, z), focal_px, tau_px))
        added += 0 if found.first else len(found.added)
    return added / (searches * _STEP_M)
