"""When a node of the LoD tree is small enough to be drawn: the one definition of the node test.

A node is a sphere (its Gaussian's mean m, radius R) and an extent e, both over everything below
it. It is refined when the camera is nearer than ``T = R + k e``, with ``k = f / (2 (tau +
0.5))``: outside that distance e projects to less than ``2 (tau + 0.5)`` px (the size rule of
HierGS, doi:10.1145/3658160, in nested form; Sec. 4.2 searches for the cut it defines). R and e of
a node exceed those of its children by a margin (see `lod_cloud.build`), so that a node that is
not refined has no refined descendant, in float32 arithmetic too. `prove_nesting` checks exactly
that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gaussians.errors import InputError
from gaussians.parallel import run_chunks

if TYPE_CHECKING:
    from lod_cloud.lod_tree import LodTree

LENGTH_LIMIT_M = 1e12  # squares of distances and of T stay finite in float32 below this
FOCAL_LIMIT_PX = 1e6
PROOF_TAUS_PX = (0.0, 3.0, 6.0, 15.0, 60.0)
PROOF_FOCAL_PX = 929.2  # the `prototype` display
# The camera stands this far from the child's centre, in units of the child's T: just inside.
PROOF_SHELLS = tuple(1.0 - n * 2.0**-24 for n in (-1, 0, 1, 2, 4, 16))


@dataclass(frozen=True)
class SearchRequest:
    """What a LoD search needs to know about the viewer. Sent to the cloud as it is.

    ``position`` is the point midway between the eyes, world metres; it is rounded to float32
    here, once, so that both ends test the same bits. ``focal_px`` is the focal length, ``tau_px``
    the tolerated size; 0 means the finest the size rule allows. Raises InputError for anything
    not finite.
    """

    position: tuple[float, float, float]
    focal_px: float
    tau_px: float

    def __post_init__(self) -> None:
        values = tuple(float(v) for v in self.position)
        if len(values) != 3 or not all(abs(v) <= LENGTH_LIMIT_M for v in values):
            raise InputError(
                f"search position must be three numbers within {LENGTH_LIMIT_M:g} m, not {values}"
            )
        object.__setattr__(self, "position", tuple(float(np.float32(v)) for v in values))
        if not 0 < self.focal_px <= FOCAL_LIMIT_PX:
            raise InputError(
                f"search focal length must lie in 0..{FOCAL_LIMIT_PX:g} px, not {self.focal_px}"
            )
        if not (math.isfinite(self.tau_px) and self.tau_px >= 0):
            raise InputError(
                f"search tau must be a finite number of pixels >= 0, not {self.tau_px}"
            )

    @property
    def factor(self) -> np.float32:
        """k = f / (2 (tau + 0.5)), computed in float64, rounded once."""
        return np.float32(self.focal_px / (2.0 * (self.tau_px + 0.5)))

    @property
    def camera(self) -> NDArray[np.float32]:
        """[3] float32 position."""
        return np.array(self.position, np.float32)


@njit(forceinline=True)
def refines(cx, cy, cz, mx, my, mz, radius, extent, k):  # type: ignore[no-untyped-def]
    """The node test, float32 throughout, in this order, without fused multiply-add.

    Camera c, node centre m, R, e, k. Leaves are never refined: the caller looks at the child count.
    """
    threshold = radius + k * extent
    dx = cx - mx
    dy = cy - my
    dz = cz - mz
    return (dx * dx + dy * dy) + dz * dz < threshold * threshold


def prove_nesting(tree: LodTree, focal_px: float = PROOF_FOCAL_PX) -> int:
    """Number of cameras found at which a node is refined although its parent is not; 0 is expected.

    For every edge between two interior nodes, at every tau of ``PROOF_TAUS_PX``, cameras stand on
    the child's sphere of radius T: at the point farthest from the parent (where the distances add
    up exactly), on shells a few float32 steps apart, and on the three axes to that side.
    """
    factors = [SearchRequest((0, 0, 0), focal_px, tau).factor for tau in PROOF_TAUS_PX]
    along = [(1.0, 0.0, 0.0, 0.0, shell) for shell in PROOF_SHELLS]
    axes = [(0.0, *axis, 1.0) for axis in np.eye(3)]
    cameras = np.tile(along + axes, (len(factors), 1)).T.copy()
    ks = np.repeat(np.array(factors, np.float32), len(along) + len(axes))
    means, radius, extent = tree.gaussians.means, tree.radius, tree.extent
    return sum(
        run_chunks(
            _count_violations,
            len(tree),
            tree.parent,
            tree.child_count,
            means,
            radius,
            extent,
            ks,
            cameras,
        )
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _count_violations(begin, end, parent, child_count, means, radius, extent, ks, cameras):  # type: ignore[no-untyped-def]
    """Cameras [5, C]: share of the way along parent to child, and along the axes; shell."""
    count = 0
    for node in range(max(begin, 1), end):
        if child_count[node] == 0:
            continue
        above = parent[node]
        mx, my, mz = means[node, 0], means[node, 1], means[node, 2]
        px, py, pz = means[above, 0], means[above, 1], means[above, 2]
        r, e, pr, pe = radius[node], extent[node], radius[above], extent[above]
        ax = np.float64(mx) - np.float64(px)
        ay = np.float64(my) - np.float64(py)
        az = np.float64(mz) - np.float64(pz)
        sx, sy, sz = (-1.0 if ax < 0 else 1.0), (-1.0 if ay < 0 else 1.0), (-1.0 if az < 0 else 1.0)
        length = math.sqrt(ax * ax + ay * ay + az * az)
        if length > 0.0:
            ax, ay, az = ax / length, ay / length, az / length
        else:
            ax = 1.0  # any direction
        for i in range(np.uint64(len(ks))):  # without a branch, and so in vector instructions
            k = ks[i]
            away = np.float64(r + k * e) * cameras[4, i]
            x = np.float32(mx + (cameras[0, i] * ax + cameras[1, i] * sx) * away)
            y = np.float32(my + (cameras[0, i] * ay + cameras[2, i] * sy) * away)
            z = np.float32(mz + (cameras[0, i] * az + cameras[3, i] * sz) * away)
            inside = refines(x, y, z, mx, my, mz, r, e, k)
            count += np.int64(inside) & ~np.int64(refines(x, y, z, px, py, pz, pr, pe, k))
    return count
