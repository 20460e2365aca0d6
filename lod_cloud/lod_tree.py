"""The level-of-detail tree: a structure of arrays in breadth-first order."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from gaussians.placement import Point
from gaussians.scene import Scene
from lod_cloud.search_arrays import SearchArrays

Int32 = NDArray[np.int32]
Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class TreeMetadata:
    """What travels with a tree but is not used by any search."""

    bounds: tuple[Point, Point]  # least and greatest coordinates of the leaves' means, metres
    up: Point = (0.0, -1.0, 0.0)  # unit vector; files usually have y pointing down
    units_per_metre: float = 1.0  # of the file the scene came from; the tree itself is in metres
    start: Point | None = None  # a sensible place to stand, if the scene has one
    path: tuple[Point, ...] = ()  # a walk through the scene, if it has one
    build: dict[str, Any] = field(default_factory=dict)  # rule and parameters of the builder


@dataclass(frozen=True)
class LodTree:
    """One Gaussian per node, any fan-out; node 0 is the root, siblings are contiguous.

    Node numbers are breadth-first: a level is a contiguous range, ``parent`` never decreases, a
    child has a greater number than its parent. Leaves carry the Gaussians of the input scene bit
    for bit, interior nodes their merge. Owns no camera, no cut.
    """

    parent: Int32  # [N], -1 for the root
    first_child: Int32  # [N], -1 for leaves
    child_count: Int32  # [N], 0 for leaves
    level_offsets: Int32  # [levels + 1]; level l is nodes level_offsets[l] .. level_offsets[l + 1]
    gaussians: Scene  # [N] Gaussians; the mean is the centre m of the node test
    radius: Float32  # [N] R of the node test, metres
    extent: Float32  # [N] e of the node test, metres
    leaf_id: Int32  # [N] id in the input scene, -1 for interior nodes
    metadata: TreeMetadata
    search_arrays: SearchArrays | None = None  # of a tree on disk: they follow from the others

    def __len__(self) -> int:
        return len(self.parent)

    @property
    def leaves(self) -> int:
        """Number of leaves = Gaussians of the input scene."""
        return len(self) - int(np.count_nonzero(self.child_count))

    @property
    def levels(self) -> int:
        """Number of levels; 1 for a tree that is one leaf."""
        return len(self.level_offsets) - 1

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics of every node."""
        return self.gaussians.sh_degree

    def leaf_nodes(self) -> Int32:
        """[leaves] the node that carries each Gaussian of the input scene."""
        nodes = np.flatnonzero(self.leaf_id >= 0).astype(np.int32)
        order = np.empty_like(nodes)
        order[self.leaf_id[nodes]] = nodes
        return order

    def validate(self, name: str = "tree") -> LodTree:
        """Return self, or raise InputError naming the first rule of this class that is broken."""
        count = len(self)
        self._check_arrays(name)
        self.gaussians.validate(f"{name} gaussians")
        nodes = np.arange(count)
        inner = self.child_count > 0
        first, number = self.first_child[inner], self.child_count[inner]
        rules = {
            "the parent of the root must be -1": self.parent[0] == -1,
            "a parent must have a smaller number than its child": bool(
                ((self.parent >= 0) & (self.parent < nodes))[1:].all()
            ),
            "first_child must be -1 exactly for leaves": bool(
                ((self.first_child == -1) == ~inner).all()
            ),
            "children must be numbered breadth-first, siblings together": bool(
                (self.child_count >= 0).all()
                and int(self.child_count.sum()) == count - 1
                and (first == 1 + np.concatenate([[0], np.cumsum(number)[:-1]])).all()
                and (np.repeat(nodes[inner], number) == self.parent[1:]).all()
            ),
            "leaf_id must number the leaves and be -1 elsewhere": bool(
                (self.leaf_id[inner] == -1).all()
                and (np.sort(self.leaf_id[~inner]) == np.arange(count - inner.sum())).all()
            ),
            "radius and extent must be finite and >= 0": bool(
                np.isfinite(self.radius).all()
                and np.isfinite(self.extent).all()
                and (self.radius >= 0).all()
                and (self.extent >= 0).all()
            ),
        }
        for rule, holds in rules.items():
            if not holds:
                raise InputError(f"{name}: {rule}")
        return self

    def _check_arrays(self, name: str) -> None:
        count = len(self)
        if count == 0 or len(self.gaussians) != count:
            raise InputError(f"{name}: needs one Gaussian per node and at least one node")
        for field_name, dtype in ARRAYS.items():
            array = getattr(self, field_name)
            if array.dtype != dtype or array.ndim != 1:
                raise InputError(f"{name}: {field_name} must be one-dimensional {np.dtype(dtype)}")
            if field_name != "level_offsets" and len(array) != count:
                raise InputError(
                    f"{name}: {field_name} must have {count} entries, not {len(array)}"
                )
        offsets = self.level_offsets
        if offsets[0] != 0 or offsets[-1] != count or (np.diff(offsets) <= 0).any():
            raise InputError(f"{name}: level_offsets must rise from 0 to {count}")


ARRAYS: dict[str, type[np.generic]] = {
    "parent": np.int32,
    "first_child": np.int32,
    "child_count": np.int32,
    "level_offsets": np.int32,
    "radius": np.float32,
    "extent": np.float32,
    "leaf_id": np.int32,
}
