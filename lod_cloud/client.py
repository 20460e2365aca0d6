"""The client end of one session: applies messages, and selects what to draw. No sockets, no
rendering.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gaussians.scene import Scene
from lod_cloud.codec import PaperCodec
from lod_cloud.criterion import SearchRequest
from lod_cloud.cut import difference
from lod_cloud.delta_cut import DeltaCut, ManagementTable
from lod_cloud.lod_tree import Int32
from lod_cloud.node_records import NodeRecords
from lod_cloud.protocol import DELTA_CUT, SESSION_START, RemoteProtocolError, unseal
from lod_cloud.session import SessionStart
from lod_cloud.subgraph import LocalSubgraph


@dataclass(frozen=True)
class ReceiveStats:
    """One message, counted. A session start brings no nodes and has search index and frame -1."""

    search_index: int
    frame: int
    message_bytes: int
    payloads: int
    reactivated: int
    removed: int
    evicted: int
    held: int


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

    A message that is damaged, out of order, or leads to another state than the cloud's raises
    RemoteProtocolError and changes nothing.
    """

    def __init__(self) -> None:
        self.table: ManagementTable | None = None
        self.frame = -1  # of the newest search applied
        self._codec: PaperCodec | None = None
        self._subgraph = LocalSubgraph(0)
        self._newest: Selection | None = None
        self._nodes = 0

    def receive(self, message: bytes) -> ReceiveStats:
        """Apply the next message of the session."""
        kind, body = unseal(message)
        if kind == SESSION_START:
            return self._start(body, len(message))
        if kind == DELTA_CUT:
            return self._apply(DeltaCut.from_bytes(body), len(message))
        raise RemoteProtocolError(
            f"message kind must be {SESSION_START} or {DELTA_CUT}, not {kind}"
        )

    def select(self, request: SearchRequest) -> Selection:
        """The finest complete set at ``request``'s position; see `LocalSubgraph.choose`.

        The same set as last time comes with the same Scene, not copied again. Raises
        RemoteProtocolError before the first search result.
        """
        if self.table is None or len(self.table) == 0:
            raise RemoteProtocolError("nothing to draw: the first search result must arrive first")
        choice = self._subgraph.choose(self.table.in_cut, request)
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

    def _start(self, body: bytes, size: int) -> ReceiveStats:
        if self.table is not None:
            raise RemoteProtocolError("session start must come once, as the first message")
        start = SessionStart.from_bytes(body)
        self._codec, self._nodes = start.codec, start.nodes
        self._subgraph = LocalSubgraph(start.codec.sh_degree)
        self.table = ManagementTable.empty(start.frames_per_search, start.reuse_window_frames)
        return ReceiveStats(-1, -1, size, 0, 0, 0, 0, 0)

    def _apply(self, delta: DeltaCut, size: int) -> ReceiveStats:
        if self.table is None or self._codec is None:
            raise RemoteProtocolError("session start must come before any search result")
        expected = self.table.search_index + 1
        if delta.search_index != expected:
            raise RemoteProtocolError(f"search index must be {expected}, not {delta.search_index}")
        if delta.frame <= self.frame:
            raise RemoteProtocolError(f"frame must be above {self.frame}, not {delta.frame}")
        if delta.codec_hash != self._codec.version:
            raise RemoteProtocolError(
                f"codebook version must be {self._codec.version:#x}, not {delta.codec_hash:#x}"
            )
        arrived = self._codec.decode(delta.payload)
        if len(arrived) and arrived.ids[-1] >= self._nodes:
            raise RemoteProtocolError(f"node ids must be below {self._nodes}")
        evicted = self._apply_nodes(self.table, delta, arrived)
        return ReceiveStats(
            delta.search_index,
            delta.frame,
            size,
            len(arrived),
            len(delta.reactivated),
            len(delta.removed),
            evicted,
            len(self.table),
        )

    def _apply_nodes(self, before: ManagementTable, delta: DeltaCut, arrived: NodeRecords) -> int:
        """Move table and subgraph on; number of evicted nodes."""
        if len(difference(arrived.ids, delta.reactivated)) != len(arrived):
            raise RemoteProtocolError("no node may be both sent and re-activated")
        added = np.sort(np.concatenate([arrived.ids, delta.reactivated]))
        try:
            table, change = before.updated(delta.search_index, added, delta.removed)
        except ValueError as error:
            raise RemoteProtocolError(str(error)) from error
        if table.state_hash != delta.state_hash:
            raise RemoteProtocolError(
                f"search {delta.search_index}: state hash must be {delta.state_hash:#018x}, "
                f"not {table.state_hash:#018x}"
            )
        if not np.array_equal(change.needed, arrived.ids):
            raise RemoteProtocolError(
                f"search {delta.search_index}: must bring exactly what is new"
            )
        self._subgraph.apply(change, arrived)
        self.table, self.frame = table, delta.frame
        return len(change.evicted)
