"""The tree build written from its definition: recursive, dense matrices, numpy eigenvalues."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.scene import Scene

Float64 = NDArray[np.float64]


def leaf_order(scene: Scene, ids: list[int]) -> list[int]:
    """Ids from left to right: split at the median of the longest axis, equal coordinates by id."""
    if len(ids) == 1:
        return ids
    points = scene.means[ids]
    axis = int(np.argmax(points.max(axis=0) - points.min(axis=0)))
    ordered = sorted(ids, key=lambda i: (float(scene.means[i, axis]), i))
    half = len(ids) // 2
    return leaf_order(scene, ordered[:half]) + leaf_order(scene, ordered[half:])


def leaf_sets(scene: Scene, ids: list[int]) -> set[frozenset[int]]:
    """The leaves below every node of the tree."""
    if len(ids) == 1:
        return {frozenset(ids)}
    ordered = leaf_order(scene, ids)
    half = len(ids) // 2
    left, right = leaf_sets(scene, ordered[:half]), leaf_sets(scene, ordered[half:])
    return {frozenset(ids)} | left | right


def paired_leaf_sets(scene: Scene, ids: list[int], pair_within: int) -> set[frozenset[int]]:
    """The leaves below every node, where the cheapest of ``pair_within`` neighbours merge."""
    found = {frozenset([i]) for i in ids}

    def merge_down(slots: list[frozenset[int]], leave: int) -> list[frozenset[int]]:
        while len(slots) > leave:
            pairs = [(a, b) for i, a in enumerate(slots) for b in slots[:i]]
            a, b = min(pairs, key=lambda pair: _pair_cost(scene, *pair))
            slots = [s for s in slots if s not in (a, b)] + [a | b]
            found.add(a | b)
        return slots

    def reduced(ids: list[int]) -> list[frozenset[int]]:
        slots = [frozenset([i]) for i in ids]
        if len(ids) > pair_within:
            ordered = leaf_order(scene, ids)
            half = len(ids) // 2
            slots = reduced(ordered[:half]) + reduced(ordered[half:])
        return merge_down(slots, max(1, pair_within // 2))

    merge_down(reduced(ids), 1)
    return found


def numbering(
    children: NDArray[np.int32], root: int, extent: NDArray[np.float32], ratio: float
) -> tuple[list[list[int]], dict[int, int]]:
    """Levels of node numbers from left to right, and every kept node's parent in the unfinished
    tree; ``children`` and ``extent`` are those of the interior nodes, which come after the leaves.
    """
    leaves = len(children) + 1
    levels, parents = [[root]], {root: -1}

    def kept_below(node: int, above: int) -> list[int]:
        found = []
        for child in children[node - leaves].tolist():
            large = child >= leaves and (
                extent[child - leaves] > np.float32(ratio) * extent[above - leaves]
            )
            found += kept_below(child, above) if large else [child]
        return found

    while levels[-1]:
        below = []
        for node in levels[-1]:
            for child in kept_below(node, node) if node >= leaves else []:
                below.append(child)
                parents[child] = node
        levels.append(below)
    return levels[:-1], parents


def _pair_cost(scene: Scene, a: frozenset[int], b: frozenset[int]) -> float:
    both = [merge(scene.take(np.array(sorted(s)))) for s in (a, b)]
    c = merge(scene.take(np.array(sorted(a | b)))).covariance
    minors = sum(c[i, i] * c[j, j] - c[i, j] ** 2 for i, j in ((0, 1), (0, 2), (1, 2)))
    colour = both[0].sh[0] - both[1].sh[0]
    return float(minors * (1 + colour @ colour) ** 2)


@dataclass(frozen=True)
class Merged:
    mean: Float64
    covariance: Float64
    opacity: float
    sh: Float64


def covariance(quaternion: NDArray[np.float32], scales: NDArray[np.float32]) -> Float64:
    w, x, y, z = quaternion.astype(np.float64) / np.linalg.norm(quaternion.astype(np.float64))
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    half = rotation @ np.diag(scales.astype(np.float64))
    return half @ half.T


def surface(s: NDArray[np.floating]) -> float:
    a, b, c = (float(v) for v in s)
    return a * b + a * c + b * c


def merge(children: Scene) -> Merged:
    """Opacity x surface weights; plain means where there is no weight."""
    surfaces = np.array([surface(s) for s in children.scales])
    opacities = children.opacities.astype(np.float64)
    total = float((opacities * surfaces).sum())
    weights = (
        opacities * surfaces / total if total > 0 else np.full(len(children), 1 / len(children))
    )
    mean = weights @ children.means.astype(np.float64)
    spread = np.zeros((3, 3))
    for w, q, s, m in zip(
        weights, children.quaternions, children.scales, children.means, strict=True
    ):
        spread += w * (covariance(q, s) + np.outer(m - mean, m - mean))
    merged_surface = surface(np.sqrt(np.maximum(np.linalg.eigvalsh(spread), 0)))
    opacity = float(weights @ opacities)
    if total > 0 and merged_surface > 0:
        opacity = total / merged_surface
    return Merged(mean, spread, opacity, np.tensordot(weights, children.sh.astype(np.float64), 1))
