"""LoD search and client selection written from their definitions: recursive, one node at a time."""

from __future__ import annotations

import numpy as np

from lod_cloud.criterion import SearchRequest
from lod_cloud.lod_tree import LodTree
from lod_cloud.search import SearchTree

F = np.float32


def refines(tree: LodTree, node: int, request: SearchRequest) -> bool:
    """T = fl(R + fl(k e)); d2 = fl(fl(dx dx + dy dy) + dz dz); not a leaf and d2 < fl(T T)."""
    if tree.child_count[node] == 0:
        return False
    k = F(request.focal_px / (2 * (request.tau_px + 0.5)))
    t = F(tree.radius[node] + F(k * tree.extent[node]))
    dx, dy, dz = (
        F(F(c) - m) for c, m in zip(request.position, tree.gaussians.means[node], strict=True)
    )
    d2 = F(F(F(dx * dx) + F(dy * dy)) + F(dz * dz))
    return bool(d2 < F(t * t))


def children(tree: LodTree, node: int) -> list[int]:
    return [int(c) for c in np.flatnonzero(tree.parent == node)]


def cut(tree: LodTree, request: SearchRequest, node: int = 0) -> list[int]:
    """The nodes that do not refine below refined ones, depth first."""
    if not refines(tree, node, request):
        return [node]
    return [n for child in children(tree, node) for n in cut(tree, request, child)]


def times_met(tree: LodTree, nodes: set[int], leaf: int) -> int:
    """How many of the nodes lie on the path from ``leaf`` to the root."""
    count = 0
    while leaf >= 0:
        count += leaf in nodes
        leaf = int(tree.parent[leaf])
    return count


def finest_complete_set(
    tree: LodTree, start: set[int], held: set[int], request: SearchRequest
) -> set[int]:
    """The client's selection: replace downwards until nothing changes, then upwards likewise."""
    drawn = set(start)
    while True:
        split = {
            n
            for n in drawn
            if refines(tree, n, request) and all(c in held for c in children(tree, n))
        }
        if not split:
            break
        drawn = (drawn - split) | {c for n in split for c in children(tree, n)}
    while True:
        join = {
            n
            for n in held - drawn
            if children(tree, n)
            and all(c in drawn for c in children(tree, n))
            and not refines(tree, n, request)
        }
        if not join:
            return drawn
        drawn = (drawn - {c for n in join for c in children(tree, n)}) | join


def refined_nodes(
    tree: SearchTree, request: SearchRequest, before: set[int], hysteresis: float = 0.0
) -> set[int]:
    """The refined set after a request, given the one before it: from the root, node by node.

    Refined: inside the sphere of radius T, or refined before and inside the one of (1 + h) T.
    """
    refined: set[int] = set()
    waiting = [0]
    while waiting:
        node = waiting.pop()
        if tree.child_count[node] == 0:
            continue
        if _inside(tree, node, request, F(1)) or (
            node in before and _inside(tree, node, request, F(1 + hysteresis))
        ):
            refined.add(node)
            first = int(tree.first_child[node])
            waiting += range(first, first + int(tree.child_count[node]))
    return refined


def cut_of(tree: SearchTree, refined: set[int]) -> list[int]:
    """Nodes that are not refined and whose parent is, or the root; ascending."""
    return [
        node
        for node in range(len(tree))
        if node not in refined and (node == 0 or int(tree.parent[node]) in refined)
    ]


def _inside(tree: SearchTree, node: int, request: SearchRequest, grow: np.float32) -> bool:
    """d2 < fl(T T) with T = fl(fl(g R) + fl(fl(g k) e))."""
    k = F(request.focal_px / (2 * (request.tau_px + 0.5)))
    t = F(F(grow * tree.radius[node]) + F(F(grow * k) * tree.extent[node]))
    dx, dy, dz = (F(F(c) - m) for c, m in zip(request.position, tree.means[node], strict=True))
    return bool(F(F(F(dx * dx) + F(dy * dy)) + F(dz * dz)) < F(t * t))
