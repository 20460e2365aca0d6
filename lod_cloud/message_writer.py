"""Writes the messages of a session: what is to be told, from which state on. Changes nothing.

Which kind of message is due, and whether what was written is sent, is up to `lod_cloud.cloud`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lod_cloud.codec import NOTHING_CODED, Encoded
from lod_cloud.delta_cut import DeltaCut, Probe
from lod_cloud.events import Events
from lod_cloud.journal import Entry, Journal
from lod_cloud.lod_tree import Int32
from lod_cloud.management_table import ManagementTable, TableChange
from lod_cloud.pacing import Portion
from lod_cloud.protocol import DELTA_CUT, PROBE, seal
from lod_cloud.search import SearchTree
from lod_cloud.search.events import nodes_that_entered
from lod_cloud.search_stats import MessageKind
from lod_cloud.tree_encoder import TreeEncoder

_NOTHING = np.empty(0, np.int32)
_ROOT = np.zeros(1, np.int32)


@dataclass(frozen=True)
class Sets:
    """What a message names, and from which state on."""

    base: int
    change: TableChange
    sent: Int32
    reactivated: Int32
    removed: Int32
    dropped: Int32
    completed: Int32  # held plain before
    entry: Entry  # what to remember of it
    events: Events | None = None  # says the same as the lists


@dataclass(frozen=True)
class Draft:
    """A message that may be sent, and the state it leads to; of a probe, the state it leaves."""

    kind: MessageKind
    message: bytes
    portion: Portion
    table: ManagementTable | None = None
    sets: Sets | None = None
    added: int = 0
    merged: int = 0  # nodes that the client merges
    coded: Encoded = NOTHING_CODED
    plain: bool = False  # the nodes sent are

    @property
    def payloads(self) -> int:
        """Nodes sent."""
        return self.coded.sent

    @property
    def payload_bytes(self) -> int:
        """Of the nodes sent, before zstd."""
        return len(self.coded.payload)


@dataclass(frozen=True)
class MessageWriter:
    """Drafts of the one message that follows from a session's state and its newest search."""

    session: int
    sequence: int  # of the newest change sent
    search_index: int
    frame: int
    tree: SearchTree
    table: ManagementTable
    journal: Journal
    encoder: TreeEncoder
    plain: bool  # what is sent comes without harmonics above degree 0

    def probe(self, portion: Portion) -> Draft:
        """Without a change; ``portion`` says what is pending."""
        body = Probe(self.session, self.sequence).to_bytes()
        return Draft("probe", seal(PROBE, body), portion)

    def step(self, portion: Portion, completing: int = 0) -> Draft:
        """What follows the message before; so many of the nodes that wait for their harmonics get
        them, see `waiting`.
        """
        added, removed = self._changed(portion)
        held = self.table.holds(added)
        fresh, back = added[~held], added[held]
        events = Events.of(self.encoder.tree, portion.expanded, portion.collapsed)
        events, sent = self.encoder.told(events, fresh, self.table)
        completed = self.waiting(portion)[:completing] if completing else _NOTHING
        change = self.table.prepare_step(
            self.search_index, added, removed, sent if self.plain else _NOTHING, completed
        )
        brought = np.concatenate([fresh, completed])
        entry = self._entry(change, np.concatenate([added, removed]), brought)
        sets = Sets(self.sequence, change, sent, back, removed, _NOTHING, completed, entry, events)
        return self._written("step", self.table, sets, portion, len(added), len(fresh))

    def waiting(self, portion: Portion) -> Int32:
        """Nodes held plain that stay in the cut, in the order in which they are completed."""
        return self.table.waiting(self._changed(portion)[1])

    def repair(self, portion: Portion, names: tuple[Int32, Int32]) -> Draft:
        """Sets every node that a message underway may have touched, whatever arrived of them:
        ``names``, see `Journal.unacknowledged`.

        A node that some message underway brought, or that is held no longer, is sent if it is in
        the cut and dropped if it is not; the client surely holds all others.
        """
        added, removed = self._changed(portion)
        named = np.unique(np.concatenate([names[0], added, removed]))
        doubtful = np.isin(named, names[1]) | ~self.table.holds(named)
        drawn = self.table.in_cut(named) & ~np.isin(named, removed) | np.isin(named, added)
        left, dropped = named[~drawn & ~doubtful], named[~drawn & doubtful]
        sent, back = named[drawn & doubtful], named[drawn & ~doubtful]
        values = (sent, _NOTHING) if self.plain else (_NOTHING, sent)
        change = self.table.prepare(self.search_index, named[drawn], left, dropped, *values)
        entry = self._entry(change, named, named[doubtful])
        sets = Sets(self.journal.applied, change, sent, back, left, dropped, _NOTHING, entry)
        return self._written("repair", self.table, sets, portion, len(added), len(sent))

    def start(self, portion: Portion) -> Draft:
        """The client's whole cut, from nothing."""
        cut = self._changed(portion)[0] if len(portion.expanded) else _ROOT
        table = self.table.emptied()
        plain = cut if self.plain else _NOTHING
        change = table.prepare_step(self.search_index, cut, _NOTHING, plain)
        entry = Entry.start(self.sequence + 1, change.state_hash)
        events = Events.start(self.encoder.tree, portion.expanded)
        sets = Sets(0, change, cut, _NOTHING, _NOTHING, _NOTHING, _NOTHING, entry, events)
        return self._written("start", table, sets, portion, len(cut), len(cut))

    def _changed(self, portion: Portion) -> tuple[Int32, Int32]:
        """Nodes that enter and leave the client's cut."""
        tree, expanded, collapsed = self.tree, portion.expanded, portion.collapsed
        return (
            nodes_that_entered(tree, expanded, collapsed),
            nodes_that_entered(tree, collapsed, expanded),
        )

    def _entry(self, change: TableChange, named: Int32, brought: Int32) -> Entry:
        limit = self.journal.node_limit
        return Entry.change(self.sequence + 1, change.state_hash, named, brought, limit)

    def _written(
        self,
        kind: MessageKind,
        table: ManagementTable,
        sets: Sets,
        portion: Portion,
        added: int,
        fresh: int,
    ) -> Draft:
        """``fresh``: nodes sent, and those that the client merges instead."""
        if sets.events is None:
            coded = self.encoder.encode(sets.sent, plain=self.plain)
        else:
            coded = self.encoder.encode_step(sets.events, sets.sent, table, plain=self.plain)
        some = len(sets.completed) > 0
        harmonics = self.encoder.encode_harmonics(sets.completed) if some else NOTHING_CODED
        delta = DeltaCut(
            session=self.session,
            sequence=self.sequence + 1,
            base=sets.base,
            search_index=self.search_index,
            frame=self.frame,
            reactivated=_NOTHING if sets.events else sets.reactivated,
            removed=_NOTHING if sets.events else sets.removed,
            events=sets.events,
            plain=self.plain,
            completed=harmonics.sent,
            harmonics=harmonics.payload,
            dropped=sets.dropped,
            payload=coded.payload,
            state_hash=sets.change.state_hash,
            codec_hash=self.encoder.codec.version,
        )
        message = seal(DELTA_CUT, delta.to_bytes(self.encoder.child_numbers))
        return Draft(
            kind, message, portion, table, sets, added, fresh - len(sets.sent), coded, self.plain
        )
