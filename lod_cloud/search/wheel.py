"""Our incremental search: every decision that can change waits in a timing wheel until it may."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from lod_cloud.criterion import SearchRequest
from lod_cloud.lod_tree import Int32
from lod_cloud.search import wheel_buckets as wheel
from lod_cloud.search import wheel_decisions as decisions
from lod_cloud.search.interface import Search
from lod_cloud.search.search_tree import SearchTree
from lod_cloud.search.sectors import SectorTable, sector_table
from lod_cloud.search.streaming import StreamingSearch

UNLIMITED = 2**62
_UNKNOWN_RATE = 0.5  # of a hand of refined nodes, before the first step
_FEW = 1 << 16  # nodes
_RECORD_BYTES, _ENTRY_BYTES, _MARK_BYTES = 32, 4, 3


class WheelSearch(Search):
    """Tests only nodes whose decision may have changed: O(changes) per search.

    By nesting, only a cut node can be the next to expand and only a refined node without refined
    child the next to collapse. Each such node has one entry (4 B) in a bucket of a timing wheel,
    keyed by how far the camera must come in the node's direction before the decision can change;
    see `lod_cloud.search.wheel_buckets`. An entry is a statement about geometry, not about the
    cut: it stays when its node leaves the cut and holds when it comes back.

    The first search, and one whose tau or focal length differ from the last, are streamed and the
    wheel is filled again. Per client: 3 bits per node, 4.3 B per entry, and 68 B for every bucket
    in use.
    """

    name: ClassVar[str] = "wheel"

    def __init__(self, tree: SearchTree, *, hysteresis: float = 0.0) -> None:
        super().__init__(tree, hysteresis=hysteresis)
        self._floats, self._ints = tree.records
        self._sectors: SectorTable = sector_table()
        self._full = StreamingSearch(tree, hysteresis=hysteresis)
        self._hands = np.zeros(wheel.HANDS)
        self._rates = np.full(wheel.HANDS, _UNKNOWN_RATE)  # of the hands, per metre of path
        self._heads = np.full(wheel.BUCKETS, -1, np.int32)
        self._counts = np.array([-1, 0, 0], np.int32)
        self._chunks = np.empty((0, wheel.PER_CHUNK + 1), np.int32)
        self._scheduled = tree.new_marks()  # nodes that have an entry
        # room for the worst case; memory is taken by what is written
        self._lists = np.empty((3, len(tree)), np.int32)
        self._queue = np.empty(2 * len(tree), np.int32)
        self._numbers = np.zeros(3, np.int64)
        self._camera = np.zeros(3, np.float32)
        self._factor = np.float32(0.0)  # k of the last search; of none before the first

    def _advance(self, request: SearchRequest) -> tuple[Int32, Int32, int, int]:
        if request.factor != self._factor:
            return self._start_again(request)
        due = self._collect(request)
        expanded, collapsed, tested = self._settle(due, UNLIMITED)
        return np.sort(expanded), np.sort(collapsed), tested, self._touched(len(due), tested)

    def _start_again(self, request: SearchRequest) -> tuple[Int32, Int32, int, int]:
        """A full search, and a wheel filled anew."""
        outcome = self._stream(request)
        self.tree.release_groups()  # the wheel reads records
        self._clear()
        self._camera, self._factor = request.camera, request.factor
        self._fill(0, len(self.tree), UNLIMITED)
        return outcome

    def _stream(self, request: SearchRequest) -> tuple[Int32, Int32, int, int]:
        self._full.refined = self.refined
        outcome = self._full._advance(request)
        self.refined = self._full.refined
        return outcome

    def _clear(self) -> None:
        self._hands[:] = wheel.START_M
        self._heads[:] = -1
        self._counts[:] = -1, 0, 0
        self._scheduled[:] = 0

    def _collect(self, request: SearchRequest) -> Int32:
        """Move the hands to the new camera; nodes whose entries are due."""
        step = request.camera.astype(np.float64) - self._camera
        self._camera = request.camera
        due: Int32 = wheel.collect(
            step,
            self._hands,
            self._rates,
            self._heads,
            self._counts,
            self._chunks,
            *self._sectors,
        )
        return due

    def _settle(self, due: Int32, budget: int) -> tuple[Int32, Int32, int]:
        """Settle what is due; events in no order, and nodes tested."""
        cx, cy, cz = self._camera
        self._queue[: len(due)] = due
        tested: int = decisions.settle(
            self._queue,
            len(due),
            cx,
            cy,
            cz,
            self._factor,
            self.grow,
            self._floats,
            self._ints,
            self.refined,
            self._scheduled,
            budget,
            self._lists,
            self._numbers,
            self._hands,
            self._rates,
            self._heads,
            self._counts,
            self._chunks,
        )
        opened, closed, waiting = (
            row[:count] for row, count in zip(self._lists, self._numbers, strict=True)
        )
        if tested <= budget:
            self._insert(waiting)
        return opened.copy(), closed.copy(), tested

    def _fill(self, begin: int, end: int, most: int) -> int:
        """Schedule about ``most`` active nodes among begin..end; where to go on."""
        tree = self.tree
        nodes, at = decisions.active_nodes(
            begin,
            end,
            most,
            tree.first_child,
            tree.child_count,
            self.refined,
            self.refined.view(np.uint64),
            self._scheduled,
        )
        self._insert(nodes)
        return int(at)

    def _insert(self, nodes: Int32) -> None:
        needed = wheel.chunks_for(self._counts[wheel.ENTRIES] + len(nodes))
        if needed > len(self._chunks):
            larger = np.empty((needed + needed // 4, wheel.PER_CHUNK + 1), np.int32)
            larger[: len(self._chunks)] = self._chunks
            self._chunks = larger
        cx, cy, cz = self._camera
        wheel.insert(
            nodes,
            cx,
            cy,
            cz,
            self._factor,
            self.grow,
            self._floats,
            self.refined,
            self._hands,
            self._rates,
            self._heads,
            self._counts,
            self._chunks,
        )

    def _growth(self, nodes: Int32) -> int:
        """As for every search; few nodes are in the cache already, with their records."""
        if len(nodes) > _FEW:
            return super()._growth(nodes)
        return int(decisions.children_of(nodes, self._ints)) - len(nodes)

    @staticmethod
    def _touched(due: int, tested: int) -> int:
        return _ENTRY_BYTES * due + (_RECORD_BYTES + _MARK_BYTES + _ENTRY_BYTES) * tested

    @property
    def state_bytes(self) -> int:
        marks = 3 * self.refined.nbytes  # refined now and before, scheduled
        return marks + self._heads.nbytes + self._chunks.nbytes
