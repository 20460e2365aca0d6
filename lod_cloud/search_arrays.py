"""What searches read of a tree, in the order they read it: derived from the tree, kept beside it.

*Groups* serve the searches that look at whole stretches of nodes: 16 consecutive nodes stand side
by side, number by number, as vector registers load them. *Records* serve those that visit nodes in
no particular order: all about a node in half a cache line.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

GROUP = 16  # nodes
GROUP_ROWS = 5  # x, y, z, R, e
GROUP_NUMBERS = GROUP * GROUP_ROWS
FIRST_CHILD, CHILD_COUNT, PARENT = 5, 6, 7  # columns of a record after x, y, z, R, e
RECORD_COLUMNS = 8
LINE_BYTES = 64

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]


class SearchArrays(NamedTuple):
    """Both arrays of a tree of N nodes. R is NaN for leaves and beyond the last node: no node test
    holds there.
    """

    groups: Float32  # [ceil(N / 16), 5, 16] x, y, z, R, e
    records: Float32  # [N, 8] x, y, z, R, e, and as int32 first child, child count, parent


def aligned(*shape: int) -> Float32:
    """An array that begins with a cache line; content undefined."""
    size = 4 * int(np.prod(shape))
    store = np.empty(size + LINE_BYTES, np.uint8)
    shift = -store.ctypes.data % LINE_BYTES
    return store[shift : shift + size].view(np.float32).reshape(shape)


def number_of_groups(nodes: int) -> int:
    """Groups of a tree; the last one may not be full."""
    return -(-nodes // GROUP)


def put_groups(
    out: Float32, means: Float32, radius: Float32, extent: Float32, child_count: Int32
) -> None:
    """Fill groups [G, 5, 16] from up to 16 G nodes; places without a node get NaN."""
    rows = np.full((len(out) * GROUP, GROUP_ROWS), np.nan, np.float32)
    _put_node_test(rows[: len(means)], means, radius, extent, child_count)
    out[...] = rows.reshape(-1, GROUP, GROUP_ROWS).transpose(0, 2, 1)


def put_records(
    out: Float32,
    means: Float32,
    radius: Float32,
    extent: Float32,
    child_count: Int32,
    first_child: Int32,
    parent: Int32,
) -> None:
    """Fill records [n, 8] from as many nodes."""
    _put_node_test(out[:, :GROUP_ROWS], means, radius, extent, child_count)
    numbers = out.view(np.int32)
    numbers[:, FIRST_CHILD] = first_child
    numbers[:, CHILD_COUNT] = child_count
    numbers[:, PARENT] = parent


def _put_node_test(
    out: Float32, means: Float32, radius: Float32, extent: Float32, child_count: Int32
) -> None:
    out[:, :3] = means
    out[:, 3] = np.where(child_count > 0, radius, np.float32(np.nan))
    out[:, 4] = extent
