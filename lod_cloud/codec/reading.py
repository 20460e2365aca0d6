"""Which codec a session start names."""

from __future__ import annotations

from lod_cloud.codec.compact import CompactCodec
from lod_cloud.codec.interface import Codec
from lod_cloud.codec.paper import PaperCodec
from lod_cloud.codec.training import unpack
from lod_cloud.protocol import RemoteProtocolError


def read_codec(data: bytes) -> Codec:
    """Inverse of `Codec.to_bytes`. Raises RemoteProtocolError for anything it would not write."""
    parameters, codebook = unpack(data)
    known: dict[object, type[CompactCodec] | type[PaperCodec]] = {
        "compact": CompactCodec,
        "paper": PaperCodec,
    }
    kind = known.get(parameters.get("codec"))
    if kind is None:
        raise RemoteProtocolError(f"codec must be one of {', '.join(sorted(map(str, known)))}")
    try:
        return kind.from_parameters(parameters, codebook)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise RemoteProtocolError(f"codec parameters must be complete: {error}") from error
