"""What cloud and client agree on before the first search."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass

from lod_cloud.codec import PaperCodec
from lod_cloud.columns import ColumnReader
from lod_cloud.protocol import RemoteProtocolError


@dataclass(frozen=True)
class SessionStart:
    """Parameters of the management tables, and the codec with its codebook."""

    session: int
    nodes: int
    frames_per_search: int
    reuse_window_frames: int
    codec: PaperCodec

    def to_bytes(self) -> bytes:
        """Body of a message."""
        fields = {
            "session": self.session,
            "nodes": self.nodes,
            "frames_per_search": self.frames_per_search,
            "reuse_window_frames": self.reuse_window_frames,
        }
        text = json.dumps(fields).encode()
        return struct.pack("<I", len(text)) + text + self.codec.to_bytes()

    @classmethod
    def from_bytes(cls, body: bytes) -> SessionStart:
        """Inverse of `to_bytes`. Raises RemoteProtocolError for anything it would not write."""
        reader = ColumnReader(body)
        size = struct.unpack("<I", reader.raw(4))[0]
        try:
            fields = json.loads(reader.raw(size))
            return cls(codec=PaperCodec.from_bytes(body[4 + size :]), **fields)
        except (TypeError, ValueError) as error:
            raise RemoteProtocolError(f"session start must be complete: {error}") from error
