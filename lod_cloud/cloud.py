"""The cloud end of one session: searches, keeps the management table, writes messages. No
sockets, no clock.

Every search gives one message. Most are *steps*, which follow the message before. When the client
reports that something is missing, the next one is a *repair*: the difference between the newest cut
and the last state the client has acknowledged, instead of what was lost. When it is not known what
the client holds, it is a *start*, from nothing. When too much is unacknowledged it is a *probe*
without a change, and what the searches find meanwhile becomes one difference.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from gaussians.errors import InputError
from lod_cloud.codec import PaperCodec
from lod_cloud.criterion import SearchRequest
from lod_cloud.cut import Cut, compose, difference
from lod_cloud.delta_cut import DeltaCut, Probe, Report
from lod_cloud.events import Events
from lod_cloud.journal import Entry, Journal
from lod_cloud.lod_tree import Int32, LodTree
from lod_cloud.management_table import ManagementTable, TableChange
from lod_cloud.protocol import (
    DELTA_CUT,
    PROBE,
    REPORT,
    SESSION_START,
    LocalProtocolError,
    RemoteProtocolError,
    seal,
    unseal,
)
from lod_cloud.search import flat_search
from lod_cloud.session import SessionStart
from lod_cloud.tree_encoder import TreeEncoder

UNACKNOWLEDGED_MESSAGES = 256  # 11 s of searches every four frames
UNACKNOWLEDGED_NODES = 1 << 20  # 4 MiB; more would be as good as a whole cut

MessageKind = Literal["start", "step", "repair", "probe"]


class CutChange(Protocol):
    """What a search tells about its cut: a `lod_cloud.search.SearchResult`, for example."""

    @property
    def added(self) -> Int32:
        """In the cut now and not at the search before, ascending."""

    @property
    def removed(self) -> Int32:
        """In the cut at the search before and not now, ascending."""

    cut_size: int
    nodes_tested: int
    bytes_touched: int


@dataclass(frozen=True)
class SearchStats:
    """One search and its message, counted."""

    kind: MessageKind
    search_index: int
    frame: int
    cut_size: int
    added: int  # in the cut now, not in the one sent before; = payloads + reactivated for a step
    payloads: int  # nodes sent
    reactivated: int  # nodes named because the client still holds them
    removed: int  # in the cut sent before, not now
    evicted: int  # nodes whose reuse window is over
    held: int  # nodes the client holds after the message
    escapes: int  # payloads sent in float32
    message_bytes: int  # on the line
    payload_bytes: int  # of the nodes sent, before zstd
    nodes_tested: int
    bytes_touched: int


@dataclass(frozen=True)
class _Sets:
    """What a message names, and from which state on."""

    base: int
    change: TableChange
    sent: Int32
    reactivated: Int32
    removed: Int32
    dropped: Int32
    entry: Entry  # what to remember of it
    events: Events | None = None  # says the same as the lists


class Cloud:
    """Serves one client: one search every ``frames_per_search`` frames, one message per search.

    Memory per client, whether it answers or not: a byte per node of the tree and at most 8 B per
    node held (`ManagementTable`), 8 MiB of what is unacknowledged, and the ids of the newest cut
    and of its difference to the one sent, 4 B each. At 5 M leaves and a cut of 1.2 M nodes that is
    16 MB on a walk and at most 55 MB, with two cuts held after a teleport.

    Parameters
    ----------
    tree, codec
        The scene and how its nodes are coded. A `TreeEncoder` instead of a codec shares its work
        between sessions.
    frames_per_search, reuse_window_frames
        w and w_r* of the paper (Sec. 4.3, Sec. 6).
    session
        Number that tells this session from all others the client may know.
    unacknowledged
        How many messages, and node ids in them, may be underway.
    """

    def __init__(
        self,
        tree: LodTree,
        codec: PaperCodec | TreeEncoder,
        *,
        frames_per_search: int = 4,
        reuse_window_frames: int = 32,
        session: int = 0,
        unacknowledged: tuple[int, int] = (UNACKNOWLEDGED_MESSAGES, UNACKNOWLEDGED_NODES),
    ) -> None:
        self.tree = tree
        self._encoder = codec if isinstance(codec, TreeEncoder) else TreeEncoder(tree, codec)
        if self._encoder.tree is not tree:
            raise InputError("the encoder must belong to the tree that is searched")
        self.table = ManagementTable(len(tree), frames_per_search, reuse_window_frames)
        self.session = session
        self.sequence = 0  # of the newest change sent
        self.cut: Cut | None = None  # of the newest search, when that came as a whole
        self.stats: SearchStats | None = None  # of the newest search
        self._journal = Journal(*unacknowledged)
        self._pending = _NOTHING, _NOTHING  # added to and removed from the table's cut, not sent
        self._search_index = self._frame = -1
        self._lost = self._start_over = False  # what the newest report asks for
        self._repaired = 0  # sequence number of the newest message that was no step
        self._reported = 0, 0, 0  # connection, applied, seen of the newest report

    @property
    def state_bytes(self) -> int:
        """Memory of this client, without the tree and the search."""
        pending = sum(ids.nbytes for ids in self._pending)
        cut = self.cut.node_ids.nbytes if self.cut else 0
        return self.table.state_bytes + self._journal.state_bytes + pending + cut

    def session_start(self) -> bytes:
        """The first message: what the client needs to understand the others, codebook included."""
        start = SessionStart(
            self.session,
            len(self.tree),
            self.table.frames_per_search,
            self.table.reuse_window_frames,
            self._encoder.codec,
        )
        return seal(SESSION_START, start.to_bytes())

    def search(self, request: SearchRequest, frame: int) -> bytes:
        """Find the cut and return the message that brings the client to it."""
        return self.send(flat_search(self.tree, request), frame)

    def send(self, cut: Cut, frame: int) -> bytes:
        """The message for a cut found elsewhere. Raises LocalProtocolError when ``frame`` does not
        rise. Costs what the cut has.
        """
        added = cut.node_ids[~self.table.in_cut(cut.node_ids)]
        removed = difference(self.table.cut_ids, cut.node_ids)
        message = self._deliver(added, removed, frame, cut)
        self.cut = cut
        return message

    def send_change(self, change: CutChange, frame: int) -> bytes:
        """The message for a search that says what changed since the one before; the first one
        adds the whole cut. Costs what changed.
        """
        added, removed = compose(self._pending, (change.added, change.removed))
        message = self._deliver(added, removed, frame, change)
        self.cut = None
        return message

    def receive(self, message: bytes) -> None:
        """Take in a report of the client; an old one says nothing new.

        Raises RemoteProtocolError for anything else, and for reports of what was never sent.
        """
        kind, body = unseal(message)
        if kind != REPORT:
            raise RemoteProtocolError(f"message kind must be {REPORT}, not {kind}")
        report = Report.from_bytes(body)
        if report.session != self.session:
            raise RemoteProtocolError(f"session must be {self.session}, not {report.session}")
        if max(report.applied, report.seen) > self.sequence:
            raise RemoteProtocolError(
                f"sequence numbers must be at most {self.sequence}, the newest sent, "
                f"not {report.applied} applied and {report.seen} seen"
            )
        position = report.connection, report.applied, report.seen
        if position >= self._reported:
            self._take(report, reconnected=report.connection > self._reported[0])
            self._reported = position

    def _take(self, report: Report, *, reconnected: bool) -> None:
        again = report.applied < self._journal.applied  # what it had it has no longer
        right = not again and self._journal.acknowledge(report.applied, report.state_hash)
        if not reconnected and report.seen < self._repaired:
            return  # was written before the message that already answers it arrived
        old = self._lost and (report.applied, report.seen) == self._reported[1:]
        self._lost = report.missing or reconnected or old
        self._start_over = self._start_over or report.start_over or not right

    def _deliver(self, added: Int32, removed: Int32, frame: int, found: Cut | CutChange) -> bytes:
        """The next message, given the change of the table's cut."""
        if not self._frame < frame < 2**32:
            raise LocalProtocolError(
                f"frame must rise from search to search: {frame} after {self._frame}"
            )
        index = self._search_index + 1
        cut_size = len(found) if isinstance(found, Cut) else found.cut_size
        kind, table, sets = self._plan(index, added, removed)
        escapes, payload = 0, b""
        if sets is None:
            message = seal(PROBE, Probe(self.session, self.sequence).to_bytes())
            self._pending = added, removed
        else:
            payload, escapes = self._encoder.encode(sets.sent, places=sets.events is None)
            message = seal(DELTA_CUT, self._delta(sets, frame, payload).to_bytes())
            self._commit(kind, table, sets)
        self._search_index, self._frame = index, frame
        self.stats = SearchStats(
            kind=kind,
            search_index=index,
            frame=frame,
            cut_size=cut_size,
            added=len(added),
            payloads=len(sets.sent) if sets else 0,
            reactivated=len(sets.reactivated) if sets else 0,
            removed=len(removed),
            evicted=len(sets.change.evicted) if sets else 0,
            held=len(self.table),
            escapes=escapes,
            message_bytes=len(message),
            payload_bytes=len(payload),
            nodes_tested=found.nodes_tested,
            bytes_touched=found.bytes_touched,
        )
        return message

    def _plan(
        self, index: int, added: Int32, removed: Int32
    ) -> tuple[MessageKind, ManagementTable, _Sets | None]:
        """Which kind of message comes next, the table it changes, and what it says."""
        if self.sequence == 0 or self._start_over:
            return self._start(index, added, removed)
        if self._lost:
            names = self._journal.unacknowledged()
            if names is None:
                return self._start(index, added, removed)
            return "repair", self.table, self._repair(index, added, removed, names)
        if self._journal.full:
            return "probe", self.table, None
        return "step", self.table, self._step(index, added, removed)

    def _step(self, index: int, added: Int32, removed: Int32) -> _Sets:
        change = self.table.prepare_step(index, added, removed)
        back = added[self.table.holds(added)]
        entry = self._entry(change, np.concatenate([added, removed]), change.needed)
        events = Events.between(self.tree, added, removed, change.needed)
        return _Sets(self.sequence, change, change.needed, back, removed, _NOTHING, entry, events)

    def _repair(
        self, index: int, added: Int32, removed: Int32, names: tuple[Int32, Int32]
    ) -> _Sets:
        """Sets every node that a message underway may have touched, whatever arrived of them.

        A node that some message underway brought, or that is held no longer, is sent if it is in
        the cut and dropped if it is not; the client surely holds all others.
        """
        named = np.unique(np.concatenate([names[0], added, removed]))
        doubtful = np.isin(named, names[1]) | ~self.table.holds(named)
        drawn = self.table.in_cut(named) & ~np.isin(named, removed) | np.isin(named, added)
        left, dropped = named[~drawn & ~doubtful], named[~drawn & doubtful]
        change = self.table.prepare(index, named[drawn], left, dropped)
        sent, back = named[drawn & doubtful], named[drawn & ~doubtful]
        entry = self._entry(change, named, named[doubtful])
        return _Sets(self._journal.applied, change, sent, back, left, dropped, entry)

    def _start(
        self, index: int, added: Int32, removed: Int32
    ) -> tuple[MessageKind, ManagementTable, _Sets]:
        cut = np.union1d(difference(self.table.cut_ids, removed), added)
        table = self.table.emptied()
        change = table.prepare_step(index, cut, _NOTHING)
        entry = Entry.start(self.sequence + 1, change.state_hash)
        sets = _Sets(0, change, cut, _NOTHING, _NOTHING, _NOTHING, entry)
        return "start", table, sets

    def _entry(self, change: TableChange, named: Int32, brought: Int32) -> Entry:
        limit = self._journal.node_limit
        return Entry.change(self.sequence + 1, change.state_hash, named, brought, limit)

    def _delta(self, sets: _Sets, frame: int, payload: bytes) -> DeltaCut:
        return DeltaCut(
            session=self.session,
            sequence=self.sequence + 1,
            base=sets.base,
            search_index=sets.change.search_index,
            frame=frame,
            reactivated=_NOTHING if sets.events else sets.reactivated,
            removed=_NOTHING if sets.events else sets.removed,
            events=sets.events,
            dropped=sets.dropped,
            payload=payload,
            state_hash=sets.change.state_hash,
            codec_hash=self._encoder.codec.version,
        )

    def _commit(self, kind: MessageKind, table: ManagementTable, sets: _Sets) -> None:
        table.commit(sets.change)
        self.table, self._pending = table, (_NOTHING, _NOTHING)
        self.sequence += 1
        if kind == "step":
            self._journal.add(sets.entry)
        else:
            self._journal.replace(sets.entry)
            self._repaired = self.sequence
            self._lost = self._start_over = False


_NOTHING = np.empty(0, np.int32)
