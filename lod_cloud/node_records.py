"""Some nodes of a tree with all a client must know of them, decoded or not yet coded."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.scene import FIELDS, Scene, concatenate
from lod_cloud.columns import ColumnReader, ColumnWriter
from lod_cloud.lod_tree import Float32, Int32, LodTree
from lod_cloud.protocol import RemoteProtocolError

_LARGEST = 2**31 - 1


@dataclass(frozen=True)
class NodeRecords:
    """What a client must know of some nodes: Gaussian, node sphere, place in the tree."""

    ids: Int32  # [N] ascending; in a payload of a step as they travel
    parents: Int32  # [N], -1 for the root
    child_counts: Int32  # [N], 0 for leaves
    radius: Float32  # [N], 0 for leaves
    extent: Float32  # [N], 0 for leaves
    gaussians: Scene  # [N]

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def of(cls, tree: LodTree, ids: Int32) -> NodeRecords:
        """The nodes ``ids`` of a tree."""
        counts = tree.child_count[ids]
        inner = (counts > 0).astype(np.float32)
        radius, extent = tree.radius[ids] * inner, tree.extent[ids] * inner
        return cls(ids, tree.parent[ids], counts, radius, extent, tree.gaussians.take(ids))

    def take(self, rows: NDArray[np.integer]) -> NodeRecords:
        """These rows."""
        return NodeRecords(
            self.ids[rows],
            self.parents[rows],
            self.child_counts[rows],
            self.radius[rows],
            self.extent[rows],
            self.gaussians.take(rows),
        )

    def joined(self, others: NodeRecords) -> NodeRecords:
        """Both, in the order of their ids."""
        order = np.argsort(np.concatenate([self.ids, others.ids]))

        def both(name: str) -> NDArray[Any]:
            return np.asarray(np.concatenate([getattr(self, name), getattr(others, name)])[order])

        return NodeRecords(
            both("ids"),
            both("parents"),
            both("child_counts"),
            both("radius"),
            both("extent"),
            concatenate([self.gaussians, others.gaussians]).take(order),
        )

    def write_places(self, writer: ColumnWriter, *, places: bool) -> None:
        """How many nodes, and with ``places`` which, and their parents."""
        writer.begin("counts")
        writer.varint(len(self))
        if places:
            writer.begin("places")
            writer.ascending(self.ids)
            writer.integers(np.diff(self.parents.astype(np.int64), prepend=-1))

    def check(self) -> NodeRecords:
        """Return self, or raise RemoteProtocolError unless ids and parents are those of a tree."""
        ids, parents = self.ids.astype(np.int64), self.parents.astype(np.int64)
        if (ids < 0).any() or (np.diff(ids) <= 0).any() or (np.diff(parents) < 0).any():
            raise RemoteProtocolError("node ids must be >= 0 and ascend, their parents not descend")
        if (parents < -1).any() or (parents >= ids).any():
            raise RemoteProtocolError("a parent must have a smaller id than its child")
        return self

    def float32_rows(self, rows: NDArray[np.integer], coefficients: int | None = None) -> Float32:
        """[rows, `row_width`] everything but the place in the tree, exact; of the harmonics only
        so many coefficients, if that is said.
        """
        gaussians = self.gaussians.take(rows)
        spheres = np.stack([self.radius[rows], self.extent[rows]], axis=1)
        parts = [_flat(getattr(gaussians, f)) for f in FIELDS[:-1]]
        return np.hstack([spheres, *parts, _flat(gaussians.sh[:, :coefficients])])


def read_places(reader: ColumnReader, places: tuple[Int32, Int32] | None) -> tuple[Int32, Int32]:
    """Ids and parents of the nodes in a payload; ``places`` if they are known."""
    count = reader.varint()
    reader.expect(count)  # at least a byte per node
    if places is None:
        ids = reader.ascending(count)
        parents = np.cumsum(reader.integers(count)) - 1
        if count and max(ids[-1], parents[-1]) > _LARGEST:
            raise RemoteProtocolError(f"node ids must be at most {_LARGEST}")
        if (parents >= ids).any():
            raise RemoteProtocolError("a parent must have a smaller id than its child")
        return ids.astype(np.int32), parents.astype(np.int32)
    if len(places[0]) != count:
        raise RemoteProtocolError(f"payload must have {len(places[0])} nodes, not {count}")
    return places


def read_child_counts(reader: ColumnReader, count: int) -> Int32:
    """[count] numbers of children."""
    counts = reader.integers(count)
    if (counts > _LARGEST).any():
        raise RemoteProtocolError(f"a node must have at most {_LARGEST} children")
    return counts.astype(np.int32)


def row_width(sh_degree: int) -> int:
    """Numbers in a row of `float32_rows`: R, e, mean, rotation, scales, opacity, harmonics."""
    return 2 + 11 + 3 * (sh_degree + 1) ** 2


def with_rows(
    structure: tuple[Int32, Int32, Int32],
    spheres: Float32,
    gaussians: Scene,
    rows: NDArray[np.integer],
    values: Float32,
) -> NodeRecords:
    """Records with ``values`` [rows, width] at ``rows`` and the others, in order, from the rest.

    ``structure`` is ids, parents, child counts of all nodes; ``spheres`` [others, 2] and
    ``gaussians`` [others] belong to the nodes not in ``rows``.
    """
    others = np.ones(len(structure[0]), np.bool_)
    others[rows] = False
    table = np.empty((len(others), values.shape[1]), np.float32)
    table[others] = np.hstack([spheres, *(_flat(getattr(gaussians, f)) for f in FIELDS)])
    table[rows] = values
    parts = (table[:, 2:5], table[:, 5:9], table[:, 9:12], table[:, 12], table[:, 13:])
    arrays = [np.ascontiguousarray(p) for p in parts]
    arrays[4] = arrays[4].reshape(len(table), (values.shape[1] - 13) // 3, 3)
    spheres = np.ascontiguousarray(table[:, :2].T)
    return NodeRecords(*structure, spheres[0], spheres[1], Scene(*arrays))


def _flat(array: NDArray[Any]) -> NDArray[Any]:
    """[N, everything else]; also for N = 0."""
    return array.reshape(len(array), math.prod(array.shape[1:]))
