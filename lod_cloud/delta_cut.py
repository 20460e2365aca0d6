"""Which Gaussians the client holds: one table, kept alike by both sides, and the Δcut that moves
it on.

Sec. 4.3. A node is held from the search that first selects it until its reuse window is over:
``frames_per_search * (i - last) > reuse_window_frames``, where i is the number of the current
search and ``last`` that of the last search that had the node in its cut. Windows are counted in
search numbers, which the messages carry, never in local time, so both sides evict the same nodes
at the same message.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from lod_cloud.columns import ColumnReader, ColumnWriter
from lod_cloud.lod_tree import Int32
from lod_cloud.protocol import RemoteProtocolError

IN_CUT = np.int32(2**31 - 1)  # stands for "last = the current search"


@dataclass(frozen=True)
class TableChange:
    """What one search changed. All ids ascending."""

    needed: Int32  # in the cut now, not held before: need a payload
    reactivated: Int32  # in the cut again, still held: no payload
    evicted: Int32  # no longer held
    kept: NDArray[np.bool_]  # [held before] rows of the table that stay
    positions: NDArray[np.intp]  # where ``needed`` goes in between the kept rows

    def splice(self, rows: NDArray[Any], fresh: NDArray[Any]) -> NDArray[Any]:
        """``rows`` [held before] of an array in the table's order, carried over to the new order.

        ``fresh`` [needed] are the rows of the nodes that are new.
        """
        left = rows if self.kept.all() else rows[self.kept]
        return np.insert(left, self.positions, fresh, axis=0) if len(fresh) else left


@dataclass(frozen=True)
class ManagementTable:
    """Nodes held by the client and when each was last in a cut. Does not know its side.

    A value: `updated` returns another table, so a refused message leaves no trace. Owns no
    Gaussians.
    """

    frames_per_search: int  # w
    reuse_window_frames: int  # w_r*
    ids: Int32  # [held] ascending
    last: Int32  # [held] search that last had the node in its cut; IN_CUT while it is
    search_index: int  # of the newest search applied, -1 before the first
    state_hash: int  # 64 bits over all (id, last), whatever the order of events

    @classmethod
    def empty(cls, frames_per_search: int, reuse_window_frames: int) -> ManagementTable:
        """The table at the start of a session. Raises InputError unless w >= 1 and w_r* >= 0."""
        if frames_per_search < 1 or reuse_window_frames < 0:
            raise InputError(
                "frames per search must be >= 1 and the reuse window >= 0 frames, "
                f"not {frames_per_search} and {reuse_window_frames}"
            )
        nothing = np.empty(0, np.int32)
        return cls(frames_per_search, reuse_window_frames, nothing, nothing, -1, 0)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def in_cut(self) -> NDArray[np.bool_]:
        """[held] whether the node is in the newest cut."""
        return self.last == IN_CUT

    @property
    def cut_ids(self) -> Int32:
        """The newest cut, ascending."""
        return self.ids[self.in_cut]

    def updated(
        self, search_index: int, added: Int32, removed: Int32
    ) -> tuple[ManagementTable, TableChange]:
        """The table after a search whose cut gained ``added`` and lost ``removed`` (ascending ids).

        Raises InputError when the search is not the next one, an added node is in the cut
        already, or a removed one is not.
        """
        if search_index != self.search_index + 1:
            raise InputError(
                f"search index must be {self.search_index + 1}, the next one, not {search_index}"
            )
        here, at = self._find(added)
        back = at[here]
        left, gone = self._find(removed)
        if not left.all() or (self.last[gone] != IN_CUT).any():
            raise InputError(f"search {search_index}: every removed node must be in the cut")
        if (self.last[back] == IN_CUT).any():
            raise InputError(f"search {search_index}: no added node may be in the cut already")
        last = self.last.copy()
        last[back] = IN_CUT
        last[gone] = self.search_index
        age = self.frames_per_search * (search_index - last.astype(np.int64))
        kept = ~((last != IN_CUT) & (age > self.reuse_window_frames))
        evicted, needed = self.ids[~kept], added[~here]
        positions = np.searchsorted(self.ids[kept], needed)
        change = TableChange(needed, added[here], evicted, kept, positions)
        new = np.full(len(needed), IN_CUT)
        state_hash = (
            self.state_hash
            ^ _hash(self.ids[back], self.last[back])
            ^ _hash(self.ids[back], last[back])
            ^ _hash(self.ids[gone], self.last[gone])
            ^ _hash(self.ids[gone], last[gone])
            ^ _hash(evicted, last[~kept])
            ^ _hash(needed, new)
        )
        table = replace(
            self,
            ids=change.splice(self.ids, needed),
            last=change.splice(last, new),
            search_index=search_index,
            state_hash=state_hash,
        )
        return table, change

    def _find(self, ids: Int32) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
        """Whether each of ``ids`` is held, and where (or where it would be, capped)."""
        at = np.searchsorted(self.ids, ids)
        if not len(self.ids):
            return np.zeros(len(ids), np.bool_), at
        at = np.minimum(at, len(self.ids) - 1)
        return self.ids[at] == ids, at


def _hash(ids: Int32, last: Int32) -> int:
    """Exclusive or of a 64-bit mix (splitmix64) of every (id, last)."""
    x = (ids.astype(np.uint64) << np.uint64(32)) | last.astype(np.uint32).astype(np.uint64)
    x += np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return int(np.bitwise_xor.reduce(x ^ (x >> np.uint64(31)), initial=np.uint64(0)))


_HEADER = struct.Struct(
    "<IIIIQQQ"
)  # index, frame, re-activated, removed, two hashes, payload bytes


@dataclass(frozen=True)
class DeltaCut:
    """One search result as it travels: what the client must do to hold and draw the new cut."""

    search_index: int
    frame: int
    reactivated: Int32  # ascending; held by the client, in the cut again
    removed: Int32  # ascending; left the cut
    payload: bytes  # the codec's coding of the nodes the client does not hold
    state_hash: int  # of the management table after this message
    codec_hash: int  # version of the codec's parameters and codebook

    def to_bytes(self) -> bytes:
        """Body of a message."""
        writer = ColumnWriter()
        writer.raw(
            _HEADER.pack(
                self.search_index,
                self.frame,
                len(self.reactivated),
                len(self.removed),
                self.state_hash,
                self.codec_hash,
                len(self.payload),
            )
        )
        writer.differences(self.reactivated)
        writer.differences(self.removed)
        writer.raw(self.payload)
        return writer.bytes()

    @classmethod
    def from_bytes(cls, body: bytes) -> DeltaCut:
        """Inverse of `to_bytes`. Raises RemoteProtocolError for anything it would not write."""
        reader = ColumnReader(body)
        index, frame, reactivated, removed, state_hash, codec_hash, size = _HEADER.unpack(
            reader.raw(_HEADER.size)
        )
        ids = [reader.differences(np.int32, count) for count in (reactivated, removed)]
        payload = reader.raw(size)
        reader.finish()
        if any(len(i) and (i[0] < 0 or (np.diff(i.astype(np.int64)) <= 0).any()) for i in ids):
            raise RemoteProtocolError(f"search {index}: ids must be ascending and >= 0")
        return cls(index, frame, ids[0], ids[1], payload, state_hash, codec_hash)
