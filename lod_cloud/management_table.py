"""Which Gaussians the client holds, and how: one table, kept alike by both sides.

Sec. 4.3. A node is held from the search that first selects it until its reuse window is over:
``frames_per_search * (i - last) > reuse_window_frames``, where i is the number of the current
search and ``last`` that of the last search that had the node in its cut. Windows are counted in
search numbers, which the messages carry, never in local time, so both sides evict the same nodes
at the same message.

A node is held *complete*, or *plain*: without its harmonics above degree 0, which may come later.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from lod_cloud.cut import without
from lod_cloud.lod_tree import Int32
from lod_cloud.search.marks import set_marks

IN_CUT = np.int32(2**31 - 1)  # stands for "last = the current search"
WINDOW_LIMIT = 250  # searches a node may outlive its last cut
_SLOTS = 253  # of ``last``, modulo; more than ever live at a time
_ABSENT, _CUT, _FIRST_SLOT = np.uint8(0), np.uint8(1), 2
_NOTHING = np.empty(0, np.int32)
_SLACK = 4096  # entries of the queue that are no longer true, before they are looked for

_PLAIN_BIT = np.uint64(1 << 31)  # beside a 31-bit ``last``

Codes = NDArray[np.uint8]


@dataclass(frozen=True)
class TableChange:
    """What one message changes. All ids ascending."""

    search_index: int
    entered: Int32  # in the cut after it
    left: Int32  # out of the cut after it, but held
    evicted: Int32  # no longer held
    needed: Int32  # of ``entered``: not held before, so their Gaussians must come along
    plain: Int32  # of ``entered``: plain after it, whatever they were before
    complete: Int32  # held after it, and complete, whatever they were before
    reactivated: int  # of ``entered``: held before, but not in the cut
    held: int  # nodes held after it
    plain_in_cut: int  # of them
    state_hash: int  # after it


class ManagementTable:
    """Nodes held by the client and when each was last in a cut. Does not know its side.

    A change is computed by `prepare`, which alters nothing, and made by `commit`: a message that
    is refused in between leaves no trace. Both cost what changes, not what is held. Owns no
    Gaussians.

    Memory: one byte and one bit per node of the tree and at most 8 B per node held.

    Raises InputError unless there is a node, w >= 1 and w_r* is 0 to 250 searches.
    """

    def __init__(self, nodes: int, frames_per_search: int, reuse_window_frames: int) -> None:
        if nodes < 1:
            raise InputError(f"a management table needs at least 1 node, not {nodes}")
        if frames_per_search < 1 or reuse_window_frames < 0:
            raise InputError(
                "frames per search must be >= 1 and the reuse window >= 0 frames, "
                f"not {frames_per_search} and {reuse_window_frames}"
            )
        self.window = reuse_window_frames // frames_per_search  # searches
        if self.window > WINDOW_LIMIT:
            raise InputError(
                f"the reuse window must be at most {WINDOW_LIMIT} searches, not {self.window}"
            )
        self.frames_per_search = frames_per_search  # w
        self.reuse_window_frames = reuse_window_frames  # w_r*
        self.search_index = -1  # of the newest change
        self.state_hash = 0  # 64 bits over all (id, last, plain), whatever the order of events
        self.plain_in_cut = 0  # nodes of the cut that are held plain
        self._codes: Codes = np.zeros(nodes, np.uint8)  # absent, in the cut, or slot of ``last``
        self._plain: Codes = np.zeros(-(-nodes // 64) * 8, np.uint8)  # a bit of every node
        self._held = 0
        self._queue: deque[tuple[int, Int32]] = deque()  # (last, nodes that left then), ascending
        self._queued = 0

    def emptied(self) -> ManagementTable:
        """A table of the same session that holds nothing."""
        return ManagementTable(self.nodes, self.frames_per_search, self.reuse_window_frames)

    def __len__(self) -> int:
        return self._held

    @property
    def nodes(self) -> int:
        """Nodes of the tree; ids are below it."""
        return len(self._codes)

    @property
    def state_bytes(self) -> int:
        """Memory of the table."""
        return self._codes.nbytes + self._plain.nbytes + 4 * self._queued

    @property
    def ids(self) -> Int32:
        """[held] all nodes held, ascending; looks at every node of the tree."""
        return np.flatnonzero(self._codes).astype(np.int32)

    @property
    def last(self) -> Int32:
        """[held] search that last had each of `ids` in its cut; IN_CUT while it is."""
        return self._last(self._codes[self.ids], self.search_index)

    @property
    def cut_ids(self) -> Int32:
        """The newest cut, ascending; looks at every node of the tree."""
        return np.flatnonzero(self._codes == _CUT).astype(np.int32)

    def holds(self, ids: Int32) -> NDArray[np.bool_]:
        """Whether each of ``ids`` is held."""
        return self._codes[ids] != _ABSENT

    def in_cut(self, ids: Int32) -> NDArray[np.bool_]:
        """Whether each of ``ids`` is in the newest cut."""
        return self._codes[ids] == _CUT

    def plain(self, ids: Int32) -> NDArray[np.bool_]:
        """Whether each of ``ids`` is held plain."""
        return (self._plain[ids >> 3] >> (ids & 7) & 1).astype(np.bool_)

    def waiting(self, removed: Int32) -> Int32:
        """Plain nodes of the cut but for those ``removed`` from it, ascending: what is to be
        completed first. Looks at a bit of every node.
        """
        words = np.flatnonzero(self._plain.view(np.uint64))
        marks = np.unpackbits(self._plain.reshape(-1, 8)[words], axis=1, bitorder="little")
        rows, bits = np.nonzero(marks)
        ids = (64 * words[rows] + bits).astype(np.int32)
        return without(ids[self.in_cut(ids)], removed)

    def prepare_step(
        self,
        search_index: int,
        added: Int32,
        removed: Int32,
        plain: Int32 = _NOTHING,
        complete: Int32 = _NOTHING,
    ) -> TableChange:
        """The change by a search whose cut gained ``added`` and lost ``removed`` (ascending ids).

        Raises InputError when the search is not a later one, an added node is in the cut already,
        or a removed one is not.
        """
        change = self.prepare(search_index, added, removed, removed[:0], plain, complete)
        if not self.in_cut(removed).all():
            raise InputError(f"search {search_index}: every removed node must be in the cut")
        if self.in_cut(added).any():
            raise InputError(f"search {search_index}: no added node may be in the cut already")
        return change

    def prepare(
        self,
        search_index: int,
        entered: Int32,
        left: Int32,
        dropped: Int32,
        plain: Int32 = _NOTHING,
        complete: Int32 = _NOTHING,
    ) -> TableChange:
        """The change to a state in which ``entered`` are in the cut, ``left`` held outside it as
        if they had left it just now, and ``dropped`` not held; whatever they were before. Of those
        that entered ``plain`` are held plain and ``complete``, which may name others held,
        complete; who is not named stays what it was, and is complete if it was not held.

        Raises InputError when the search is not a later one, a node is named twice or unknown, or
        a node of ``left``, or one to be completed, is not held.
        """
        if search_index <= self.search_index:
            raise InputError(f"search index must be above {self.search_index}, not {search_index}")
        named = np.concatenate([entered, left, dropped])
        self._check(search_index, named, left)
        apart = without(complete, named)
        if not self.holds(apart).all():
            raise InputError(f"search {search_index}: every node to be completed must be held")
        held = self.holds(entered)
        expired = [
            ids[self._codes[ids] == self._slot(last)]
            for last, ids in self._queue
            if search_index - last > self.window
        ]
        late = np.concatenate([*expired, dropped[:0]])
        late = late[~np.isin(late, named, assume_unique=True)]
        gone = dropped[self.holds(dropped)]
        kept = left if self.window >= 1 else left[:0]
        evicted = np.sort(np.concatenate([late, gone, left[len(kept) :]]))
        touched = np.concatenate([entered[held], left, late, gone, apart])
        bare = self.plain(touched)
        bare_after = self.plain(entered) & ~np.isin(entered, complete) | np.isin(entered, plain)
        state_hash = (
            self.state_hash
            ^ _hash(touched, self._last(self._codes[touched], self.search_index), bare)
            ^ _hash(entered, np.full(len(entered), IN_CUT), bare_after)
            ^ _hash(kept, np.full(len(kept), search_index - 1, np.int32), self.plain(kept))
            ^ _hash(apart, self._last(self._codes[apart], self.search_index), np.False_)
        )
        fewer = int(np.count_nonzero(bare & self.in_cut(touched)))
        return TableChange(
            search_index=search_index,
            entered=entered,
            left=kept,
            evicted=evicted,
            needed=entered[~held],
            plain=plain,
            complete=complete,
            reactivated=int(np.count_nonzero(held & ~self.in_cut(entered))),
            held=self._held + int(np.count_nonzero(~held)) - len(evicted),
            plain_in_cut=self.plain_in_cut - fewer + int(np.count_nonzero(bare_after)),
            state_hash=state_hash,
        )

    def commit(self, change: TableChange) -> None:
        """Make the newest prepared change."""
        last = change.search_index - 1
        self._codes[change.entered] = _CUT
        self._codes[change.left] = self._slot(last)
        self._codes[change.evicted] = _ABSENT
        for ids in (change.evicted, change.complete):
            set_marks(ids, self._plain, False)
        set_marks(change.plain, self._plain, True)
        self._held, self.plain_in_cut = change.held, change.plain_in_cut
        self.state_hash, self.search_index = change.state_hash, change.search_index
        while self._queue and change.search_index - self._queue[0][0] > self.window:
            self._queued -= len(self._queue.popleft()[1])
        if len(change.left):
            self._queue.append((last, change.left))
            self._queued += len(change.left)
        if self._queued > 2 * self._held + _SLACK:  # at most ``held`` of them are true
            self._forget()

    def _forget(self) -> None:
        """Take nodes out of the queue that have been in a cut since, or are gone."""
        for position, (last, ids) in enumerate(self._queue):
            self._queue[position] = last, ids[self._codes[ids] == self._slot(last)]
        self._queued = sum(len(ids) for _, ids in self._queue)

    def _check(self, search_index: int, named: Int32, left: Int32) -> None:
        ordered = np.sort(named)
        if len(named) and not (ordered[0] >= 0 and ordered[-1] < self.nodes):
            raise InputError(f"search {search_index}: node ids must be 0 to {self.nodes - 1}")
        if (ordered[1:] == ordered[:-1]).any():
            raise InputError(f"search {search_index}: every node may be named only once")
        if not self.holds(left).all():
            raise InputError(f"search {search_index}: every removed node must be in the cut")

    def _slot(self, last: int) -> int:
        return _FIRST_SLOT + last % _SLOTS

    def _last(self, codes: Codes, newest: int) -> Int32:
        """``last`` of nodes held, by their codes; ``newest`` is the search index of the table."""
        age = (newest - (codes.astype(np.int32) - _FIRST_SLOT)) % _SLOTS
        return np.where(codes == _CUT, IN_CUT, newest - age).astype(np.int32)


def _hash(ids: Int32, last: Int32, plain: NDArray[np.bool_] | np.bool_) -> int:
    """Exclusive or of a 64-bit mix (splitmix64) of every (id, last, plain)."""
    x = (ids.astype(np.uint64) << np.uint64(32)) | last.astype(np.uint32).astype(np.uint64)
    x |= np.where(plain, _PLAIN_BIT, np.uint64(0))
    x += np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return int(np.bitwise_xor.reduce(x ^ (x >> np.uint64(31)), initial=np.uint64(0)))
