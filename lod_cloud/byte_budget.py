"""Messages that fit into a number of bytes, by what the messages before them took."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from gaussians.errors import InputError
from lod_cloud.criterion import SearchRequest
from lod_cloud.message_writer import Draft
from lod_cloud.pacing import Limit, Portion
from lod_cloud.search_stats import SearchStats

RAISED_TAU_PX = 30.0  # below it a larger tau saves no bytes on real scenes
_FULL = 0.9  # share of the budget that is worth no further attempt
_MARGIN = 0.97  # aimed at, so that the next message of the same kind fits
_ATTEMPTS = 3  # to fill a message that fits
_SCALE_LIMIT = 64.0
_LEAST = 0.25  # bytes of anything; neighbouring ids nearly vanish in the entropy coder


class ByteBudget:
    """The most bytes of a message. Raises InputError unless it is at least 1.

    How many bytes a node and an id take is learnt; a message found too large is written again with
    fewer events, until it fits or cannot be smaller.
    """

    def __init__(self, size: int) -> None:
        if size < 1:
            raise InputError(f"the byte budget must be at least 1 B, not {size}")
        self.size = size
        self.per_node, self.per_id = 32.0, 2.0  # before anything was sent
        self.per_completed = 8.0  # bytes of a node's harmonics
        self.raised = False  # whether the newest request was for a larger tau than asked for
        self._scale = 1.0  # of what both say

    def request(self, request: SearchRequest, last: SearchStats | None) -> SearchRequest:
        """What to search for, after the message ``last`` (None before the first).

        At the start, and when the client's cut is complete at no tau up to twice `RAISED_TAU_PX`,
        that tau takes the place of a smaller one until the client has all that it asks for: what
        is finer cannot be sent before, so searching for it would only take time.
        """
        raised = last is not None and last.tau_px >= RAISED_TAU_PX
        near_enough = 0.0 if raised else 2 * RAISED_TAU_PX
        behind = last is None or last.pending_error_px > near_enough
        self.raised = behind and request.tau_px < RAISED_TAU_PX
        return replace(request, tau_px=RAISED_TAU_PX) if self.raised else request

    def may_fit(self, nodes: int) -> bool:
        """Whether a message about so many nodes is worth writing at a venture."""
        return nodes * self.per_node < 2 * self.size

    def fit(
        self, choose: Callable[[Limit], Portion], write: Callable[[Portion], Draft], least: int
    ) -> Draft:
        """The fullest draft found that has no more than `size` bytes, else the one of no more than
        ``least`` events (what ``choose`` gives for a limit of 0 bytes).
        """
        best: Draft | None = None
        if least == 0:  # what the message says in any case
            best = write(choose(self._limit(0.0)))
            if len(best.message) >= self.size:
                return best
        scale, attempts, before = self._scale, 0, -1
        while True:
            draft = write(choose(self._limit(scale * self.size)))
            filled = len(draft.message) / self.size
            explained = self._learn(draft)
            events = len(draft.portion.expanded) + len(draft.portion.collapsed)
            if filled <= 1:
                attempts += 1
                if best is None or len(draft.message) >= len(best.message):
                    best = draft
                same = events == before  # more is not to be had
                if draft.portion.last or same or filled >= _FULL or attempts == _ATTEMPTS:
                    break
            elif events <= least:
                best = best or draft
                break
            elif attempts:
                break
            before = events
            scale *= _MARGIN / (filled * explained)
        self._scale = min(max(scale, 1 / _SCALE_LIMIT), _SCALE_LIMIT)
        assert best is not None
        return best

    def fill(self, draft: Draft, write: Callable[[int], Draft], waiting: int) -> Draft:
        """``draft``, or one that says the same and completes as many of the nodes ``waiting`` for
        their harmonics as fit; at least one if it says nothing else.
        """
        best, room = draft, self.size - len(draft.message)
        for _ in range(_ATTEMPTS if waiting else 0):
            count = min(waiting, int(_MARGIN * room / self.per_completed))
            if count <= 0:
                break
            fuller = write(count)
            more = len(fuller.message) - len(draft.message)
            self.per_completed = max(_LEAST, more / count)
            if more <= room and len(fuller.message) > len(best.message):
                best = fuller
            if more <= room and (count == waiting or more >= _FULL * room):
                break
        silent = not draft.added and not draft.portion.collapsed.size
        return write(1) if waiting and silent and best is draft else best

    def _limit(self, size: float) -> Limit:
        return Limit(size, self.per_node + self.per_id, self.per_id)

    def _learn(self, draft: Draft) -> float:
        """By how much fewer nodes will be chosen because of what this draft has shown."""
        before = self.per_node + self.per_id
        ids = len(draft.portion.expanded) + len(draft.portion.collapsed)
        if draft.payloads and ids:
            self.per_node = draft.payload_bytes / draft.payloads
            others = (len(draft.message) - draft.payload_bytes) / ids
            self.per_id = max(_LEAST, others)
        return before / (self.per_node + self.per_id)
