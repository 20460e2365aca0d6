"""The client's local subgraph: the nodes it holds, and which of them to draw from where it is.

Rows are ordered by node id, so parents precede their children and siblings stand together;
decoded Gaussians stay where they were first put (slots), because moving them costs more than
everything else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.parallel import run_chunks
from gaussians.scene import FIELDS, Scene
from lod_cloud.criterion import SearchRequest, refines
from lod_cloud.lod_tree import Float32, Int32
from lod_cloud.management_table import TableChange
from lod_cloud.node_records import NodeRecords

_SPARE = 1.25  # slots are allocated this much ahead


@dataclass(frozen=True)
class Choice:
    """Rows to draw, ascending, and what finding them took."""

    rows: Int32
    nodes_tested: int
    refined: int  # nodes replaced by their children
    coarsened: int  # nodes that replaced their children


class LocalSubgraph:
    """Nodes held by a client, with their decoded Gaussians.

    Memory: 41 B per held node (and 8 B in the table) and 1.25 times the Gaussians of the largest
    number held so far. Does not know what is in the cut; its rows are those of the
    `ManagementTable` that told it what to keep.
    """

    def __init__(self, sh_degree: int) -> None:
        empty = np.empty(0, np.int32)
        self.ids: Int32 = empty
        self._parents, self._child_counts, self._slots = empty, empty, empty
        self._spheres = np.empty((0, 5), np.float32)  # x, y, z, R, e
        self._free: Int32 = empty
        coefficients = (sh_degree + 1) ** 2
        shapes = ((3,), (4,), (3,), (), (coefficients, 3))
        self._store = [np.empty((0, *shape), np.float32) for shape in shapes]
        self._first_child, self._complete = empty, np.empty(0, np.bool_)

    def __len__(self) -> int:
        return len(self.ids)

    def apply(self, change: TableChange, arrived: NodeRecords) -> None:
        """Drop the evicted rows and insert ``arrived``, whose ids are ``change.needed``."""
        kept = np.ones(len(self.ids), np.bool_)
        kept[np.searchsorted(self.ids, change.evicted)] = False
        positions = np.searchsorted(self.ids[kept], arrived.ids)

        def spliced(rows: NDArray[Any], fresh: NDArray[Any]) -> NDArray[Any]:
            left = rows if len(change.evicted) == 0 else rows[kept]
            return np.insert(left, positions, fresh, axis=0) if len(fresh) else left

        spheres = np.column_stack([arrived.gaussians.means, arrived.radius, arrived.extent])
        slots = self._allocate(self._slots[~kept], len(arrived))
        self.ids = spliced(self.ids, arrived.ids)
        self._parents = spliced(self._parents, arrived.parents)
        self._child_counts = spliced(self._child_counts, arrived.child_counts)
        self._slots = spliced(self._slots, slots)
        self._spheres = spliced(self._spheres, spheres)
        for store, name in zip(self._store, FIELDS, strict=True):
            store[slots] = getattr(arrived.gaussians, name)
        if len(change.evicted) or len(arrived):
            self._first_child, self._complete = _link(self.ids, self._parents, self._child_counts)

    def complete(self, ids: Int32, above: Float32) -> None:
        """Set the harmonics above degree 0, ``above`` [N, K - 1, 3], of nodes held."""
        self._store[-1][self._slots[np.searchsorted(self.ids, ids)], 1:] = above

    def child_counts(self, ids: Int32) -> Int32:
        """Number of children of nodes held."""
        return self._child_counts[np.searchsorted(self.ids, ids)]

    def children(self, ids: Int32) -> Int32:
        """All nodes held whose parent is one of ``ids`` (ascending, held or not)."""
        begins = np.searchsorted(self._parents, ids)
        counts = np.searchsorted(self._parents, ids, side="right") - begins
        offsets = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        return self.ids[np.repeat(begins, counts) + offsets]

    def parents(self, ids: Int32) -> Int32:
        """Parents of nodes held."""
        return self._parents[np.searchsorted(self.ids, ids)]

    def means(self, ids: Int32) -> Float32:
        """[N, 3] means of nodes held, in any order."""
        return self._spheres[np.searchsorted(self.ids, ids), :3]

    def records(self, ids: Int32) -> NodeRecords:
        """Nodes held (ascending) as they came, copied."""
        rows = np.searchsorted(self.ids, ids).astype(np.int32)
        spheres = self._spheres[rows]
        return NodeRecords(
            ids,
            self._parents[rows],
            self._child_counts[rows],
            np.ascontiguousarray(spheres[:, 3]),
            np.ascontiguousarray(spheres[:, 4]),
            self.gaussians(rows),
        )

    def choose(self, in_cut: NDArray[np.bool_], request: SearchRequest) -> Choice:
        """The finest complete set from ``request``'s position, starting from the cut (rows marked).

        Downwards first: a drawn node that refines and whose children are all held gives way to
        them, and so on. Then upwards: a node held that does not refine and whose children are all
        drawn takes their place, and so on. Both steps keep what the cut had: every path from the
        root to a leaf meets the set exactly once.
        """
        cx, cy, cz = request.camera
        rows, tested, refined, coarsened = _choose(
            in_cut,
            self._child_counts,
            self._first_child,
            self._complete,
            self._spheres,
            cx,
            cy,
            cz,
            request.factor,
        )
        return Choice(rows, tested, refined, coarsened)

    def gaussians(self, rows: Int32) -> Scene:
        """Decoded Gaussians of these rows, copied."""
        slots = self._slots[rows]
        arrays = [np.empty((len(slots), *store.shape[1:]), np.float32) for store in self._store]
        run_chunks(_gather, len(slots), slots, self._store, arrays)
        return Scene(*arrays)

    def _allocate(self, freed: Int32, count: int) -> Int32:
        """Slots for ``count`` nodes; ``freed`` ones are available again."""
        free = np.concatenate([self._free, freed])
        missing = count - len(free)
        if missing > 0:
            capacity = len(self._store[0])
            larger = int((capacity + missing) * _SPARE)
            self._store = [_grown(store, larger) for store in self._store]
            free = np.concatenate([free, np.arange(capacity, larger, dtype=np.int32)])
        self._free = free[count:]
        return np.sort(free[:count])


def _gather(
    begin: int, end: int, slots: Int32, sources: list[Float32], targets: list[Float32]
) -> None:
    for source, target in zip(sources, targets, strict=True):
        # mode "clip" writes to ``out`` directly; every slot is within the store
        np.take(source, slots[begin:end], axis=0, out=target[begin:end], mode="clip")


def _grown(array: Float32, rows: int) -> Float32:
    larger = np.empty((rows, *array.shape[1:]), np.float32)
    larger[: len(array)] = array
    return larger


@njit(cache=True, error_model="numpy", nogil=True)
def _link(ids, parents, child_counts):  # type: ignore[no-untyped-def]
    """Per row: row of its first held child, and whether all children are held. One merge of two
    orders.
    """
    first_child = np.full(len(ids), -1, np.int32)
    held = np.zeros(len(ids), np.int32)
    above = 0
    for row in range(len(ids)):
        while ids[above] < parents[row]:
            above += 1
        if ids[above] == parents[row]:
            if held[above] == 0:
                first_child[above] = row
            held[above] += 1
    return first_child, (held == child_counts) & (child_counts > 0)


@njit(cache=True, error_model="numpy", nogil=True)
def _choose(in_cut, child_counts, first_child, complete, spheres, cx, cy, cz, k):  # type: ignore[no-untyped-def]
    drawn = in_cut.copy()
    tested = refined = coarsened = 0
    for row in range(len(drawn)):
        if drawn[row] and complete[row]:
            tested += 1
            x, y, z, radius, extent = spheres[row]
            if refines(cx, cy, cz, x, y, z, radius, extent, k):
                refined += 1
                drawn[row] = False
                for child in range(first_child[row], first_child[row] + child_counts[row]):
                    drawn[child] = True
    count = 0
    for row in range(len(drawn) - 1, -1, -1):
        if not drawn[row] and complete[row]:
            every = True
            for child in range(first_child[row], first_child[row] + child_counts[row]):
                every = every and drawn[child]
            if every:
                tested += 1
                x, y, z, radius, extent = spheres[row]
                if not refines(cx, cy, cz, x, y, z, radius, extent, k):
                    coarsened += 1
                    drawn[row] = True
                    count += 1 - child_counts[row]
                    for child in range(first_child[row], first_child[row] + child_counts[row]):
                        drawn[child] = False
                    continue
        if drawn[row]:
            count += 1
    rows = np.empty(count, np.int32)
    count = 0
    for row in range(len(drawn)):
        if drawn[row]:
            rows[count] = row
            count += 1
    return rows, tested, refined, coarsened
