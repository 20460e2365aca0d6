"""The one interface of all LoD searches, and what they share: the refined set and its changes.

A search decides for every node whether it is *refined*: replaced by its children. A cut is the
nodes that are not refined and whose parent is (or the root). The common currency is the *event*:
``expanded`` nodes are refined now and were not at the last search, ``collapsed`` ones were and are
not. They are the difference of two sets, so they do not depend on how a method found them.

With hysteresis h a node that was refined stays so until the camera is at least (1 + h) T away
(`lod_cloud.search.marks.stays_refined`). The rule looks at one node and its own past, and it is
nested: where a child stays refined its parent does too, since both spheres grew alike. So there is
still exactly one right answer to every request, given the answer to the one before.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np

from gaussians.errors import InputError
from lod_cloud.criterion import SearchRequest
from lod_cloud.lod_tree import Int32
from lod_cloud.search.events import cut_nodes, nodes_that_differ, nodes_that_entered
from lod_cloud.search.search_tree import Marks, SearchTree

HYSTERESIS_LIMIT = 0.05


@dataclass(frozen=True)
class SearchResult:
    """What one search changed, and what finding it took."""

    expanded: Int32  # ascending; refined now, not at the last search
    collapsed: Int32  # ascending; refined at the last search, not now
    cut_size: int  # nodes of the cut
    nodes_tested: int  # evaluations of the node test
    bytes_touched: int  # of the tree and of the client's own state, as the method reads them
    first: bool  # nothing was in the cut before
    _search: Search = field(repr=False)
    _number: int

    @cached_property
    def added(self) -> Int32:
        """Nodes in the cut now and not before, ascending; after the first search the whole cut."""
        return self.cut if self.first else self._entered(self.expanded, self.collapsed)

    @cached_property
    def removed(self) -> Int32:
        """Nodes in the cut before and not now, ascending."""
        return self.expanded[:0] if self.first else self._entered(self.collapsed, self.expanded)

    @cached_property
    def cut(self) -> Int32:
        """All nodes of the cut, ascending; O(cut). Only until the client's next search."""
        if self._search.searches != self._number:
            raise RuntimeError("the cut must be asked for before the next search")
        return cut_nodes(self._search.tree, self._search.refined, self.cut_size)

    def _entered(self, opened: Int32, closed: Int32) -> Int32:
        return nodes_that_entered(self._search.tree, opened, closed)


class Search(ABC):
    """LoD searches of one client in one tree: all of its state, a bit per node at least.

    Parameters
    ----------
    tree : shared with other clients
    hysteresis : h in 0..0.05; 0 makes the cut a function of the request alone
    """

    name: ClassVar[str]

    def __init__(self, tree: SearchTree, *, hysteresis: float = 0.0) -> None:
        if not (math.isfinite(hysteresis) and 0 <= hysteresis <= HYSTERESIS_LIMIT):
            raise InputError(f"hysteresis must lie in 0..{HYSTERESIS_LIMIT:g}, not {hysteresis}")
        self.tree = tree
        self.refined: Marks = tree.new_marks()  # of the newest search
        self.searches = 0  # made so far
        self.cut_size = 1
        self.grow = np.float32(1.0 + hysteresis)

    def search(self, request: SearchRequest) -> SearchResult:
        """The change of the cut from the last request to this one."""
        expanded, collapsed, tested, touched = self._advance(request)
        self.cut_size += self._growth(expanded) - self._growth(collapsed)
        self.searches += 1
        return SearchResult(
            expanded,
            collapsed,
            self.cut_size,
            tested,
            touched,
            self.searches == 1,
            self,
            self.searches,
        )

    @abstractmethod
    def _advance(self, request: SearchRequest) -> tuple[Int32, Int32, int, int]:
        """Bring ``refined`` up to date; events (both ascending), nodes tested, bytes touched."""

    def _growth(self, nodes: Int32) -> int:
        """By how much expanding these nodes enlarges the cut."""
        return int(self.tree.child_count[nodes].sum()) - len(nodes)

    @property
    def state_bytes(self) -> int:
        """Memory of this client, without what is shared."""
        return self.refined.nbytes


class FullSearch(Search):
    """A search that knows no history: it finds the refined set anew and compares it with the last.

    Keeps two bits per node.
    """

    def __init__(self, tree: SearchTree, *, hysteresis: float = 0.0) -> None:
        super().__init__(tree, hysteresis=hysteresis)
        self._other = tree.new_marks()

    def _advance(self, request: SearchRequest) -> tuple[Int32, Int32, int, int]:
        before = self.refined
        tested, touched = self._mark(request, before, self._other)
        self.refined, self._other = self._other, before
        expanded, collapsed = nodes_that_differ(self.refined, before)
        return expanded, collapsed, tested, touched + 2 * before.nbytes

    @abstractmethod
    def _mark(self, request: SearchRequest, before: Marks, marks: Marks) -> tuple[int, int]:
        """Write the refined set to ``marks`` (any content); nodes tested and bytes of the tree."""

    @property
    def state_bytes(self) -> int:
        return 2 * self.refined.nbytes
