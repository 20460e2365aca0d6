"""What the cloud says of every search and its message."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

MessageKind = Literal["start", "step", "repair", "probe"]


@dataclass(frozen=True)
class SearchStats:
    """One search and its message, counted."""

    kind: MessageKind
    search_index: int
    frame: int
    tau_px: float  # in effect; above the one asked for while rate control raises it
    cut_size: int  # of the cut the search found
    found: int  # in that cut and not in the one found before
    added: int  # in the client's cut now, not before; payloads + merged + reactivated (step)
    payloads: int  # nodes sent
    plain: int  # of them: without harmonics above degree 0
    completed: int  # nodes sent plain before that got theirs
    merged: int  # nodes that the client computes from their children instead
    reactivated: int  # nodes named because the client still holds them
    removed: int  # in the client's cut before the message, not after
    evicted: int  # nodes whose reuse window is over
    held: int  # nodes the client holds after the message
    pending: int  # nodes of the cut found that the client's cut lacks after the message
    pending_error_px: float  # the tau the client's cut is complete at, if above `tau_px`; 0 if not
    pending_harmonics: int  # nodes of the client's cut that it holds plain
    deferred_bytes: int  # what the pending nodes are expected to take
    escapes: int  # payloads sent in float32
    message_bytes: int  # on the line
    payload_bytes: int  # of the nodes sent, before zstd
    nodes_tested: int
    bytes_touched: int
