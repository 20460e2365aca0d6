"""What the client did in a frame before projection: receive, decode, keep, select."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from gaussians.errors import InputError


@dataclass(frozen=True)
class ClientWork:
    """Counts of one frame of the client's subgraph; all integers >= 0.

    Raises InputError when a count is negative, when more splats are selected than held, or when
    more payloads are escaped than decoded.
    """

    held_splats: int  # records in the client's subgraph; every header is walked
    selected_splats: int  # of these, selected by level of detail at this pose
    decoded_splats: int  # new payloads decoded in this frame
    escaped_splats: int  # of these, sent as plain float32 attributes instead of codes
    evicted_splats: int  # records removed by the reuse window in this frame
    received_bytes: int  # bytes of the messages that arrived for this frame

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 0:
                raise InputError(
                    f"client work: {field.name} must be an integer of at least 0, not {value!r}"
                )
        if self.selected_splats > self.held_splats:
            raise InputError(
                f"client work: selected_splats must be at most held_splats ({self.held_splats}), "
                f"not {self.selected_splats}"
            )
        if self.escaped_splats > self.decoded_splats:
            raise InputError(
                f"client work: escaped_splats must be at most decoded_splats "
                f"({self.decoded_splats}), not {self.escaped_splats}"
            )
