"""What searches read of a tree: its hot arrays, and what is derived from them once for all
clients.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.errors import InputError
from lod_cloud.lod_tree import Float32, Int32
from lod_cloud.search.marks import set_bit

if TYPE_CHECKING:
    from lod_cloud.lod_tree import LodTree

Marks = NDArray[np.uint8]  # one bit per node, see `lod_cloud.search.marks`

FIRST_CHILD, CHILD_COUNT, PARENT = 5, 6, 7  # columns of a record after x, y, z, R, e
RECORD_COLUMNS = 8
_LINE_BYTES = 64
_CHUNK = 1 << 18


@dataclass(frozen=True)
class SearchTree:
    """Topology and node test of a tree, without its Gaussians. Shared by any number of clients.

    36 B per node, or nothing where the arrays are memory-mapped; `records` adds 32 B per node for
    the searches that visit nodes in no particular order.
    """

    parent: Int32  # [N], -1 for the root
    first_child: Int32  # [N], -1 for leaves; rises from one interior node to the next
    child_count: Int32  # [N], 0 for leaves
    level_offsets: Int32  # [levels + 1]
    means: Float32  # [N, 3]
    radius: Float32  # [N]
    extent: Float32  # [N]

    def __post_init__(self) -> None:
        count = len(self.parent)
        if count == 0:
            raise InputError("a search needs a tree with at least one node")
        for name in ("first_child", "child_count", "means", "radius", "extent"):
            array = getattr(self, name)
            if len(array) != count or not array.flags.c_contiguous:
                raise InputError(f"search tree: {name} must be contiguous with {count} rows")

    @classmethod
    def of(cls, tree: LodTree) -> SearchTree:
        """The hot arrays of a tree, not copied."""
        return cls(
            tree.parent,
            tree.first_child,
            tree.child_count,
            tree.level_offsets,
            tree.gaussians.means,
            tree.radius,
            tree.extent,
        )

    def __len__(self) -> int:
        return len(self.parent)

    @property
    def positions(self) -> Float32:
        """The means as one row of 3 N numbers."""
        return self.means.reshape(-1)

    def new_marks(self) -> Marks:
        """A bit per node, all clear."""
        return np.zeros(-(-len(self) // 64) * 8, np.uint8)

    @cached_property
    def records(self) -> tuple[Float32, Int32]:
        """[N, 8] everything about a node in half a cache line, as float32 and as int32.

        x, y, z, R, e, first child, child count, parent; R is NaN for leaves, which makes the node
        test fail for them. Both arrays are the same memory.
        """
        count = len(self)
        store = np.empty(count * RECORD_COLUMNS * 4 + _LINE_BYTES, np.uint8)
        shift = -store.ctypes.data % _LINE_BYTES
        numbers = store[shift : shift + count * RECORD_COLUMNS * 4].view(np.float32)
        floats = numbers.reshape(count, RECORD_COLUMNS)
        ints = floats.view(np.int32)
        for begin in range(0, count, _CHUNK):
            rows = slice(begin, begin + _CHUNK)
            floats[rows, :3] = self.means[rows]
            floats[rows, 3] = np.where(self.child_count[rows] > 0, self.radius[rows], np.nan)
            floats[rows, 4] = self.extent[rows]
            ints[rows, FIRST_CHILD] = self.first_child[rows]
            ints[rows, CHILD_COUNT] = self.child_count[rows]
            ints[rows, PARENT] = self.parent[rows]
        return floats, ints

    def treelet_roots(self, size: int) -> Marks:
        """Marks of the roots of the treelets of at least ``size`` nodes; made once per size."""
        if size not in self._treelet_roots:
            self._treelet_roots[size] = choose_treelet_roots(self.parent, self.child_count, size)
        return self._treelet_roots[size]

    @cached_property
    def _treelet_roots(self) -> dict[int, Marks]:
        return {}


def choose_treelet_roots(parent: Int32, child_count: Int32, size: int) -> Marks:
    """Roots of subtrees of at least ``size`` nodes (but for the topmost).

    Bottom-up: a node under which ``size`` nodes belong to no treelet yet becomes a root. In a
    binary tree sizes are below 2 ``size``.
    """
    roots = np.zeros(-(-len(parent) // 64) * 8, np.uint8)
    _choose_roots(parent, child_count, size, roots)
    return roots


@njit(cache=True, error_model="numpy", nogil=True)
def _choose_roots(parent, child_count, size, roots):  # type: ignore[no-untyped-def]
    waiting = np.zeros(len(parent), np.int32)  # nodes below that belong to no treelet yet
    for node in range(len(parent) - 1, 0, -1):
        if child_count[node] > 0 and waiting[node] >= size:
            set_bit(roots, node)
            waiting[node] = 0
        waiting[parent[node]] += 1 + waiting[node]
    set_bit(roots, 0)
