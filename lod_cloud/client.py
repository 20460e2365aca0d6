"""The client end of one session: applies messages, says how far it is, and selects what to draw.
No sockets, no clock, no rendering.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gaussians.errors import InputError
from gaussians.scene import Scene
from lod_cloud.codec import Neighbours
from lod_cloud.criterion import SearchRequest
from lod_cloud.delta_cut import DeltaCut, Probe, Report, same_codec
from lod_cloud.lod_tree import Float32, Int32
from lod_cloud.management_table import ManagementTable, TableChange
from lod_cloud.node_records import NodeRecords
from lod_cloud.outcome import outcome
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
from lod_cloud.session import SessionStart
from lod_cloud.subgraph import LocalSubgraph

_NOTHING = np.empty(0, np.int32)
EARLY_MESSAGES = 64  # kept until what they follow arrives


@dataclass(frozen=True)
class _Applied:
    """One change."""

    change: TableChange
    payloads: int
    completed: int
    merged: int
    left: int  # nodes that left the cut


@dataclass(frozen=True)
class _Arrival:
    """What a message says, in nodes."""

    entered: Int32  # the cut; ascending
    left: Int32
    fresh: NodeRecords  # that came or were merged, known before or not
    sent: Int32  # those that came; ascending
    merged: int


@dataclass(frozen=True)
class ReceiveStats:
    """What one message brought about: the changes of that message and of earlier arrivals that
    had to wait for it, or none.
    """

    search_index: int  # of the newest change applied, -1 before the first
    frame: int  # likewise
    message_bytes: int
    applied: int  # changes
    payloads: int
    completed: int  # nodes known before whose harmonics above degree 0 came
    merged: int  # nodes computed from their children instead of sent
    reactivated: int
    removed: int
    evicted: int
    held: int
    refused: int  # earlier arrivals that led nowhere; `Client.report` asks for them


@dataclass(frozen=True)
class Selection:
    """What to draw: the finest complete set among the nodes held, from the client's position.

    Row i of ``scene`` is node ``node_ids[i]``, so equal depths are drawn in the order of node ids.
    """

    node_ids: Int32  # [M] ascending
    scene: Scene  # [M] decoded
    held: int  # nodes held by the client
    nodes_tested: int
    refined: int  # cut nodes (or their descendants) replaced by their children
    coarsened: int  # nodes that took the place of their children


class Client:
    """Holds exactly what the cloud's messages made it hold.

    Messages may come damaged, twice, in any order, or not at all: what is early waits, what is
    known already is passed over, and `report` tells the cloud what is missing. A message that is
    damaged or leads to another state than the cloud's raises RemoteProtocolError and changes
    nothing but that report.
    """

    def __init__(self) -> None:
        self.table: ManagementTable | None = None
        self.frame = -1  # of the newest search applied
        self.applied = 0  # sequence number of the newest change applied
        self._start: SessionStart | None = None
        self._subgraph = LocalSubgraph(0)
        self._newest: Selection | None = None
        self._early: dict[int, DeltaCut] = {}  # by sequence number
        self._connection = 0
        self._seen = 0
        self._damaged = False  # something unreadable came since the last change
        self._strayed = 0  # messages since the last change that led to a state not the cloud's

    def receive(self, message: bytes) -> ReceiveStats:
        """Take in a message of the cloud."""
        try:
            return self._receive(message)
        except RemoteProtocolError:
            self._damaged = True
            raise

    def report(self) -> bytes:
        """The message that tells the cloud how far this client is; one per message received or
        per pose sent, whichever is less. Raises LocalProtocolError before the session start.
        """
        if self._start is None or self.table is None:
            raise LocalProtocolError("the session start must arrive before anything is reported")
        report = Report(
            session=self._start.session,
            connection=self._connection,
            applied=self.applied,
            state_hash=self.table.state_hash,
            seen=self._seen,
            missing=self._damaged or self._seen > self.applied,
            start_over=self._strayed > 1,
        )
        return seal(REPORT, report.to_bytes())

    def reconnect(self) -> bytes:
        """The first message over a new connection: everything underway on the old one is lost."""
        self._connection += 1
        return self.report()

    def select(self, request: SearchRequest) -> Selection:
        """The finest complete set at ``request``'s position; see `LocalSubgraph.choose`.

        The same set as last time comes with the same Scene, not copied again. Raises
        LocalProtocolError before the first search result.
        """
        if self.table is None or len(self.table) == 0:
            raise LocalProtocolError("nothing to draw: the first search result must arrive first")
        choice = self._subgraph.choose(self.table.in_cut(self._subgraph.ids), request)
        node_ids = self._subgraph.ids[choice.rows]
        if self._newest is not None and np.array_equal(node_ids, self._newest.node_ids):
            node_ids, scene = self._newest.node_ids, self._newest.scene
        else:
            scene = self._subgraph.gaussians(choice.rows)
        self._newest = Selection(
            node_ids,
            scene,
            len(self._subgraph),
            choice.nodes_tested,
            choice.refined,
            choice.coarsened,
        )
        return self._newest

    def _receive(self, message: bytes) -> ReceiveStats:
        kind, body = unseal(message)
        if kind == SESSION_START:
            self._begin(SessionStart.from_bytes(body))
            return self._stats(len(message), [])
        if kind not in (DELTA_CUT, PROBE):
            raise RemoteProtocolError(
                f"message kind must be {SESSION_START}, {DELTA_CUT} or {PROBE}, not {kind}"
            )
        if self._start is None:
            raise RemoteProtocolError("session start must come before any search result")
        news = (
            DeltaCut.from_bytes(body, self._start.child_numbers)
            if kind == DELTA_CUT
            else Probe.from_bytes(body)
        )
        if news.session != self._start.session:
            raise RemoteProtocolError(f"session must be {self._start.session}, not {news.session}")
        self._seen = max(self._seen, news.sequence)
        if isinstance(news, Probe) or news.sequence <= self.applied:
            return self._stats(len(message), [])
        if news.base > self.applied:
            if len(self._early) < EARLY_MESSAGES:
                self._early[news.sequence] = news
            return self._stats(len(message), [])
        first = self._apply(news)
        others, refused = self._apply_early()
        return self._stats(len(message), [first, *others], refused)

    def _begin(self, start: SessionStart) -> None:
        """Enter a session; the one already entered goes on undisturbed."""
        if self._start is not None and start.session == self._start.session:
            if start.to_bytes() != self._start.to_bytes():
                raise RemoteProtocolError(f"session {start.session} must not start in two ways")
            return
        nodes = start.child_numbers.nodes
        table = ManagementTable(nodes, start.frames_per_search, start.reuse_window_frames)
        self._start, self.table = start, table
        self._subgraph, self._newest = LocalSubgraph(start.codec.sh_degree), None
        self._early = {}
        self.frame, self.applied, self._seen, self._connection = -1, 0, 0, 0
        self._damaged, self._strayed = False, 0

    def _apply_early(self) -> tuple[list[_Applied], int]:
        """Apply what was waiting for the newest change; also the number that led nowhere."""
        done: list[_Applied] = []
        refused = 0
        for sequence in sorted(self._early):
            delta = self._early[sequence]
            if sequence > self.applied and delta.base > self.applied:
                continue
            del self._early[sequence]
            if sequence > self.applied:
                try:
                    done.append(self._apply(delta))
                except RemoteProtocolError:
                    self._damaged = True
                    refused += 1
        return done, refused

    def _apply(self, delta: DeltaCut) -> _Applied:
        assert self._start is not None and self.table is not None
        codec = self._start.codec
        if delta.frame <= self.frame:
            raise RemoteProtocolError(f"frame must be above {self.frame}, not {delta.frame}")
        if (delta.plain or delta.completed) and codec.apart is None:
            raise RemoteProtocolError("nodes of this codec must come with their harmonics")
        if not same_codec(delta.codec_hash, codec.version):
            raise RemoteProtocolError(
                f"codebook version must be {codec.version:#x}, not ...{delta.codec_hash:08x}"
            )
        table = self.table if delta.base else self.table.emptied()
        graph = self._subgraph if delta.base else LocalSubgraph(codec.sh_degree)
        self._strayed += 1  # until it is known to be right
        if delta.events is None:
            nodes = codec.decode(delta.payload, plain=delta.plain)
            entered = np.sort(np.concatenate([nodes.ids, delta.reactivated]))
            arrival = _Arrival(entered, delta.removed, nodes, nodes.ids, 0)
        else:
            arrival = self._from_events(delta, table, graph)
        arrived = arrival.fresh
        completed, above = self._completed(delta, arrival.left, table, graph)
        change = _prepared(table, delta, arrival, completed)
        fresh = np.isin(arrived.ids, change.needed, assume_unique=True)
        if delta.base == delta.sequence - 1 and not fresh.all():
            raise RemoteProtocolError(
                f"search {delta.search_index}: must bring exactly what is new"
            )
        self._strayed = 0
        switched = ~fresh & (table.plain(arrived.ids) != delta.plain)
        graph.complete(arrived.ids[switched], arrived.gaussians.sh[switched, 1:])
        if len(completed):
            graph.complete(completed, above)
        if switched.any() or len(completed):
            self._newest = None
        graph.apply(change, arrived if fresh.all() else arrived.take(np.flatnonzero(fresh)))
        table.commit(change)
        self.table, self._subgraph = table, graph
        self.frame, self.applied = delta.frame, delta.sequence
        self._damaged = False
        payloads = len(arrived) - arrival.merged
        return _Applied(change, payloads, len(completed), arrival.merged, len(arrival.left))

    def _completed(
        self, delta: DeltaCut, left: Int32, table: ManagementTable, graph: LocalSubgraph
    ) -> tuple[Int32, Float32]:
        """Nodes held plain that get their harmonics above degree 0, and these."""
        assert self._start is not None
        apart = self._start.codec.apart
        if apart is None or not delta.completed:
            return _NOTHING, np.empty((0, 0, 3), np.float32)
        waiting = table.waiting(left)
        if delta.base != delta.sequence - 1 or delta.completed > len(waiting):
            raise RemoteProtocolError(
                f"search {delta.search_index}: must complete at most the {len(waiting)} nodes that "
                f"wait for their harmonics, not {delta.completed}"
            )
        nodes = waiting[: delta.completed]
        return nodes, apart.decode(delta.harmonics, graph.child_counts(nodes) > 0)

    def _from_events(
        self, delta: DeltaCut, table: ManagementTable, graph: LocalSubgraph
    ) -> _Arrival:
        assert self._start is not None and delta.events is not None
        codec = self._start.codec
        found = outcome(delta.events, table, graph, merges=codec.merges)
        related = codec.relative and len(table) > 0
        near = found.references
        references = Neighbours(near, graph.means(near)) if related else None
        arrived = codec.decode(
            delta.payload, (found.sent, found.sent_parents), references, plain=delta.plain
        )
        if len(found.merged):
            arrived = arrived.joined(found.merged)
        else:
            arrived = arrived.take(np.argsort(arrived.ids))
        arrived.check()
        sent = np.sort(found.sent)
        return _Arrival(found.entered, found.left, arrived, sent, len(found.merged))

    def _stats(self, size: int, applied: list[_Applied], refused: int = 0) -> ReceiveStats:
        assert self.table is not None
        return ReceiveStats(
            search_index=self.table.search_index,
            frame=self.frame,
            message_bytes=size,
            applied=len(applied),
            payloads=sum(one.payloads for one in applied),
            completed=sum(one.completed for one in applied),
            merged=sum(one.merged for one in applied),
            reactivated=sum(one.change.reactivated for one in applied),
            removed=sum(one.left for one in applied),
            evicted=sum(len(one.change.evicted) for one in applied),
            held=len(self.table),
            refused=refused,
        )


def _prepared(
    table: ManagementTable, delta: DeltaCut, arrival: _Arrival, completed: Int32
) -> TableChange:
    """The change that ``delta`` asks for, proved to lead to the cloud's state."""
    index = delta.search_index
    named = arrival.entered, arrival.left, delta.dropped
    complete = completed if delta.plain else np.concatenate([arrival.sent, completed])
    try:
        change = table.prepare(index, *named, arrival.sent if delta.plain else _NOTHING, complete)
    except InputError as error:
        raise RemoteProtocolError(str(error)) from error
    if change.state_hash != delta.state_hash:
        raise RemoteProtocolError(
            f"search {index}: state hash must be {delta.state_hash:#018x}, "
            f"not {change.state_hash:#018x}"
        )
    if not np.isin(change.needed, arrival.fresh.ids, assume_unique=True).all():
        raise RemoteProtocolError(f"search {index}: must bring every node that is new")
    return change
