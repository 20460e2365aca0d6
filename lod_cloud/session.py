"""What cloud and client agree on before the first search."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass

from lod_cloud.child_numbers import ChildNumbers
from lod_cloud.codec import Codec, read_codec
from lod_cloud.columns import ColumnReader
from lod_cloud.protocol import RemoteProtocolError


@dataclass(frozen=True)
class SessionStart:
    """Parameters of the management tables, the tree's numbering, the codec with its codebook."""

    session: int
    child_numbers: ChildNumbers
    frames_per_search: int
    reuse_window_frames: int
    codec: Codec

    def to_bytes(self) -> bytes:
        """Body of a message."""
        fields = {
            "session": self.session,
            "frames_per_search": self.frames_per_search,
            "reuse_window_frames": self.reuse_window_frames,
        }
        text = json.dumps(fields).encode()
        numbers = self.child_numbers.to_bytes()
        sizes = struct.pack("<II", len(text), len(numbers))
        return sizes + text + numbers + self.codec.to_bytes()

    @classmethod
    def from_bytes(cls, body: bytes) -> SessionStart:
        """Inverse of `to_bytes`. Raises RemoteProtocolError for anything it would not write."""
        reader = ColumnReader(body)
        text, numbers = struct.unpack("<II", reader.raw(8))
        try:
            fields = json.loads(reader.raw(text))
            known = ColumnReader(reader.raw(numbers))
            child_numbers = ChildNumbers.read(known)
            known.finish()
            return cls(codec=read_codec(reader.rest()), child_numbers=child_numbers, **fields)
        except (TypeError, ValueError) as error:
            raise RemoteProtocolError(f"session start must be complete: {error}") from error
