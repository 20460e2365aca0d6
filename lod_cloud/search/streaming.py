"""The paper's full search (Sec. 4.2): blocks of nodes streamed level by level, no history."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numba import njit

from gaussians.parallel import run_chunks
from lod_cloud.criterion import SearchRequest
from lod_cloud.lod_tree import Int32
from lod_cloud.search.flat import BYTES_PER_TEST
from lod_cloud.search.interface import FullSearch
from lod_cloud.search.marks import BLOCK, is_set, test_block
from lod_cloud.search.prefetching import prefetch
from lod_cloud.search.search_tree import Marks

_LINE = 16  # numbers of 4 bytes in a cache line
_AHEAD = 3  # blocks asked for in advance
_FEW = 256  # blocks not worth dividing among threads
_ROOT_BLOCK = np.zeros(1, np.int32)


class StreamingSearch(FullSearch):
    """Top-down, level by level, in fixed blocks of 64 nodes.

    A block is tested when it may hold a child of a refined node: it lies between the first child
    of the first and the last child of the last refined node of a block above. Blocks of a level
    are independent of each other.
    """

    name: ClassVar[str] = "streaming"

    def _mark(self, request: SearchRequest, before: Marks, marks: Marks) -> tuple[int, int]:
        tree = self.tree
        if self.grow > 1:
            marks[:] = before  # the test looks at them; what is not tested is cleared below
        else:
            marks[:] = 0
        cx, cy, cz = request.camera
        blocks = _ROOT_BLOCK
        done = []
        for level in range(tree.level_offsets.shape[0] - 1):
            low, high = tree.level_offsets[level : level + 2]
            done.append(blocks)
            given = (
                blocks,
                low,
                high,
                cx,
                cy,
                cz,
                request.factor,
                self.grow,
                tree.first_child,
                tree.child_count,
                tree.positions,
                tree.radius,
                tree.extent,
                marks,
            )
            if len(blocks) < _FEW:
                below = [_test_blocks(0, len(blocks), *given)]
            else:
                below = run_chunks(_test_blocks, len(blocks), *given)
            blocks = _without_repeats(np.concatenate(below))
            if not len(blocks):
                break
        if self.grow > 1:
            _clear_others(np.unique(np.concatenate(done)), marks)
        tested = BLOCK * sum(len(d) for d in done)
        return tested, (BYTES_PER_TEST + 4) * tested


def _without_repeats(blocks: Int32) -> Int32:
    """An ascending list, where the chunks of the search above met, with each block once."""
    if len(blocks) < 2:
        return blocks
    return blocks[np.concatenate([[True], blocks[1:] != blocks[:-1]])]


def _clear_others(blocks: Int32, marks: Marks) -> None:
    """Clear the marks of all blocks that are not in the list."""
    words = marks.view(np.uint64)
    kept = words[blocks]
    words[:] = 0
    words[blocks] = kept


@njit
def _ask_for(block, first_child, child_count, positions, radius, extent):  # type: ignore[no-untyped-def]
    """Ask for all cache lines of a block: the next one is rarely the one behind."""
    low = BLOCK * block
    for node in range(low, min(low + BLOCK, len(radius)), _LINE):
        prefetch(radius, node)
        prefetch(extent, node)
        prefetch(child_count, node)
        prefetch(first_child, node)
        for line in range(3):
            prefetch(positions, 3 * node + line * _LINE)


@njit(cache=True, error_model="numpy", nogil=True)
def _test_blocks(  # type: ignore[no-untyped-def]
    begin, end, blocks, low, high, cx, cy, cz, k, grow,
    first_child, child_count, positions, radius, extent, marks,
):  # fmt: skip
    """Test blocks of one level, nodes low..high; return the blocks of the next one to test."""
    flags = np.empty(BLOCK, np.uint8)
    below = np.empty(64, np.int32)
    found = 0
    last = -1
    for i in range(begin, end):
        if i + _AHEAD < end:
            _ask_for(blocks[i + _AHEAD], first_child, child_count, positions, radius, extent)
        block = blocks[i]
        test_block(block, cx, cy, cz, k, grow, child_count, positions, radius, extent, marks, flags)
        first = max(low, BLOCK * block)
        final = min(high, BLOCK * (block + 1)) - 1
        while first <= final and marks[first >> 3] >> (first & 7) == 0:
            first = (first | 7) + 1  # nothing in the rest of this byte
        while final >= first and marks[final >> 3] & ((2 << (final & 7)) - 1) == 0:
            final = (final & ~7) - 1
        while first <= final and not is_set(marks, first):
            first += 1
        while final >= first and not is_set(marks, final):
            final -= 1
        if first > final:
            continue
        above = max(last + 1, first_child[first] // BLOCK)
        last = (first_child[final] + child_count[final] - 1) // BLOCK
        if found + last - above >= len(below):
            larger = np.empty(2 * len(below) + last - above, np.int32)
            larger[:found] = below[:found]
            below = larger
        for child_block in range(above, last + 1):
            below[found] = child_block
            found += 1
    return below[:found].copy()
