"""The selection rule of CityGaussian (arXiv:2404.01133) on our Gaussians: a baseline.

The ground is divided into square blocks. A block is drawn as a whole at one of a few levels:
all leaves, or the nodes of at most a given extent. It is switched by the distance from the camera
to the block on the ground: extent E suffices from k E on. The chosen lists of all blocks are put
together again whenever one of them changes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from lod_cloud.criterion import SearchRequest
from lod_cloud.lod_tree import Int32
from lod_cloud.search.rule import RuleSearch, Selection
from lod_cloud.search.search_tree import SearchTree

BLOCK_M = 100.0
EXTENTS_M = (0.0, 2.5, 5.0, 10.0, 20.0)  # 0: the leaves


class CityGaussianSearch(RuleSearch):
    """Blocks of about 100 m, five levels. The ids of a level stand in order block by block.

    Parameters
    ----------
    up : vertical of the tree; its largest component counts
    """

    name = "city_gaussian"

    def __init__(self, tree: SearchTree, *, up: tuple[float, float, float] = (0, 0, 1)) -> None:
        self.tree = tree
        if not any(up):
            raise InputError("up must be a direction, not (0, 0, 0)")
        self._axes = np.delete(np.arange(3), int(np.argmax(np.abs(up))))
        ground = tree.means[:, self._axes]
        self._low = ground.min(axis=0).astype(np.float64)
        span = ground.max(axis=0) - self._low
        self._sides = np.minimum(np.maximum(1, np.ceil(span / BLOCK_M)), 4096).astype(np.int64)
        self._edge = np.maximum(span / self._sides, 1e-30)
        cells = np.minimum(((ground - self._low) / self._edge).astype(np.int64), self._sides - 1)
        blocks = cells[:, 0] * self._sides[1] + cells[:, 1]
        self._levels = [_level(tree, blocks, int(self._sides.prod()), e) for e in EXTENTS_M]
        self._chosen = np.empty(0, np.int64)
        self._nodes = np.empty(0, np.int32)

    def select(self, request: SearchRequest) -> Selection:
        level = self._levels_of_blocks(request)
        copied = 0
        if not np.array_equal(level, self._chosen):
            parts = [self._levels[at][block] for block, at in enumerate(level)]
            self._nodes, self._chosen = np.concatenate(parts), level
            copied = self._nodes.nbytes
        return Selection(self._nodes, len(level), 16 * len(level) + 2 * copied)

    def _levels_of_blocks(self, request: SearchRequest) -> NDArray[np.int64]:
        here = np.asarray(request.position)[self._axes]
        nearest: list[Any] = []
        for axis in range(2):
            low = self._low[axis] + self._edge[axis] * np.arange(self._sides[axis])
            outside = np.maximum(low - here[axis], here[axis] - (low + self._edge[axis]))
            nearest.append(np.maximum(outside, 0.0))
        distance = np.hypot(nearest[0][:, None], nearest[1][None, :]).reshape(-1)
        switches = float(request.factor) * np.array(EXTENTS_M[1:])
        return np.searchsorted(switches, distance, side="right")


def _level(tree: SearchTree, blocks: NDArray[np.int64], count: int, extent: float) -> list[Int32]:
    """Ids per block of the leaves, or of the nodes of at most ``extent`` below larger ones."""
    leaf = tree.child_count == 0
    small = leaf | (tree.extent <= extent) if extent else leaf
    chosen = small.copy()
    if extent:
        chosen[1:] &= ~small[tree.parent[1:]]
    ids = np.flatnonzero(chosen).astype(np.int32)
    order = ids[np.argsort(blocks[ids], kind="stable")]
    ends = np.searchsorted(blocks[order], np.arange(1, count))
    return np.split(order, ends)
