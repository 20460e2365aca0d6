"""Collapsed nodes and their children, as a client knows them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from lod_cloud.cut import without
from lod_cloud.events import Events
from lod_cloud.lod_tree import Int32
from lod_cloud.management_table import ManagementTable
from lod_cloud.node_records import NodeRecords
from lod_cloud.protocol import RemoteProtocolError
from lod_cloud.siblings import merge_siblings
from lod_cloud.subgraph import LocalSubgraph


@dataclass(frozen=True)
class Families:
    """Every child of every collapsed node is drawn before, or collapsed itself."""

    drawn: Int32  # ascending; in the cut before, below a collapsed node
    inner: Int32  # ascending; collapsed, below another
    inner_parents: Int32
    children: Int32  # both together, by parent, then by id
    parents: Int32  # of ``children``

    @classmethod
    def of(cls, events: Events, table: ManagementTable, held: LocalSubgraph) -> Families:
        """Raises RemoteProtocolError for events that collapse a node without children."""
        collapsed = np.union1d(events.tops, events.inner).astype(np.int32)
        below = held.children(collapsed)
        drawn = below[table.in_cut(below)]
        children = np.concatenate([drawn, events.inner])
        parents = np.concatenate([held.parents(drawn), events.inner_parents])
        order = np.lexsort([children, parents])
        children, parents = children[order], parents[order]
        if not np.array_equal(np.unique(parents), collapsed):
            raise RemoteProtocolError("a collapsed node must have children in the cut before")
        if (children <= parents).any():
            raise RemoteProtocolError("a parent must have a smaller id than its child")
        return cls(np.sort(drawn), events.inner, events.inner_parents, children, parents)

    def first_held(self, tops: Int32, table: ManagementTable) -> Int32:
        """Of each of these collapsed nodes the first child, its first child, and so on, until one
        is held.
        """
        near = self.children[np.searchsorted(self.parents, tops)]
        while not (there := table.holds(near)).all():
            near[~there] = self.children[np.searchsorted(self.parents, near[~there])]
        return near

    def merged(
        self, tops: Int32, parents: Int32, held: LocalSubgraph, table: ManagementTable
    ) -> NodeRecords:
        """These collapsed nodes (ascending, with their parents), from the bottom up. Raises
        RemoteProtocolError where harmonics are missing for that.
        """
        wanted = np.isin(self.parents, self._with_inner(tops))
        children, above = self.children[wanted], self.parents[wanted]
        known = held.records(np.sort(without(children, self.inner)))
        if table.plain(known.ids).any():
            raise RemoteProtocolError("a node must not be merged from others without harmonics")
        while len(children):
            missing = ~np.isin(children, known.ids, assume_unique=True)
            ready = ~np.isin(above, above[missing])
            ids, begins = np.unique(above[ready], return_index=True)
            bounds = np.append(begins, np.count_nonzero(ready)).astype(np.int32)
            rows = np.searchsorted(known.ids, children[ready])
            known = known.joined(merge_siblings(ids, ids, known.take(rows), bounds))
            children, above = children[~ready], above[~ready]
        found = known.take(np.searchsorted(known.ids, tops))
        return dataclasses.replace(found, parents=parents)

    def _with_inner(self, tops: Int32) -> Int32:
        """These collapsed nodes and all that are below them."""
        nodes = tops
        while True:
            below = self.inner[np.isin(self.inner_parents, nodes)]
            more = np.union1d(tops, below)
            if len(more) == len(nodes):
                return nodes
            nodes = more
