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

from lod_cloud.child_numbers import ChildNumbers
from lod_cloud.columns import ColumnReader, ColumnWriter
from lod_cloud.events import Events, read_ids
from lod_cloud.lod_tree import Int32
from lod_cloud.protocol import RemoteProtocolError

_HASHES = struct.Struct("<QI")  # state, codec
_EVENTS, _LISTS = 1, 0
_PLAIN, _COMPLETING = 2, 4  # added to it
_KINDS = (_LISTS, _LISTS | _PLAIN, _EVENTS, _EVENTS | _PLAIN, _EVENTS | _COMPLETING)
_PROBE = struct.Struct("<QI")
_REPORT = struct.Struct("<QIIQIB")
_MISSING, _START_OVER = 1, 2
_LOW_HALF = (1 << 32) - 1
_LARGEST = (1 << 31) - 1


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
    codec_hash: int  # version of the codec's parameters and codebook; its lower half travels
    events: Events | None = None  # instead of the three lists, and of ids in the payload
    plain: bool = False  # the payload comes without harmonics above degree 0
    completed: int = 0  # so many of `ManagementTable.waiting` get theirs, of a step
    harmonics: bytes = b""  # the codec's coding of these

    def to_bytes(self, numbers: ChildNumbers) -> bytes:
        """Body of a message in a session with these child numbers."""
        writer = ColumnWriter()
        places = (self.session, self.sequence, self.sequence - self.base, self.search_index)
        for number in (*places, self.frame):
            writer.varint(number)
        writer.raw(_HASHES.pack(self.state_hash, self.codec_hash & _LOW_HALF))
        kind = _LISTS if self.events is None else _EVENTS
        writer.varint(kind | _PLAIN * self.plain | _COMPLETING * (self.completed > 0))
        if self.completed:
            writer.varint(self.completed)
            writer.varint(len(self.harmonics))
            writer.raw(self.harmonics)
        if self.events is not None:
            writer.raw(self.events.to_bytes(numbers))
        else:
            for ids in (self.reactivated, self.removed, self.dropped):
                writer.varint(len(ids))
                writer.ascending(ids)
        writer.raw(self.payload)
        return writer.bytes()

    @classmethod
    def from_bytes(cls, body: bytes, numbers: ChildNumbers) -> DeltaCut:
        """Inverse of `to_bytes`. Raises RemoteProtocolError for anything it would not write."""
        reader = ColumnReader(body)
        session, sequence, back, index, frame = (reader.varint() for _ in range(5))
        state_hash, codec_hash = _HASHES.unpack(reader.raw(_HASHES.size))
        kind = reader.varint()
        if kind not in _KINDS:
            raise RemoteProtocolError(f"search {index}: must carry either events or lists")
        if max(sequence, index, frame) > _LARGEST:
            raise RemoteProtocolError(f"sequence, search and frame must be at most {_LARGEST}")
        if not 0 < back <= sequence:
            raise RemoteProtocolError(
                f"base must be below sequence number {sequence}, not {sequence - back}"
            )
        completed = reader.varint() if kind & _COMPLETING else 0
        harmonics = reader.raw(reader.varint()) if kind & _COMPLETING else b""
        if not kind & _COMPLETING == _COMPLETING * (completed > 0):
            raise RemoteProtocolError(f"search {index}: must complete at least one node, or none")
        events = Events.read(reader, numbers) if kind & _EVENTS else None
        nothing = np.empty(0, np.int32)
        reactivated, removed, dropped = (
            nothing if kind & _EVENTS else read_ids(reader) for _ in range(3)
        )
        return cls(
            session=session,
            sequence=sequence,
            base=sequence - back,
            search_index=index,
            frame=frame,
            reactivated=reactivated,
            removed=removed,
            dropped=dropped,
            payload=reader.rest(),
            state_hash=state_hash,
            codec_hash=codec_hash,
            events=events,
            plain=bool(kind & _PLAIN),
            completed=completed,
            harmonics=harmonics,
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


def same_codec(codec_hash: int, version: int) -> bool:
    """Whether a message with this hash is meant for the codec of this version."""
    return codec_hash == version & _LOW_HALF


def exactly(body: bytes, size: int) -> bytes:
    """``body``, or RemoteProtocolError unless it has ``size`` bytes."""
    if len(body) != size:
        raise RemoteProtocolError(f"message body must have {size} bytes, not {len(body)}")
    return body
