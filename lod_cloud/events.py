"""Changes of a cut as events: a node gave way to its children, or took their place.

An event names both what leaves the cut and what enters it with one number, so a message carries
events instead of nodes. The cloud derives them from the tree. The client turns them back into nodes
with what it was told: it knows the number of children of every node it holds, and children have
consecutive numbers, the first of which the event carries, as its difference to what both ends
guess (`lod_cloud.child_numbers`), and of nodes close to each other as the difference of these. A
node that takes the place of its
children is their merge, unless the event says that it is sent.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lod_cloud.child_numbers import ChildNumbers
from lod_cloud.columns import ColumnReader, ColumnWriter
from lod_cloud.cut import without
from lod_cloud.lod_tree import Int32, LodTree
from lod_cloud.protocol import RemoteProtocolError

_LARGEST = 2**31 - 1
_NEAR = 256  # of 8 to 1024: the fewest bytes in first pictures, and hardly more than any on walks


@dataclass(frozen=True)
class Events:
    """The change from one cut to the next, for a client that holds the first. Ids ascending."""

    expanded: Int32  # [E] refined now, not before
    first_children: Int32  # [E]
    fan_outs: Int32  # number of children of those of ``expanded`` that were not in the cut before
    tops: Int32  # refined before, now in the cut
    top_parents: Int32  # [T], -1 for the root
    inner: Int32  # refined before, now below one of ``tops``
    inner_parents: Int32  # [I] among ``tops`` and ``inner``
    unmerged: Int32  # of those of ``tops`` that the client does not hold: sent all the same

    @classmethod
    def of(cls, tree: LodTree, expanded: Int32, collapsed: Int32) -> Events:
        """The events by which ``expanded`` become refined and ``collapsed`` stop being so, both
        ascending; all nodes are merged that can be.
        """
        fresh = _among(expanded, tree.parent[expanded])
        tops = collapsed[~_among(collapsed, tree.parent[collapsed])]
        inner = without(collapsed, tops)
        return cls(
            expanded=expanded,
            first_children=tree.first_child[expanded],
            fan_outs=tree.child_count[expanded[fresh]],
            tops=tops,
            top_parents=tree.parent[tops],
            inner=inner,
            inner_parents=tree.parent[inner],
            unmerged=inner[:0],
        )

    @classmethod
    def start(cls, tree: LodTree, expanded: Int32) -> Events:
        """The events that lead from nothing held to a cut: the root is new too."""
        nothing = expanded[:0]
        events = cls.of(tree, expanded, nothing)
        return dataclasses.replace(events, fan_outs=tree.child_count[expanded])

    def to_bytes(self, numbers: ChildNumbers) -> bytes:
        """The columns, with their lengths."""
        writer = ColumnWriter()
        for column in (self.expanded, self.fan_outs, self.tops, self.inner, self.unmerged):
            writer.varint(len(column))
        writer.ascending(self.expanded)
        off, near = (
            self.first_children - numbers.first_children(self.expanded),
            _near(self.expanded),
        )
        writer.signed(off[~near])
        writer.signed(np.diff(off, prepend=0)[near])
        writer.integers(self.fan_outs)
        writer.ascending(self.tops)
        writer.signed(self.top_parents - numbers.parents(self.tops))
        writer.ascending(self.inner)
        collapsed = np.union1d(self.tops, self.inner)
        writer.integers(np.diff(np.searchsorted(collapsed, self.inner_parents), prepend=0))
        writer.ascending(np.searchsorted(self.tops, self.unmerged))
        return writer.bytes()

    @classmethod
    def read(cls, reader: ColumnReader, numbers: ChildNumbers) -> Events:
        """Inverse of `to_bytes`. Raises RemoteProtocolError for anything it would not write."""
        sizes = [reader.varint() for _ in range(5)]
        expanded = _ids(reader.ascending(sizes[0]))
        near = _near(expanded)
        steps = np.empty(sizes[0], np.int64)
        steps[~near] = reader.signed(int(np.count_nonzero(~near)))
        steps[near] = reader.signed(int(np.count_nonzero(near)))
        begins = _ids(_running(steps, ~near) + numbers.first_children(expanded))
        fan_outs = _ids(reader.integers(sizes[1]))
        tops = _ids(reader.ascending(sizes[2]))
        inner, unmerged = sizes[3:]
        events = cls(
            expanded=expanded,
            first_children=begins,
            fan_outs=fan_outs,
            tops=tops,
            top_parents=_ids(reader.signed(len(tops)) + numbers.parents(tops)),
            inner=_ids(reader.ascending(inner)),
            inner_parents=_ids(np.cumsum(reader.integers(inner))),
            unmerged=_ids(reader.ascending(unmerged)),
        )
        if (np.diff(begins) <= 0).any():
            raise RemoteProtocolError("first children must ascend")
        if (events.fan_outs < 1).any():
            raise RemoteProtocolError("an expanded node must have at least one child")
        collapsed = np.union1d(events.tops, events.inner)
        return dataclasses.replace(
            events,
            inner_parents=_picked(collapsed, events.inner_parents),
            unmerged=_picked(events.tops, events.unmerged),
        )


def read_ids(reader: ColumnReader) -> Int32:
    """Ascending ids and their number."""
    return _ids(reader.ascending(reader.varint()))


def _near(expanded: Int32) -> NDArray[np.bool_]:
    """Which nodes are so near to the one before that what is guessed of that one's children is off
    by about as much: fewer than `_NEAR` nodes' children lie between.
    """
    gaps = np.diff(expanded, prepend=expanded[:1] - _NEAR)
    return np.asarray(gaps < _NEAR)


def _running(steps: NDArray[np.int64], begins: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Sums of ``steps`` from the last one on that ``begins`` (the first one does)."""
    sums = np.cumsum(steps)
    before = (sums - steps)[begins]
    return sums - before[np.cumsum(begins) - 1]


def _ids(numbers: NDArray[np.int64]) -> Int32:
    if len(numbers) and not -1 <= numbers.min() <= numbers.max() <= _LARGEST:
        raise RemoteProtocolError(f"numbers of events must lie in -1..{_LARGEST}")
    return numbers.astype(np.int32)


def _picked(ids: Int32, rows: Int32) -> Int32:
    if len(rows) and rows.max() >= len(ids):
        raise RemoteProtocolError("an event must name one of the nodes that are collapsed")
    return ids[rows]


def _among(ids: Int32, values: Int32) -> NDArray[np.bool_]:
    """Which of ``values`` are members of ``ids`` (ascending)."""
    if not len(ids):
        return np.zeros(len(values), np.bool_)
    places = np.minimum(np.searchsorted(ids, values), len(ids) - 1)
    return np.asarray(ids[places] == values)
