"""Nodes of an unfinished tree: everything about an interior one, but harmonics, in one cache line;
leaves stay where the scene has them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.lanes import prefetch
from gaussians.scene import Scene
from lod_cloud.lod_tree import Float32, Int32
from lod_cloud.moments import box, covariance_of, rounded_up, surface_of

COLUMNS = 16  # of a row: the mean, then from these on R and e, ...
SPHERE, QUATERNION, SCALES, OPACITY = 3, 5, 9, 12
_AHEAD = 16  # nodes that are on their way from memory

# The arrays of the finished tree that follow from this one's, and the shape of one node in them.
FINISHED: dict[str, tuple[int, ...]] = {
    "means": (3,),
    "quaternions": (4,),
    "scales": (3,),
    "opacities": (),
    "radius": (),
    "extent": (),
}


class Nodes(NamedTuple):
    """Node numbers: leaves come first, by their place in the order, children before their parents,
    the root last.
    """

    rows: Float32  # [leaves - 1, 16] interior nodes; see above
    ids: Int32  # [leaves] of the scene, from left to right
    scene: Scene

    @property
    def extent(self) -> Float32:
        """[leaves - 1] e of the interior nodes."""
        return self.rows[:, SPHERE + 1]

    def finish(
        self,
        begin: int,
        end: int,
        numbers: Int32,
        leaf_id: Int32,
        masses: NDArray[np.float64],
        out: tuple[Float32, ...],
    ) -> None:
        """Nodes begin..end of the finished tree, whose ``numbers`` [N] here are given: to the
        arrays ``out``, those of `FINISHED`, from their first row on.

        ``leaf_id`` [N] becomes the id of leaves and -1 elsewhere, ``masses`` [N] opacity times
        surface.
        """
        scene = self.scene
        leaves = scene.means, scene.quaternions, scene.scales, scene.opacities
        _finish(begin, end, numbers, self.rows, self.ids, leaves, leaf_id, masses, out)


@njit(cache=True, error_model="numpy", nogil=True)
def _finish(begin, end, numbers, rows, ids, leaves, leaf_id, masses, out):  # type: ignore[no-untyped-def]
    # arrays on their own: taken from a tuple again and again, they are counted every time
    means, quaternions, scales, opacities, radius, extent = out
    leaf_means, leaf_quaternions, leaf_scales, leaf_opacities = leaves
    for node in range(begin, end):
        ahead = np.int64(numbers[min(node + _AHEAD, end - 1)])
        if ahead < len(ids):
            ahead = np.int64(ids[ahead])
            prefetch(leaf_means, ahead * 3)
            prefetch(leaf_quaternions, ahead * 4)
            prefetch(leaf_scales, ahead * 3)
            prefetch(leaf_opacities, ahead)
        else:
            prefetch(rows, (ahead - len(ids)) * COLUMNS)
        number, place = numbers[node], node - begin
        if number < len(ids):
            leaf = leaf_id[node] = ids[number]
            for axis in range(3):
                means[place, axis] = leaf_means[leaf, axis]
                scales[place, axis] = leaf_scales[leaf, axis]
            for k in range(4):
                quaternions[place, k] = leaf_quaternions[leaf, k]
            opacities[place] = leaf_opacities[leaf]
        else:
            leaf_id[node] = -1
            row = number - len(ids)
            for axis in range(3):
                means[place, axis] = rows[row, axis]
                scales[place, axis] = rows[row, SCALES + axis]
            for k in range(4):
                quaternions[place, k] = rows[row, QUATERNION + k]
            opacities[place] = rows[row, OPACITY]
            radius[place], extent[place] = rows[row, SPHERE], rows[row, SPHERE + 1]
    for i in range(np.uint64(end - begin)):
        w, x = np.float64(quaternions[i, 0]), np.float64(quaternions[i, 1])
        y, z = np.float64(quaternions[i, 2]), np.float64(quaternions[i, 3])
        s0, s1, s2 = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
        masses[np.uint64(begin) + i] = np.float64(opacities[i]) * surface_of(s0, s1, s2)
        if leaf_id[np.uint64(begin) + i] >= 0:
            xx, _, _, yy, _, zz = covariance_of(w, x, y, z, s0, s1, s2)
            half, side = box(xx, yy, zz)
            radius[i], extent[i] = rounded_up(half), rounded_up(side)
