"""Where the children of a node are about: what both ends know of a tree's numbering.

Children are numbered in the order of their parents, so the number of a node's first child follows
from how many children all nodes before it have. Both ends know that at a few thousand nodes evenly
spaced and interpolate; a message carries only how far that is off (8 to 9 bits instead of 19 in
trees of 40 M nodes, with 4096 knots).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lod_cloud.columns import ColumnReader, ColumnWriter
from lod_cloud.lod_tree import Int32, LodTree
from lod_cloud.protocol import RemoteProtocolError

Int64 = NDArray[np.int64]

_KNOTS = 4096
_NODES_PER_KNOT = 64  # at least


@dataclass(frozen=True)
class ChildNumbers:
    """Knot i says where the children of the nodes from ``i nodes // knots`` on begin."""

    nodes: int
    knots: Int64  # [K + 1] ascending, the last one is ``nodes``

    @classmethod
    def of(cls, tree: LodTree) -> ChildNumbers:
        """Looks at a few thousand places of the tree."""
        count = max(1, min(_KNOTS, len(tree) // _NODES_PER_KNOT))
        places = np.arange(count + 1) * len(tree) // count
        return cls(
            len(tree), np.searchsorted(tree.parent, places.astype(np.int32)).astype(np.int64)
        )

    def first_children(self, nodes: Int32) -> Int64:
        """About where the children of these nodes begin."""
        return _interpolated(nodes.astype(np.int64), self._places, self.knots)

    def parents(self, children: Int32) -> Int64:
        """About whose children these are."""
        return _interpolated(children.astype(np.int64), self.knots, self._places)

    @property
    def _places(self) -> Int64:
        count = len(self.knots) - 1
        return np.arange(count + 1) * self.nodes // count

    def to_bytes(self) -> bytes:
        """For a session start."""
        writer = ColumnWriter()
        writer.varint(self.nodes)
        writer.varint(len(self.knots))
        writer.integers(np.diff(self.knots, prepend=0))
        return writer.bytes()

    @classmethod
    def read(cls, reader: ColumnReader) -> ChildNumbers:
        """Inverse of `to_bytes`. Raises RemoteProtocolError for anything it would not write."""
        nodes, count = reader.varint(), reader.varint()
        if not 2 <= count <= _KNOTS + 1 or not 1 <= nodes < 1 << 31:
            raise RemoteProtocolError(f"a tree must have 2 to {_KNOTS + 1} knots and some nodes")
        knots = np.cumsum(reader.integers(count))
        if knots[-1] != nodes:
            raise RemoteProtocolError(f"the last knot must be {nodes}, not {knots[-1]}")
        return cls(nodes, knots)


def _interpolated(values: Int64, x: Int64, y: Int64) -> Int64:
    """Whole numbers, so that both ends find the same; beyond the ends as at the ends."""
    place = np.clip(np.searchsorted(x, values, side="right") - 1, 0, len(x) - 2)
    low, width = x[place], np.maximum(x[place + 1] - x[place], 1)
    inside = np.clip(values - low, 0, width)
    return y[place] + inside * (y[place + 1] - y[place]) // width
