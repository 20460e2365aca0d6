"""The cloud end of one session: searches, keeps the management table, writes messages. No
sockets, no clock.

Every search gives one message. Most are *steps*, which follow the message before. When the client
reports that something is missing, the next one is a *repair*: the difference between the newest
state and the last one the client has acknowledged, instead of what was lost. When it is not known
what the client holds, it is a *start*, from nothing. When too much is unacknowledged it is a
*probe* without a change, and what the searches find meanwhile becomes one difference.

With a *byte budget* no message is larger, and what does not fit is pending: the client is brought
to the cut found coarse to fine, near before far (`lod_cloud.pacing`), starting anew from every
search, so what a jump made useless is never sent. While that goes so far that tau is raised
(`lod_cloud.byte_budget`), nodes are sent *plain*, without their harmonics above degree 0; those
still in the cut when nothing else is pending are *completed* as the budget allows. A repair carries
again what was underway, which may be more.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from gaussians.errors import InputError
from lod_cloud.byte_budget import ByteBudget
from lod_cloud.codec import Codec
from lod_cloud.criterion import SearchRequest
from lod_cloud.delta_cut import Report
from lod_cloud.journal import Journal
from lod_cloud.lod_tree import LodTree
from lod_cloud.management_table import ManagementTable
from lod_cloud.message_writer import Draft, MessageWriter
from lod_cloud.pacing import ClientCut, Limit, Portion
from lod_cloud.protocol import (
    REPORT,
    SESSION_START,
    LocalProtocolError,
    RemoteProtocolError,
    seal,
    unseal,
)
from lod_cloud.search import Search, SearchResult, SearchTree, make_search
from lod_cloud.search_stats import SearchStats
from lod_cloud.session import SessionStart
from lod_cloud.tree_encoder import TreeEncoder

HYSTERESIS = 0.02  # measured on head traces: 66 % fewer changes for 0.2 % more nodes
UNACKNOWLEDGED_MESSAGES = 256  # 11 s of searches every four frames
UNACKNOWLEDGED_NODES = 1 << 19  # 2 MiB; more would be nearly as good as a whole cut


class Cloud:
    """Serves one client: one search every ``frames_per_search`` frames, one message per search.

    Memory per client, whether it answers or not: the state of its search, two bits and a byte per
    node of the tree and at most 8 B per node held (`ManagementTable`), and 4 MiB of what is
    unacknowledged; see `state_bytes`. At 5 M leaves, a cut of 1.7 M nodes and `auto`: 38 MB
    measured on a walk (27 of them the search's) and after teleports with 2.1 M nodes held, at most
    60 MB.

    Parameters
    ----------
    tree, codec
        The scene and how its nodes are coded. A `TreeEncoder` instead of a codec shares its work
        between sessions.
    search
        A search of its own in the same tree, whose `SearchTree` sessions may share. Without one:
        `auto`, with a hysteresis of 2 %.
    frames_per_search, reuse_window_frames
        w and w_r* of the paper (Sec. 4.3, Sec. 6).
    budget_bytes
        The most bytes of a message; one of a single event may be larger, and so may a repair.
        None: no limit.
    session
        Number that tells this session from all others the client may know.
    unacknowledged
        How many messages, and node ids in them, may be underway.

    Raises InputError for a search or an encoder of another tree and for a budget below 1.
    """

    def __init__(
        self,
        tree: LodTree,
        codec: Codec | TreeEncoder,
        *,
        search: Search | None = None,
        frames_per_search: int = 4,
        reuse_window_frames: int = 32,
        budget_bytes: int | None = None,
        session: int = 0,
        unacknowledged: tuple[int, int] = (UNACKNOWLEDGED_MESSAGES, UNACKNOWLEDGED_NODES),
    ) -> None:
        self.tree = tree
        self._encoder = codec if isinstance(codec, TreeEncoder) else TreeEncoder(tree, codec)
        if self._encoder.tree is not tree:
            raise InputError("the encoder must belong to the tree that is searched")
        self._search = search or make_search("auto", SearchTree.of(tree), hysteresis=HYSTERESIS)
        if len(self._search.tree) != len(tree):
            raise InputError(
                f"the search must be one in this tree of {len(tree)} nodes, "
                f"not in one of {len(self._search.tree)}"
            )
        self._budget = None if budget_bytes is None else ByteBudget(budget_bytes)
        self.table = ManagementTable(len(tree), frames_per_search, reuse_window_frames)
        self.session = session
        self.sequence = 0  # of the newest change sent
        self.found: SearchResult | None = None  # by the newest search
        self.stats: SearchStats | None = None  # of the newest search
        self._client = ClientCut(self._search.tree)  # the table's cut
        self._apart = self._encoder.codec.apart is not None
        self._level = False  # whether that was the cut found by the search before
        self._journal = Journal(*unacknowledged)
        self._search_index = self._frame = -1
        self._lost = self._start_over = False  # what the newest report asks for
        self._repaired = 0  # sequence number of the newest message that was no step
        self._reported = 0, 0, 0  # connection, applied, seen of the newest report

    @property
    def state_bytes(self) -> int:
        """Memory of this client, its search included, without the tree."""
        parts = (self.table, self._journal, self._client, self._search)
        return sum(part.state_bytes for part in parts)

    def session_start(self) -> bytes:
        """The first message: what the client needs to understand the others, codebook included."""
        start = SessionStart(
            self.session,
            self._encoder.child_numbers,
            self.table.frames_per_search,
            self.table.reuse_window_frames,
            self._encoder.codec,
        )
        return seal(SESSION_START, start.to_bytes())

    def search(self, request: SearchRequest, frame: int) -> bytes:
        """Find the cut and return the message that brings the client to it, or on its way there.

        Raises LocalProtocolError when ``frame`` does not rise. Costs what changed; more only
        after a probe or while something is pending.
        """
        self._check(frame)
        asked = self.asked(request)
        return self.answer(self._search.search(asked), asked, frame)

    def asked(self, request: SearchRequest) -> SearchRequest:
        """What is searched for when the client sends ``request``: with a budget tau may be raised
        (`ByteBudget.request`).
        """
        return self._budget.request(request, self.stats) if self._budget else request

    def answer(self, found: SearchResult, request: SearchRequest, frame: int) -> bytes:
        """The message for what this client's search has just found for ``request``, which is what
        `asked` gave: `search` in steps, for who wants to know how long each takes.
        """
        self._check(frame)
        self._search_index, self._frame = self._search_index + 1, frame
        draft = self._draft(found, request)
        self._commit(draft)
        self.found, self.stats = found, self._counted(found, request, draft)
        return draft.message

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

    def _check(self, frame: int) -> None:
        if not self._frame < frame < 2**32:
            raise LocalProtocolError(
                f"frame must rise from search to search: {frame} after {self._frame}"
            )

    def _take(self, report: Report, *, reconnected: bool) -> None:
        again = report.applied < self._journal.applied  # what it had it has no longer
        right = not again and self._journal.acknowledge(report.applied, report.state_hash)
        if not reconnected and report.seen < self._repaired:
            return  # was written before the message that already answers it arrived
        old = self._lost and (report.applied, report.seen) == self._reported[1:]
        self._lost = report.missing or reconnected or old
        self._start_over = self._start_over or report.start_over or not right

    def _draft(self, found: SearchResult, request: SearchRequest) -> Draft:
        """The next message, by what is known of the client."""
        names = self._journal.unacknowledged() if self._lost else None
        writer = self._writer()
        if self.sequence == 0 or self._start_over or (self._lost and names is None):
            self._client.clear()
            self._level = False
            return self._fitted(writer.start, found, request, least=0)
        if names is not None:
            return self._fitted(partial(writer.repair, names=names), found, request, least=0)
        if self._journal.full:
            nothing = Limit(0.0, 1.0, 1.0)
            wanted = self._search.refined
            return writer.probe(self._client.first_to(wanted, request, nothing, least=0))
        return self._filled(writer, self._fitted(writer.step, found, request, least=1))

    def _filled(self, writer: MessageWriter, draft: Draft) -> Draft:
        """The step ``draft``, with harmonics that are missing where nothing else is pending."""
        budget = self._budget
        if budget is None or budget.raised or not draft.portion.last:
            return draft
        waiting = len(writer.waiting(draft.portion)) if self.table.plain_in_cut else 0
        return budget.fill(draft, partial(writer.step, draft.portion), waiting)

    def _writer(self) -> MessageWriter:
        return MessageWriter(
            session=self.session,
            sequence=self.sequence,
            search_index=self._search_index,
            frame=self._frame,
            tree=self._search.tree,
            table=self.table,
            journal=self._journal,
            encoder=self._encoder,
            plain=self._budget is not None and self._budget.raised and self._apart,
        )

    def _fitted(
        self,
        write: Callable[[Portion], Draft],
        found: SearchResult,
        request: SearchRequest,
        *,
        least: int,
    ) -> Draft:
        """The message about all that is pending, or about what the budget allows."""
        budget, wanted = self._budget, self._search.refined
        events = len(found.expanded) + len(found.collapsed)
        if self._level and (budget is None or budget.may_fit(events)):
            draft = write(Portion(found.expanded, found.collapsed))
            if budget is None or len(draft.message) <= budget.size:
                return draft
        if budget is None:
            return write(self._client.all_to(wanted))

        def choose(limit: Limit) -> Portion:
            return self._client.first_to(wanted, request, limit, least=least)

        return budget.fit(choose, write, least)

    def _commit(self, draft: Draft) -> None:
        """The message is sent."""
        self._level = draft.portion.last and draft.sets is not None
        if draft.sets is None or draft.table is None:
            return
        draft.table.commit(draft.sets.change)
        self.table = draft.table
        self._client.commit(draft.portion)
        self.sequence += 1
        if draft.kind == "step":
            self._journal.add(draft.sets.entry)
        else:
            self._journal.replace(draft.sets.entry)
            self._repaired = self.sequence
            self._lost = self._start_over = False

    def _counted(self, found: SearchResult, request: SearchRequest, draft: Draft) -> SearchStats:
        sets, portion = draft.sets, draft.portion
        per_node = self._budget.per_node if self._budget else 0.0
        return SearchStats(
            kind=draft.kind,
            search_index=self._search_index,
            frame=self._frame,
            tau_px=request.tau_px,
            cut_size=found.cut_size,
            found=found.cut_size if found.first else len(found.added),
            added=draft.added,
            payloads=draft.payloads,
            plain=draft.payloads if draft.plain else 0,
            completed=len(sets.completed) if sets else 0,
            merged=draft.merged,
            reactivated=len(sets.reactivated) if sets else 0,
            removed=len(sets.removed) if sets else 0,
            evicted=len(sets.change.evicted) if sets else 0,
            held=len(self.table),
            pending=portion.pending,
            pending_error_px=portion.pending_error_px,
            pending_harmonics=self.table.plain_in_cut,
            deferred_bytes=round(portion.pending * per_node),
            escapes=draft.coded.escapes,
            message_bytes=len(draft.message),
            payload_bytes=draft.payload_bytes,
            nodes_tested=found.nodes_tested,
            bytes_touched=found.bytes_touched,
        )
