"""The paper's incremental search (Sec. 4.2): re-test the subtrees the last cut goes through."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from gaussians.errors import InputError
from lod_cloud.criterion import SearchRequest
from lod_cloud.lod_tree import Int32
from lod_cloud.search.interface import Search
from lod_cloud.search.search_tree import SearchTree
from lod_cloud.search.treelets import search_treelets

_RECORD_BYTES, _HEADER_BYTES = 32, 36
TREELET_NODES = 32


class TemporalSearch(Search):
    """Re-tests every treelet that bore cut nodes, and those the cut moves into: O(cut).

    A treelet that empties asks for the one above, an end that starts to refine for the one below,
    until nothing changes, however far that leads. Starts from the topmost treelet. Per client:
    2 bits per node and 36 B per bearing treelet.

    Parameters
    ----------
    treelet_nodes : least number of nodes of a treelet
    """

    name: ClassVar[str] = "temporal"
    _keeps_valid: ClassVar[bool] = False  # whether treelets that cannot have changed are left out

    def __init__(
        self, tree: SearchTree, *, hysteresis: float = 0.0, treelet_nodes: int = TREELET_NODES
    ) -> None:
        super().__init__(tree, hysteresis=hysteresis)
        if treelet_nodes < 1:
            raise InputError(f"treelet nodes must be at least 1, not {treelet_nodes}")
        self._roots = tree.treelet_roots(treelet_nodes)
        self._floats, self._ints = tree.records
        self._bearing = tree.new_marks()
        self._treelets = np.zeros(1, np.int32)
        self._balls = np.zeros((1, 4))  # where each was tested, and how far that holds
        self._factor = np.float32(0.0)

    def _advance(self, request: SearchRequest) -> tuple[Int32, Int32, int, int]:
        headers = len(self._treelets)
        cx, cy, cz = request.camera
        if request.factor != self._factor:
            self._balls[:, 3] = 0.0
            self._factor = request.factor
        self._treelets, self._balls, expanded, collapsed, tested = search_treelets(
            cx,
            cy,
            cz,
            request.factor,
            self.grow,
            self._floats,
            self._ints,
            self._roots,
            self.refined,
            self._bearing,
            self._treelets,
            self._balls,
            self._keeps_valid,
        )
        touched = _RECORD_BYTES * tested + _HEADER_BYTES * headers
        return np.sort(expanded), np.sort(collapsed), tested, touched

    @property
    def state_bytes(self) -> int:
        lists = self._treelets.nbytes + self._balls.nbytes
        return 2 * self.refined.nbytes + lists
