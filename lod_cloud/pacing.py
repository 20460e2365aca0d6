"""How far one message brings a client: which of the pending events come first.

The client's cut may lag behind the one the search found. What lies between them is *pending*:
nodes to expand and nodes to collapse. A message of limited size carries what matters most:

* Expansions by projected error, largest first. The error of a node is the tau at which it is just
  not refined any more, ``f e / (2 (d - R)) - 0.5`` px; by the nesting of R and e it is at most that
  of its parent. So the client is walked through the cuts of falling tau: coarse to fine, and near
  before far. It is walked in *stages*, tau = 120, 60, 30 px and so on: what is expanded at all is
  expanded down to the stage at once, because a node that is sent and later expanded was sent in
  vain. A node expanded in the same message as its parent is not sent.
* Collapses by whole subtrees, largest first, because only the topmost node of one is sent. They
  come before expansions only as far as the client's cut would outgrow the one wanted: nothing on
  screen waits for them.

Any choice leaves a cut: a node is expanded after its parent, and collapsed with all below it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lod_cloud.criterion import SearchRequest
from lod_cloud.lod_tree import Int32
from lod_cloud.pacing_kernels import expand_first, forest, include_below
from lod_cloud.search import SearchTree
from lod_cloud.search.events import nodes_that_differ
from lod_cloud.search.marks import set_marks
from lod_cloud.search.search_tree import Marks

FIRST_STAGE_PX = 120.0  # each of the following is half of the one before


@dataclass(frozen=True)
class Portion:
    """Events of one message, both ascending, and what is still pending after it."""

    expanded: Int32
    collapsed: Int32
    pending: int = 0  # nodes of the cut wanted that the client's will lack
    pending_error_px: float = 0.0  # largest error of a node not yet expanded; 0 when there is none

    @property
    def last(self) -> bool:
        """Whether nothing is pending after it."""
        return self.pending == 0


@dataclass(frozen=True)
class Limit:
    """What a message may be about: bytes, and what nodes and ids are expected to take of them."""

    size: float
    per_node: float
    per_id: float


class ClientCut:
    """The cut a client was told of, as its refined set, and the way from it to the one wanted.

    Memory: one bit per node of the tree.
    """

    def __init__(self, tree: SearchTree) -> None:
        self.tree = tree
        self.size = 1  # nodes; the root alone while nothing is refined
        self._refined: Marks = tree.new_marks()

    @property
    def state_bytes(self) -> int:
        """Memory of this object."""
        return self._refined.nbytes

    def clear(self) -> None:
        """Nothing is refined."""
        self._refined[:] = 0
        self.size = 1

    def commit(self, portion: Portion) -> None:
        """The client is told these events. Costs what they are."""
        set_marks(portion.expanded, self._refined, True)
        set_marks(portion.collapsed, self._refined, False)
        self.size += self._growth(portion.expanded) - self._growth(portion.collapsed)

    def all_to(self, wanted: Marks) -> Portion:
        """Every event on the way to the refined set ``wanted``. O(nodes / 64 + events)."""
        return Portion(*nodes_that_differ(wanted, self._refined))

    def first_to(
        self, wanted: Marks, request: SearchRequest, limit: Limit, *, least: int
    ) -> Portion:
        """Those of `all_to` that come first, as many as ``limit`` lets expect to fit, but at least
        ``least`` (0 or 1). O(nodes / 64 + pending events).
        """
        pending = self.all_to(wanted)
        subtrees = _Subtrees(self.tree, pending.collapsed)
        growth = self._growth(pending.expanded)
        room = max(0, growth - self._growth(pending.collapsed))  # until the cut wanted
        gone = subtrees.none
        if len(pending.expanded):
            excess = min(growth, limit.size / limit.per_node) - room
            gone = subtrees.largest(limit, limit.size / 2, excess, 0)
        opened, added, lacking, error_px = self._most_visible(
            pending.expanded,
            wanted,
            request,
            (limit.size - gone.size) / limit.per_node,
            room + self._growth(gone.nodes),
            0 if len(gone.nodes) else least,
        )
        left = limit.size - limit.per_node * added  # of no use to expansions
        if left > gone.size or not len(opened):
            gone = subtrees.largest(limit, left, math.inf, 0 if len(opened) else least)
        return Portion(opened, gone.nodes, lacking + gone.lacking, error_px)

    def _most_visible(
        self,
        pending: Int32,
        wanted: Marks,
        request: SearchRequest,
        limit_nodes: float,
        limit_growth: int,
        least: int,
    ) -> tuple[Int32, int, int, float]:
        """Of the nodes to expand those with the largest error; nodes they bring, nodes that the
        others would bring, and the largest error of these, px.
        """
        tree = self.tree
        cx, cy, cz = request.position
        stages = _stages(request.tau_px)
        opened, added, lacking, ratio = expand_first(
            pending,
            self._refined,
            wanted,
            tree.parent,
            tree.first_child,
            tree.child_count,
            tree.means,
            tree.radius,
            tree.extent,
            cx,
            cy,
            cz,
            ((2.0 * stages + 1.0) / request.focal_px).astype(np.float32),
            limit_nodes,
            limit_growth,
            least,
        )
        error_px = max(0.0, 0.5 * request.focal_px * ratio - 0.5)
        return np.sort(opened), added, lacking, error_px

    def _growth(self, nodes: Int32) -> int:
        """By how much expanding these nodes enlarges a cut."""
        return int(self.tree.child_count[nodes].sum()) - len(nodes)


@dataclass(frozen=True)
class _Collapses:
    """Some of the nodes to collapse."""

    nodes: Int32  # ascending
    size: float  # bytes expected
    lacking: int  # nodes that the others will bring


class _Subtrees:
    """Nodes to collapse (ascending, each with all that is refined below it), as a forest."""

    def __init__(self, tree: SearchTree, nodes: Int32) -> None:
        self._nodes = nodes
        self._above, self._sizes, self._shrink = forest(nodes, tree.parent, tree.child_count)
        self.none = _Collapses(nodes[:0], 0.0, int(np.count_nonzero(self._above < 0)))

    def largest(self, limit: Limit, size: float, shrink: float, least: int) -> _Collapses:
        """Whole subtrees of it, largest first, until the cut is smaller by ``shrink`` or ``size``
        bytes are spent, at least ``least`` (0 or 1) of them.
        """
        if shrink <= 0 or not len(self._nodes):
            return self.none
        cost = limit.per_node + limit.per_id * self._sizes
        fits = (cost <= size) | (self._sizes <= least)
        tops = np.flatnonzero(fits & ((self._above < 0) | ~fits[self._above]))
        tops = tops[np.argsort(-self._shrink[tops], kind="stable")]
        spent, shrunk = np.cumsum(cost[tops]), np.cumsum(self._shrink[tops])
        count = min(np.searchsorted(spent, size, "right"), np.searchsorted(shrunk, shrink) + 1)
        tops = tops[: max(int(count), least)]
        chosen = np.zeros(len(self._nodes), np.bool_)
        chosen[tops] = True
        include_below(chosen, self._above)
        lacking = np.count_nonzero(~chosen & (self._above < 0))
        return _Collapses(self._nodes[chosen], float(cost[tops].sum()), int(lacking))


def _stages(tau_px: float) -> NDArray[np.float64]:
    """Descending, px; below the last one there is nothing."""
    stages = [FIRST_STAGE_PX]
    while stages[-1] > max(tau_px, 1.0):
        stages.append(stages[-1] / 2)
    return np.array([*stages[:-1], -1.0])
