"""Cloud, link and client in step with the display's clock (Fig. 10).

Frame i is shown at i / rate seconds. Every w frames the client sends its pose; the answer arrives
one uplink latency, the cloud's computing time, the transmission and one downlink latency later,
and is applied at the first frame after that. Until then the client goes on with what it holds. With
each pose the client says how far it is.
The first cut is delivered before frame 0: its time is the start-up time, not part of the trace.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass

from arch import ClientWork
from lod_cloud import (
    Client,
    Cloud,
    Link,
    LodTree,
    PaperCodec,
    SearchRequest,
    SearchStats,
    SearchTree,
    Selection,
    make_search,
)
from lod_cloud.link import Transmission
from nebula.session_config import SessionConfig


@dataclass(frozen=True)
class StartUp:
    """Before the first frame."""

    codebook_bytes: int
    initial_bytes: int
    initial_ms: float  # from sending the first pose to the last byte of the first cut
    payloads: int


@dataclass(frozen=True)
class ClientFrame:
    """What the client draws in one frame and what reached it before."""

    selection: Selection
    work: ClientWork
    searched: bool  # the cloud searched for this frame's pose
    received_bytes: int


@dataclass(frozen=True)
class _Underway:
    arrives_s: float
    message: bytes
    stats: SearchStats


class Session:
    """One client and its cloud over one link. Owns both ends and the messages between them.

    ``paced``: a message has at most the bytes that the link carries between two searches; the
    client's cut may then lag behind the one found.
    """

    def __init__(
        self,
        tree: LodTree,
        codec: PaperCodec,
        config: SessionConfig,
        link: Link,
        search_every: int,
        *,
        paced: bool = False,
    ) -> None:
        interval_s = search_every / config.display_rate.hz
        self.budget_bytes = link.bytes_in(interval_s) if paced else None
        lod = config.search
        self.method = lod.method
        self._lod = make_search(lod.method, SearchTree.of(tree), hysteresis=lod.hysteresis)
        self.cloud = Cloud(
            tree,
            codec,
            search=self._lod,
            frames_per_search=search_every,
            reuse_window_frames=config.reuse_window.frames,
            budget_bytes=self.budget_bytes,
        )
        self.client = Client()
        self.searches: list[SearchStats] = []
        self.search_ms: list[float] = []  # measured here, without coding
        self._config = config
        self._link = link
        self._line = Transmission(link)
        self._underway: deque[_Underway] = deque()
        self._search_every = search_every

    def start(self, request: SearchRequest) -> StartUp:
        """Bring the client to the first cut, or, paced, to the coarse one that comes first."""
        header = self.cloud.session_start()
        self.client.receive(header)
        message = self._search(request, 0)
        received = self.client.receive(message)
        size = len(header) + len(message)
        arrives = Transmission(self._link).delivery_time_s(self._answered_s(0.0), size)
        return StartUp(len(header), len(message), arrives * 1e3, received.payloads)

    def frame(self, index: int, request: SearchRequest) -> ClientFrame:
        """Advance to frame ``index`` (0, 1, 2, ... in order) with the client's pose there."""
        now_s = index / self._config.display_rate.hz
        searched = index % self._search_every == 0
        if searched and index > 0:
            message = self._search(request, index)
            arrives = self._line.delivery_time_s(self._answered_s(now_s), len(message))
            self._underway.append(_Underway(arrives, message, self.searches[-1]))
        received_bytes = decoded = escaped = evicted = 0
        while self._underway and self._underway[0].arrives_s <= now_s:
            arrived = self._underway.popleft()
            received = self.client.receive(arrived.message)
            received_bytes += received.message_bytes
            decoded += received.payloads
            evicted += received.evicted
            escaped += arrived.stats.escapes
        selection = self.client.select(request)
        work = ClientWork(
            held_splats=selection.held,
            selected_splats=len(selection.node_ids),
            decoded_splats=decoded,
            escaped_splats=escaped,
            evicted_splats=evicted,
            received_bytes=received_bytes,
        )
        return ClientFrame(selection, work, searched, received_bytes)

    def _answered_s(self, pose_s: float) -> float:
        """When the cloud's answer to a pose is ready to be sent."""
        return pose_s + 1e-3 * (self._link.latency_ms + self._config.cloud.compute_ms)

    def _search(self, request: SearchRequest, frame: int) -> bytes:
        self.cloud.receive(self.client.report())
        asked = self.cloud.asked(request)
        begin = time.perf_counter()
        found = self._lod.search(asked)
        self.search_ms.append(1e3 * (time.perf_counter() - begin))
        message = self.cloud.answer(found, asked, frame)
        assert self.cloud.stats is not None
        self.searches.append(self.cloud.stats)
        return message
