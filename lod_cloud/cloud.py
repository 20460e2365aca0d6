"""The cloud end of one session: searches, keeps the management table, writes messages. No
sockets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gaussians.errors import InputError
from lod_cloud.codec import PaperCodec
from lod_cloud.criterion import SearchRequest
from lod_cloud.cut import Cut, difference
from lod_cloud.delta_cut import DeltaCut, ManagementTable
from lod_cloud.lod_tree import Int32, LodTree
from lod_cloud.node_records import NodeRecords
from lod_cloud.protocol import DELTA_CUT, SESSION_START, seal
from lod_cloud.search import flat_search
from lod_cloud.session import SessionStart


@dataclass(frozen=True)
class SearchStats:
    """One search and its message, counted."""

    search_index: int
    frame: int
    cut_size: int
    added: int  # in the cut now, not in the one before; = payloads + reactivated
    payloads: int  # nodes sent
    reactivated: int  # nodes the client still held
    removed: int  # in the cut before, not now
    evicted: int  # nodes whose reuse window is over
    held: int  # nodes the client holds after the message
    escapes: int  # payloads sent in float32
    message_bytes: int  # on the line
    payload_bytes: int  # of the nodes sent, before zstd
    nodes_tested: int
    bytes_touched: int


class TreeEncoder:
    """Codes nodes of one tree, looking for a node's codebook words only once. Serves many
    sessions.
    """

    def __init__(self, tree: LodTree, codec: PaperCodec) -> None:
        if codec.sh_degree != tree.sh_degree:
            raise InputError(
                f"codec must be trained for SH degree {tree.sh_degree}, not {codec.sh_degree}"
            )
        self.tree, self.codec = tree, codec
        stages = len(codec.codebook.stages) if codec.codebook else 0
        self._words = np.zeros((len(tree), stages), np.uint16)
        self._near = np.zeros(len(tree), np.bool_)
        self._known = np.zeros(len(tree), np.bool_)

    def encode(self, ids: Int32) -> tuple[bytes, int]:
        """Payload of the nodes ``ids`` (ascending), and how many of them are escapes."""
        fresh = ids[~self._known[ids]]
        self._words[fresh], self._near[fresh] = self.codec.assign_words(self.tree, fresh)
        self._known[fresh] = True
        nodes = NodeRecords.of(self.tree, ids)
        return self.codec.encode(nodes, self._words[ids], self._near[ids])


class Cloud:
    """Serves one client: one search every ``frames_per_search`` frames, one message per search.

    Parameters
    ----------
    tree, codec
        The scene and how its nodes are coded. A `TreeEncoder` instead of a codec shares its work
        between sessions.
    frames_per_search, reuse_window_frames
        w and w_r* of the paper (Sec. 4.3, Sec. 6).
    """

    def __init__(
        self,
        tree: LodTree,
        codec: PaperCodec | TreeEncoder,
        *,
        frames_per_search: int = 4,
        reuse_window_frames: int = 32,
    ) -> None:
        self.tree = tree
        self._encoder = codec if isinstance(codec, TreeEncoder) else TreeEncoder(tree, codec)
        if self._encoder.tree is not tree:
            raise InputError("the encoder must belong to the tree that is searched")
        self.table = ManagementTable.empty(frames_per_search, reuse_window_frames)
        self.cut: Cut | None = None  # of the newest search
        self.stats: SearchStats | None = None  # of the newest search
        self._frame = -1

    def session_start(self) -> bytes:
        """The first message: what the client needs to understand the others, codebook included."""
        start = SessionStart(
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
        """The message for a cut found elsewhere. Raises InputError when ``frame`` does not rise."""
        if not self._frame < frame < 2**32:
            raise InputError(f"frame must rise from search to search: {frame} after {self._frame}")
        before = self.table.cut_ids
        added = difference(cut.node_ids, before)
        removed = difference(before, cut.node_ids)
        index = self.table.search_index + 1
        table, change = self.table.updated(index, added, removed)
        payload, escapes = self._encoder.encode(change.needed)
        message = seal(
            DELTA_CUT,
            DeltaCut(
                search_index=index,
                frame=frame,
                reactivated=change.reactivated,
                removed=removed,
                payload=payload,
                state_hash=table.state_hash,
                codec_hash=self._encoder.codec.version,
            ).to_bytes(),
        )
        self.table, self.cut, self._frame = table, cut, frame
        self.stats = SearchStats(
            search_index=index,
            frame=frame,
            cut_size=len(cut),
            added=len(added),
            payloads=len(change.needed),
            reactivated=len(change.reactivated),
            removed=len(removed),
            evicted=len(change.evicted),
            held=len(table),
            escapes=escapes,
            message_bytes=len(message),
            payload_bytes=len(payload),
            nodes_tested=cut.nodes_tested,
            bytes_touched=cut.bytes_touched,
        )
        return message
