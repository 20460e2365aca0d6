"""The line between cloud and client: when a message arrives and what receiving it costs. Pure
model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from gaussians.errors import InputError


@dataclass(frozen=True)
class Link:
    """A line of fixed rate that sends one message after the other and loses none.

    Sources: rate 100 Mbps (10^6 bit/s) and radio energy 100 nJ/B from the paper, Sec. 6; the
    paper gives no latency: 5 ms one way is an assumption (local wireless network).
    """

    rate_mbps: float = 100.0
    latency_ms: float = 5.0
    energy_nj_per_byte: float = 100.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate_mbps) and self.rate_mbps > 0):
            raise InputError(f"link rate must be a positive number of Mbps, not {self.rate_mbps}")
        for name in ("latency_ms", "energy_nj_per_byte"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise InputError(f"link {name} must be a finite number >= 0, not {value}")

    def transmission_s(self, size_bytes: int) -> float:
        """Seconds for which a message occupies the line."""
        return size_bytes * 8e-6 / self.rate_mbps

    def bytes_in(self, duration_s: float) -> int:
        """Whole bytes that leave within so many seconds."""
        return int(duration_s * self.rate_mbps * 1e6 / 8)

    def energy_mj(self, size_bytes: int) -> float:
        """Millijoules of the client's radio for receiving so many bytes."""
        return size_bytes * self.energy_nj_per_byte * 1e-6


class Transmission:
    """Messages on one `Link` in the order they were handed over: the next starts when one has
    left.
    """

    def __init__(self, link: Link) -> None:
        self.link = link
        self.size_bytes = 0  # handed over so far
        self._free_at_s = -math.inf
        self._last_sent_at_s = -math.inf

    def delivery_time_s(self, sent_at_s: float, size_bytes: int) -> float:
        """When the last byte of a message handed over at ``sent_at_s`` arrives. Call in order of
        time.
        """
        if size_bytes < 0 or not math.isfinite(sent_at_s):
            raise InputError(
                f"message must have >= 0 bytes and a finite time, not {size_bytes} at {sent_at_s} s"
            )
        if sent_at_s < self._last_sent_at_s:
            raise InputError(
                f"messages must be sent in order: {sent_at_s} s is before {self._last_sent_at_s} s"
            )
        self._last_sent_at_s = sent_at_s
        start = max(sent_at_s, self._free_at_s)
        self._free_at_s = start + self.link.transmission_s(size_bytes)
        self.size_bytes += size_bytes
        return self._free_at_s + self.link.latency_ms * 1e-3
