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
from gaussians.parallel import run_chunks
from lod_cloud.array_file import advise_huge_pages, release_pages
from lod_cloud.lod_tree import Float32, Int32
from lod_cloud.search.marks import set_bit
from lod_cloud.search_arrays import (
    GROUP,
    GROUP_ROWS,
    RECORD_COLUMNS,
    SearchArrays,
    aligned,
    number_of_groups,
    put_groups,
    put_records,
)

if TYPE_CHECKING:
    from lod_cloud.lod_tree import LodTree

Marks = NDArray[np.uint8]  # one bit per node, see `lod_cloud.search.marks`

_CHUNK = 1 << 14  # groups made at a time


@dataclass(frozen=True)
class SearchTree:
    """Topology and node test of a tree, without its Gaussians. Shared by any number of clients.

    Beside the arrays themselves (36 B per node) searches read `groups` (20 B per node) or `records`
    (32 B): nothing in memory where they are mapped from a tree on disk, else they are made when a
    search first asks for them.
    """

    parent: Int32  # [N], -1 for the root
    first_child: Int32  # [N], -1 for leaves; rises from one interior node to the next
    child_count: Int32  # [N], 0 for leaves
    level_offsets: Int32  # [levels + 1]
    means: Float32  # [N, 3]
    radius: Float32  # [N]
    extent: Float32  # [N]
    stored: SearchArrays | None = None  # where they exist already

    def __post_init__(self) -> None:
        count = len(self.parent)
        if count == 0:
            raise InputError("a search needs a tree with at least one node")
        for name in ("first_child", "child_count", "means", "radius", "extent"):
            array = getattr(self, name)
            if len(array) != count or not array.flags.c_contiguous:
                raise InputError(f"search tree: {name} must be contiguous with {count} rows")
        if self.stored is not None:
            shapes = self.stored.groups.shape, self.stored.records.shape
            wanted = ((number_of_groups(count), GROUP_ROWS, GROUP), (count, RECORD_COLUMNS))
            if shapes != wanted:
                raise InputError(f"search tree: stored arrays must be {wanted}, not {shapes}")

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
            tree.search_arrays,
        )

    def __len__(self) -> int:
        return len(self.parent)

    def new_marks(self) -> Marks:
        """A bit per node, all clear."""
        return np.zeros(-(-len(self) // 64) * 8, np.uint8)

    @cached_property
    def groups(self) -> Float32:
        """[ceil(N / 16), 5, 16] the node tests of 16 nodes side by side (`SearchArrays`)."""
        if self.stored is not None:
            return self.stored.groups
        groups = aligned(number_of_groups(len(self)), GROUP_ROWS, GROUP)
        run_chunks(self._put_groups, -(-len(groups) // _CHUNK), groups)
        return groups

    def release_groups(self) -> None:
        """Let go of the memory of groups that are mapped; they come back when they are read."""
        if self.stored is not None:
            release_pages(self.stored.groups)

    def _put_groups(self, begin: int, end: int, groups: Float32) -> None:
        for chunk in range(begin, end):
            rows = slice(chunk * _CHUNK * GROUP, (chunk + 1) * _CHUNK * GROUP)
            put_groups(
                groups[chunk * _CHUNK : (chunk + 1) * _CHUNK],
                self.means[rows],
                self.radius[rows],
                self.extent[rows],
                self.child_count[rows],
            )

    @cached_property
    def records(self) -> tuple[Float32, Int32]:
        """[N, 8] everything about a node (`SearchArrays`), as float32 and, the same memory, as
        int32.
        """
        if self.stored is not None:
            records = self.stored.records
            advise_huge_pages(records)
        else:
            records = aligned(len(self), RECORD_COLUMNS)
            run_chunks(self._put_records, -(-len(self) // (_CHUNK * GROUP)), records)
        return records, records.view(np.int32)

    def _put_records(self, begin: int, end: int, records: Float32) -> None:
        rows = slice(begin * _CHUNK * GROUP, end * _CHUNK * GROUP)
        put_records(
            records[rows],
            self.means[rows],
            self.radius[rows],
            self.extent[rows],
            self.child_count[rows],
            self.first_child[rows],
            self.parent[rows],
        )

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
