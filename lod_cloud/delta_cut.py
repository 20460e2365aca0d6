"""What travels between cloud and client once a session has started.

From the cloud: `DeltaCut`, a change of the management table with the Gaussians it needs, or
`Probe`, which only says how far the cloud is. From the client: `Report`, a cumulative
acknowledgement.

Every change has a *sequence number* and a *base*: it may be applied to the state after any message
from ``base`` up to the one before it, and leads to the same state from all of them, because it
names for every node concerned what becomes of it and not what it was. A change that follows the
one before has that one as its base; then events say the same in fewer bytes. One that makes up for
lost messages has the last message the client is known to have applied; one with base 0 starts from
nothing held.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from lod_cloud.columns import ColumnReader, ColumnWriter
from lod_cloud.events import Events
from lod_cloud.lod_tree import Int32
from lod_cloud.protocol import RemoteProtocolError

# session, sequence, base, index, frame, re-activated, removed, dropped, two hashes, payload bytes,
# whether it carries events
_DELTA = struct.Struct("<QIIIIIIIQQQB")
_PROBE = struct.Struct("<QI")
_REPORT = struct.Struct("<QIIQIB")
_MISSING, _START_OVER = 1, 2


@dataclass(frozen=True)
class DeltaCut:
    """One search result as it travels: what the client must do to hold and draw the new cut."""

    session: int
    sequence: int  # 1, 2, ...
    base: int  # applies to the states after messages base .. sequence - 1; 0: after any, from empty
    search_index: int
    frame: int
    reactivated: Int32  # ascending; held by the client, in the cut from now on
    removed: Int32  # ascending; held by the client, not in the cut from now on
    dropped: Int32  # ascending; not held by the client from now on
    payload: bytes  # the codec's coding of all other nodes that enter the cut
    state_hash: int  # of the management table after this message
    codec_hash: int  # version of the codec's parameters and codebook
    events: Events | None = None  # instead of the three lists, and of ids in the payload

    def to_bytes(self) -> bytes:
        """Body of a message."""
        writer = ColumnWriter()
        lists = (self.reactivated, self.removed, self.dropped)
        writer.raw(
            _DELTA.pack(
                self.session,
                self.sequence,
                self.base,
                self.search_index,
                self.frame,
                *(len(ids) for ids in lists),
                self.state_hash,
                self.codec_hash,
                len(self.payload),
                self.events is not None,
            )
        )
        if self.events is not None:
            writer.raw(self.events.to_bytes())
        for ids in lists:
            writer.differences(ids)
        writer.raw(self.payload)
        return writer.bytes()

    @classmethod
    def from_bytes(cls, body: bytes) -> DeltaCut:
        """Inverse of `to_bytes`. Raises RemoteProtocolError for anything it would not write."""
        reader = ColumnReader(body)
        session, sequence, base, index, frame, *counts, state_hash, codec_hash, size, kind = (
            _DELTA.unpack(reader.raw(_DELTA.size))
        )
        if kind > 1 or (kind == 1 and any(counts)):
            raise RemoteProtocolError(f"search {index}: must carry either events or lists")
        events = Events.read(reader) if kind else None
        ids = [reader.differences(np.int32, count) for count in counts]
        payload = reader.raw(size)
        reader.finish()
        if any(len(i) and (i[0] < 0 or (np.diff(i.astype(np.int64)) <= 0).any()) for i in ids):
            raise RemoteProtocolError(f"search {index}: ids must be ascending and >= 0")
        if not base < sequence:
            raise RemoteProtocolError(f"base must be below sequence number {sequence}, not {base}")
        reactivated, removed, dropped = ids
        return cls(
            session=session,
            sequence=sequence,
            base=base,
            search_index=index,
            frame=frame,
            reactivated=reactivated,
            removed=removed,
            dropped=dropped,
            payload=payload,
            state_hash=state_hash,
            codec_hash=codec_hash,
            events=events,
        )


@dataclass(frozen=True)
class Probe:
    """The cloud sends no change for now, because too much is unacknowledged."""

    session: int
    sequence: int  # of the newest change sent

    def to_bytes(self) -> bytes:
        """Body of a message."""
        return _PROBE.pack(self.session, self.sequence)

    @classmethod
    def from_bytes(cls, body: bytes) -> Probe:
        """Inverse of `to_bytes`. Raises RemoteProtocolError for anything it would not write."""
        return cls(*_PROBE.unpack(exactly(body, _PROBE.size)))


@dataclass(frozen=True)
class Report:
    """How far the client is. Reports may be lost: the next one says all that this one said."""

    session: int
    connection: int  # 0, 1, ...: rises when the client connects again, and all underway is lost
    applied: int  # sequence number of the newest change applied, all before it included
    state_hash: int  # of the client's table
    seen: int  # highest sequence number seen, applied or not
    missing: bool  # something was lost, damaged or refused after ``applied``
    start_over: bool  # the client's state is not to be trusted

    def to_bytes(self) -> bytes:
        """Body of a message."""
        flags = _MISSING * self.missing | _START_OVER * self.start_over
        numbers = (self.connection, self.applied, self.state_hash, self.seen)
        return _REPORT.pack(self.session, *numbers, flags)

    @classmethod
    def from_bytes(cls, body: bytes) -> Report:
        """Inverse of `to_bytes`. Raises RemoteProtocolError for anything it would not write."""
        session, connection, applied, state_hash, seen, flags = _REPORT.unpack(
            exactly(body, _REPORT.size)
        )
        if flags > _MISSING | _START_OVER:
            raise RemoteProtocolError(f"flags of a report must be 0 to 3, not {flags}")
        missing, start_over = bool(flags & _MISSING), bool(flags & _START_OVER)
        return cls(session, connection, applied, state_hash, seen, missing, start_over)


def exactly(body: bytes, size: int) -> bytes:
    """``body``, or RemoteProtocolError unless it has ``size`` bytes."""
    if len(body) != size:
        raise RemoteProtocolError(f"message body must have {size} bytes, not {len(body)}")
    return body
