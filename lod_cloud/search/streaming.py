"""The paper's full search (Sec. 4.2): groups of nodes streamed from the top down, no history."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numba import njit

from gaussians.lanes import highest_bit, lowest_bit, prefetch
from gaussians.parallel import run_chunks
from lod_cloud.criterion import SearchRequest
from lod_cloud.lod_tree import Int32
from lod_cloud.search.flat import BYTES_PER_TEST
from lod_cloud.search.interface import FullSearch
from lod_cloud.search.marks import test_group
from lod_cloud.search.search_tree import Marks
from lod_cloud.search_arrays import GROUP, GROUP_NUMBERS, GROUP_ROWS

_AHEAD = 16  # groups asked for in advance
_ENOUGH = 2048  # groups waiting, when they are divided ...
_PARCELS = 64  # ... into so many parcels: results must not depend on how many threads there are
_ALL = 2**62
_TOPMOST = np.zeros(1, np.int32)


class StreamingSearch(FullSearch):
    """Top-down in fixed groups of 16 nodes, in breadth-first order.

    A group is tested when it may hold a child of a refined node: it lies between the first child
    of the first and the last child of the last refined node of a group above. Children of nodes
    in order are in order, so the groups to test are a queue that sorts itself. Once it is long
    enough it is divided, and threads follow a parcel each, all the way down.
    """

    name: ClassVar[str] = "streaming"

    def _mark(self, request: SearchRequest, before: Marks, marks: Marks) -> tuple[int, int]:
        tree = self.tree
        marks[:] = 0
        cx, cy, cz = request.camera
        given = (
            cx,
            cy,
            cz,
            request.factor,
            self.grow,
            tree.groups,
            tree.first_child,
            tree.child_count,
            before.view(np.uint16),
            marks.view(np.uint16),
        )
        done, waiting, last = _descend(_TOPMOST, 0, _ENOUGH, *given)
        parcels = np.array_split(waiting, _PARCELS) if len(waiting) else []
        tested = GROUP * (done + sum(run_chunks(_follow, len(parcels), parcels, last, *given)))
        return tested, BYTES_PER_TEST * tested + 8 * tested // GROUP


def _follow(begin: int, end: int, parcels: list[Int32], last: int, *given: Any) -> int:
    """Groups tested below some parcels, those in them included."""
    return sum(int(_descend(parcel, last, _ALL, *given)[0]) for parcel in parcels[begin:end])


@njit(cache=True, error_model="numpy", nogil=True)
def _descend(  # type: ignore[no-untyped-def]
    groups_first, last, most, cx, cy, cz, k, grow, groups, first_child, child_count, before, marks
):
    """Test groups and those below them, until none or more than ``most`` are waiting.

    ``last`` is the last group that was ever queued: what comes is behind it, or queued already.
    Returns the number of groups tested, those that wait, and the new ``last``. Another thread may
    test the same group, and finds the same.
    """
    # room for all groups, of which memory is taken by what is written: an array that is replaced
    # by a longer one has its references counted in every turn of the loop
    queue = np.empty(len(groups_first) + len(groups), np.int32)
    queue[: len(groups_first)] = groups_first
    head, tail = 0, len(groups_first)
    while head < tail and tail - head <= most:
        if head + _AHEAD < tail:
            later = np.intp(queue[head + _AHEAD])
            for row in range(GROUP_ROWS):
                prefetch(groups, later * GROUP_NUMBERS + row * GROUP)
            prefetch(first_child, later * GROUP)
            prefetch(child_count, later * GROUP)
        group = np.intp(queue[head])
        head += 1
        now = test_group(group, cx, cy, cz, k, grow, groups, before)
        if now == 0:
            continue
        marks[group] = now
        first = group * GROUP + lowest_bit(now)
        final = group * GROUP + highest_bit(now)
        begin = max(last + 1, first_child[first] // GROUP)
        last = max(last, (first_child[final] + child_count[final] - 1) // GROUP)
        for below in range(begin, last + 1):
            queue[tail] = below
            tail += 1
    return head, queue[head:tail], last
