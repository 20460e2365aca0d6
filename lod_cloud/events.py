"""Changes of a cut as events: a node gave way to its children, or took their place.

An event names both what leaves the cut and what enters it with one number, so a message carries
events instead of nodes. The cloud derives them from the tree. The client turns them back into nodes
with what it was told: it knows the number of children of every node it holds, and children have
consecutive numbers, the first of which the event carries.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lod_cloud.columns import ColumnReader, ColumnWriter
from lod_cloud.cut import without
from lod_cloud.lod_tree import Int32, LodTree
from lod_cloud.protocol import RemoteProtocolError

_COLUMNS = 6


@dataclass(frozen=True)
class Events:
    """The change from one cut to the next, for a client that holds the first. Ids ascending."""

    expanded: Int32  # [E] refined now, not before
    first_children: Int32  # [E]
    fan_outs: Int32  # number of children of those of ``expanded`` that were not in the cut before
    tops: Int32  # refined before, now in the cut
    top_parents: Int32  # of those of ``tops`` that the client does not hold
    inner: Int32  # refined before, now below one of ``tops``

    @classmethod
    def between(cls, tree: LodTree, added: Int32, removed: Int32, needed: Int32) -> Events:
        """The events by which a cut gains ``added`` and loses ``removed`` (ascending); the client
        holds all of these but ``needed``.
        """
        expanded = _refined_between(tree.parent, removed, added)
        collapsed = _refined_between(tree.parent, added, removed)
        at_top = np.isin(collapsed, added, assume_unique=True)
        tops = collapsed[at_top]
        return cls(
            expanded=expanded,
            first_children=tree.first_child[expanded],
            fan_outs=tree.child_count[without(expanded, removed)],
            tops=tops,
            top_parents=tree.parent[tops[np.isin(tops, needed, assume_unique=True)]],
            inner=collapsed[~at_top],
        )

    def to_bytes(self) -> bytes:
        """The columns, with their lengths."""
        writer = ColumnWriter()
        columns = self._columns()
        writer.plain(np.array([len(column) for column in columns], np.uint32))
        for column in columns:
            writer.differences(column)
        return writer.bytes()

    @classmethod
    def read(cls, reader: ColumnReader) -> Events:
        """Inverse of `to_bytes`. Raises RemoteProtocolError for anything it would not write."""
        counts = reader.plain(np.uint32, _COLUMNS)
        events = cls(*(reader.differences(np.int32, int(count)) for count in counts))
        for ids in (events.expanded, events.first_children, events.tops, events.inner):
            if len(ids) and (ids[0] < 0 or (np.diff(ids.astype(np.int64)) <= 0).any()):
                raise RemoteProtocolError("ids of events must be ascending and >= 0")
        if len(events.expanded) != len(events.first_children):
            raise RemoteProtocolError("every expanded node must have a first child")
        if (events.fan_outs < 1).any():
            raise RemoteProtocolError("an expanded node must have at least one child")
        return events

    def _columns(self) -> tuple[Int32, ...]:
        firsts, tops = self.first_children, self.tops
        return self.expanded, firsts, self.fan_outs, tops, self.top_parents, self.inner


def _refined_between(parent: Int32, tops: Int32, bottoms: Int32) -> Int32:
    """Nodes on the paths from a member of ``tops``, included, to one of ``bottoms``, excluded."""
    levels = [bottoms[:0]]
    front = bottoms
    while len(front):
        above = np.unique(parent[front])
        levels.append(above[above >= 0])
        front = without(levels[-1], tops)
    nodes = np.unique(np.concatenate(levels))
    between = np.isin(nodes, tops, assume_unique=True)
    if not between.any():
        return nodes[:0]
    row_above = np.minimum(np.searchsorted(nodes, parent[nodes]), len(nodes) - 1)
    has_above = nodes[row_above] == parent[nodes]
    while True:
        grown = between | has_above & between[row_above]
        if np.array_equal(grown, between):
            return nodes[between]
        between = grown
