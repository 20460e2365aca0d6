"""The selection rule of Octree-GS (arXiv:2403.17898) on our Gaussians: a baseline.

Every node has a level of detail 0 .. K - 1: its depth in an octree of voxels
(`lod_cloud.imports.octree`), in any other tree by its size, level l for an extent of E / 2^l, E the
root's. A node is selected when ``level <= floor(clamp(log2(s / d), 0, K - 1) + extra)`` with d its
distance from the camera and s the distance at which level 0 suffices, ``s = k E`` by our size
rule. Levels add up: coarse and fine nodes are selected together, so the set is no cut. There is no
frustum in it, as there is none in our cut.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gaussians.parallel import run_chunks
from lod_cloud.criterion import SearchRequest
from lod_cloud.search.rule import RuleSearch, Selection
from lod_cloud.search.search_tree import SearchTree

_BYTES_PER_NODE = 12 + 1  # mean, level
_FINEST = 255
_COARSEST = np.float32(0.0)


class OctreeGsSearch(RuleSearch):
    """One fused pass over all nodes.

    Parameters
    ----------
    extra_level : added to the predicted level, as in the original
    octree : the tree is one of voxels, whose depth is their level
    """

    name = "octree_gs"

    def __init__(self, tree: SearchTree, *, extra_level: float = 0.0, octree: bool = False) -> None:
        self.tree = tree
        self._extra = np.float32(extra_level)
        self._root_extent = np.float32(max(float(tree.extent[0]), float(np.finfo(np.float32).tiny)))
        if octree:
            offsets = tree.level_offsets
            levels = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets)).astype(np.float32)
        else:
            with np.errstate(divide="ignore"):
                levels = np.floor(np.log2(self._root_extent / tree.extent))
        self._levels = np.clip(levels, 0, _FINEST).astype(np.uint8)
        self._finest = np.float32(self._levels.max())

    def select(self, request: SearchRequest) -> Selection:
        cx, cy, cz = request.camera
        standard = np.float32(request.factor * self._root_extent)
        chunks = run_chunks(
            _select,
            len(self.tree),
            cx,
            cy,
            cz,
            standard,
            self._extra,
            self._finest,
            self.tree.means,
            self._levels,
        )
        count = len(self.tree)
        return Selection(np.concatenate(chunks), count, _BYTES_PER_NODE * count)


@njit(cache=True, error_model="numpy", nogil=True)
def _select(begin, end, cx, cy, cz, standard, extra, finest, means, levels):  # type: ignore[no-untyped-def]
    ids = np.empty(end - begin + 1, np.int32)
    found = 0
    for node in range(begin, end):
        dx = cx - means[node, 0]
        dy = cy - means[node, 1]
        dz = cz - means[node, 2]
        distance = np.sqrt((dx * dx + dy * dy) + dz * dz)
        depth = min(max(np.log2(standard / distance), _COARSEST), finest)
        predicted = np.floor(depth + extra)
        ids[found] = node
        found += levels[node] <= predicted
    return ids[:found].copy()
