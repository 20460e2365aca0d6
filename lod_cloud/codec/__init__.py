"""How tree nodes travel: the paper's coding, and a compact one that needs half the bytes."""

from lod_cloud.codec.compact import CompactCodec
from lod_cloud.codec.interface import NOTHING_CODED, Codec, Encoded, Neighbours, References
from lod_cloud.codec.paper import PaperCodec
from lod_cloud.codec.reading import read_codec

__all__ = [
    "NOTHING_CODED",
    "Codec",
    "CompactCodec",
    "Encoded",
    "Neighbours",
    "PaperCodec",
    "References",
    "read_codec",
]
