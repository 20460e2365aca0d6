"""The codecs a stream is measured with."""

from __future__ import annotations

from lod_cloud import LodTree
from lod_cloud.codec import Codec
from nebula.progress import progress
from nebula.session_config import load_session_config
from nebula.stream import make_codec

CODECS = ("paper", "compact")


def train_codecs(tree: LodTree, seed: int) -> dict[str, Codec]:
    """Every codec by name, trained on the tree with its size of codebook in configs/session."""
    config = load_session_config()
    codecs: dict[str, Codec] = {}
    with progress("training codebooks", len(CODECS)) as step:
        for name in CODECS:
            codecs[name] = make_codec(name, tree, seed, config)
            step()
    return codecs
