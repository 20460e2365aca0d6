"""Codes the nodes of one tree for all sessions that look at it."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from gaussians.errors import InputError
from lod_cloud.child_numbers import ChildNumbers
from lod_cloud.codec import Codec, Encoded, References
from lod_cloud.codec.training import harmonics
from lod_cloud.cut import without
from lod_cloud.depth_first import depth_first
from lod_cloud.events import Events
from lod_cloud.lod_tree import Int32, LodTree
from lod_cloud.management_table import ManagementTable
from lod_cloud.node_records import NodeRecords
from lod_cloud.siblings import faithful

_BLOCK = 1 << 14  # nodes whose words are looked for at a time


class TreeEncoder:
    """Codes nodes of one tree, looking for a node's codebook words only once. Serves many
    sessions.

    Memory: words and two flags per node of the tree, of which the system provides only the pages
    with nodes that were coded (4 B per node with two stages of up to 256 words, 4 with one of
    4096).
    """

    def __init__(self, tree: LodTree, codec: Codec) -> None:
        if codec.sh_degree != tree.sh_degree:
            raise InputError(
                f"codec must be trained for SH degree {tree.sh_degree}, not {codec.sh_degree}"
            )
        self.tree, self.codec = tree, codec
        self.child_numbers = ChildNumbers.of(tree)
        book = codec.codebook
        stages, kind = (len(book.stages), book.index_type) if book else (0, np.uint8)
        self._words: NDArray[np.unsignedinteger] = np.zeros((len(tree), stages), kind)
        self._near = np.zeros(len(tree), np.bool_)
        self._known = np.zeros(len(tree), np.bool_)

    def encode(self, ids: Int32, *, plain: bool = False) -> Encoded:
        """The nodes ``ids`` (ascending) for a client that may hold anything; see `Codec.encode`."""
        return self._coded(ids, None, places=True, plain=plain)

    def told(self, events: Events, needed: Int32, table: ManagementTable) -> tuple[Events, Int32]:
        """Events as they are to be told to a client with this table, which make it hold ``needed``
        (ascending), and what of that it must be sent.
        """
        if not self.codec.merges:
            return events, needed
        unmerged = self._unmerged(events, needed, table)
        events = dataclasses.replace(events, unmerged=unmerged)
        return events, without(needed, without(events.tops, unmerged))

    def encode_step(
        self, events: Events, sent: Int32, table: ManagementTable, *, plain: bool = False
    ) -> Encoded:
        """The nodes ``sent`` (see `told`), for a client with this table, in the order that follows
        from ``events``.
        """
        above = self.tree.parent[events.expanded]
        sent = sent[depth_first(sent, self.tree.parent[sent], events.expanded, above)]
        related = self.codec.relative and len(table) > 0
        references = self._references(sent, events, table) if related else None
        return self._coded(sent, references, places=False, plain=plain)

    def encode_harmonics(self, ids: Int32) -> Encoded:
        """Harmonics above degree 0 of nodes that the client holds plain, which only a codec asks
        for that sends them apart.
        """
        assert self.codec.apart is not None
        self._find_words(ids)
        near, inner = self._near[ids], self.tree.child_count[ids] > 0
        exact = harmonics(self.tree.gaussians, ids[~near])
        return self.codec.apart.encode(self._words[ids], near, exact, inner)

    def _coded(
        self, ids: Int32, references: References | None, *, places: bool, plain: bool
    ) -> Encoded:
        if not plain:
            self._find_words(ids)
        nodes = NodeRecords.of(self.tree, ids)
        return self.codec.encode(
            nodes,
            self._words[ids],
            self._near[ids],
            places=places,
            references=references,
            plain=plain,
        )

    def _find_words(self, ids: Int32) -> None:
        fresh = ids[~self._known[ids]]
        for begin in range(0, len(fresh), _BLOCK):
            block = fresh[begin : begin + _BLOCK]
            self._words[block], self._near[block] = self.codec.assign_words(self.tree, block)
            self._known[block] = True

    def _unmerged(self, events: Events, needed: Int32, table: ManagementTable) -> Int32:
        """Tops that the client needs and cannot merge from what it holds: what is plain has no
        harmonics to be merged.
        """
        collapsed = np.union1d(events.tops, events.inner).astype(np.int32)
        bad = collapsed[~faithful(self.tree, collapsed)]
        if table.plain_in_cut and len(collapsed):
            bare = self.tree.parent[table.waiting(collapsed[:0])]
            bad = np.union1d(bad, bare[np.isin(bare, collapsed)]).astype(np.int32)
        above = np.isin(bad, events.inner)
        while above.any():
            bad = np.unique(np.concatenate([bad[~above], self.tree.parent[bad[above]]]))
            above = np.isin(bad, events.inner)
        return np.intersect1d(bad, needed, assume_unique=True)

    def _references(self, sent: Int32, events: Events, table: ManagementTable) -> References:
        """For each node one that the client holds: the nearest ancestor, and for a node that takes
        the place of its descendants the first of these.
        """
        tree = self.tree
        top = np.isin(sent, events.tops, assume_unique=True)
        held = np.where(top, tree.first_child[sent], tree.parent[sent])
        while not (there := table.holds(held)).all():
            held[~there & top] = tree.first_child[held[~there & top]]
            held[~there & ~top] = tree.parent[held[~there & ~top]]
        scene = tree.gaussians
        return References(held, scene.means[held], scene.scales[held].max(axis=1, initial=0))
