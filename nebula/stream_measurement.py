"""A session over a modelled line, played without a display: what was sent, when it arrived, and
what the client held by then.

Time is the model's: the client sends its pose and its report at every search, one latency later
the cloud has both, its answer is ready after the computing time given, and leaves when the line is
free. The CPU time that search and coding took on this machine stands beside it.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from gaussians.errors import InputError
from lod_cloud import Client, Cloud, Link, RemoteProtocolError, SearchRequest, SearchStats
from lod_cloud.link import Transmission

FIRST_PICTURES_PX = (120.0, 60.0, 30.0, 15.0)  # and the tau asked for


@dataclass(frozen=True)
class Faults:
    """What happens to messages, each by itself, either way, as shares of all of them."""

    loss: float = 0.0
    reorder: float = 0.0  # comes one search later than it should
    corruption: float = 0.0  # one bit is another

    def __post_init__(self) -> None:
        for name, share in vars(self).items():
            if not 0 <= share <= 1:
                raise InputError(f"the share of {name} must lie in 0..1, not {share}")


@dataclass(frozen=True)
class _Arrival:
    at_s: float
    message: bytes


class Player:
    """Cloud and client of one session, and the line from the one to the other.

    ``compute_s`` is the cloud's time from a pose to its answer.
    """

    def __init__(
        self,
        cloud: Cloud,
        link: Link,
        interval_s: float,
        compute_s: float,
        *,
        faults: Faults | None = None,
        seed: int = 0,
    ) -> None:
        self.cloud, self.client = cloud, Client()
        self.rows: list[dict[str, Any]] = []  # one per search
        self.reports_lost = self.refused = 0
        self._interval_s, self._compute_s = interval_s, compute_s
        self._link, self._line = link, Transmission(link)
        self._faults, self._rng = faults or Faults(), np.random.default_rng(seed)
        self._underway: list[_Arrival] = []
        start = cloud.session_start()
        self.client.receive(start)  # before anything else, over a line that loses nothing
        self.codebook_bytes = len(start)

    def play(self, request: SearchRequest) -> None:
        """The next pose: one search, one message."""
        now_s = len(self.rows) * self._interval_s
        self._arrive_until(now_s)
        self._report()
        begin = time.process_time()
        message = self.cloud.search(request, len(self.rows) * self.cloud.table.frames_per_search)
        cloud_cpu_ms = 1e3 * (time.process_time() - begin)
        ready_s = now_s + self._link.latency_ms * 1e-3 + self._compute_s
        arrives_s = self._line.delivery_time_s(ready_s, len(message))
        lost = self._happens(self._faults.loss)
        assert self.cloud.stats is not None
        row = self._row(self.cloud.stats, now_s, arrives_s)
        self.rows.append(row | {"cloud_cpu_ms": cloud_cpu_ms, "lost": lost})
        if not lost:
            late_s = self._interval_s if self._happens(self._faults.reorder) else 0.0
            self._underway.append(_Arrival(arrives_s + late_s, self._damaged(message)))

    def finish(self) -> None:
        """What is still underway arrives."""
        self._arrive_until(math.inf)

    def _row(self, stats: SearchStats, now_s: float, arrives_s: float) -> dict[str, Any]:
        error = stats.pending_error_px
        return vars(stats) | {
            "pending_error_px": error if math.isfinite(error) else None,
            "asked_s": now_s,
            "arrives_s": arrives_s,
            "behind": self.cloud.sequence - self.client.applied,
        }

    def _report(self) -> None:
        if self._happens(self._faults.loss):
            self.reports_lost += 1
            return
        try:
            self.cloud.receive(self._damaged(self.client.report()))
        except RemoteProtocolError:
            self.refused += 1

    def _arrive_until(self, now_s: float) -> None:
        self._underway.sort(key=lambda a: a.at_s)
        while self._underway and self._underway[0].at_s <= now_s:
            message = self._underway.pop(0).message
            try:
                self.client.receive(message)
            except RemoteProtocolError:
                self.refused += 1

    def _damaged(self, message: bytes) -> bytes:
        if not self._happens(self._faults.corruption):
            return message
        data = bytearray(message)
        data[self._rng.integers(len(data))] ^= 1 << int(self._rng.integers(8))
        return bytes(data)

    def _happens(self, share: float) -> bool:
        return share > 0 and self._rng.random() < share


def first_pictures(
    rows: list[dict[str, Any]], link: Link, tau_px: float, *, before_bytes: int = 0
) -> list[dict[str, Any]]:
    """When the client's cut was complete at falling tau, from the first of ``rows`` on.

    Per tau: messages, bytes (``before_bytes`` first) and nodes until then, seconds of the line
    alone, and seconds from the request to the last byte, with latency both ways and the cloud's
    time. None where it never was.
    """
    begin_s = rows[0]["asked_s"]
    found = []
    for tau in (*(t for t in FIRST_PICTURES_PX if t > tau_px), tau_px):
        size, nodes, picture = before_bytes, 0, None
        for count, row in enumerate(rows, 1):
            size += row["message_bytes"]
            nodes += row["payloads"]
            error = row["pending_error_px"]
            if error is not None and max(error, row["tau_px"]) <= tau:
                picture = {
                    "messages": count,
                    "bytes": size,
                    "nodes": nodes,
                    "line_s": link.transmission_s(size),
                    "complete_s": row["arrives_s"] - begin_s + link.transmission_s(before_bytes),
                }
                break
        found.append({"tau_px": tau, **(picture or dict.fromkeys(_PICTURE))})
    return found


_PICTURE = ("messages", "bytes", "nodes", "line_s", "complete_s")
