"""What all codecs learn from a tree, and how their parameters travel."""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.codebook import Codebook
from gaussians.scene import Scene
from lod_cloud.columns import ColumnReader
from lod_cloud.lod_tree import Float32, Int32, LodTree
from lod_cloud.protocol import RemoteProtocolError

WHOLE_NODES = 1 << 20  # ranges of a tree up to this size are exact
RANGE_NODES = 1 << 14  # else they follow from so many nodes
CODEBOOK_NODES = 50_000
_OUTSIDE = 0.0001  # share of nodes left outside a range at either end
_RUN = 64  # nodes drawn together: a mapped tree is read in pages, not in nodes


@dataclass(frozen=True)
class Sample:
    """Nodes from which ranges follow."""

    ids: Int32
    scales: Float32  # [N, 3]
    opacities: Float32  # [N]
    dc: Float32  # [N, 3] harmonics of degree 0
    radius: Float32  # [N]
    extent: Float32  # [N]
    inner: NDArray[np.bool_]  # [N]

    @classmethod
    def of(cls, tree: LodTree, seed: int, *, coarsest: int = 0) -> Sample:
        """All nodes, or ``RANGE_NODES`` of more than ``WHOLE_NODES``, drawn with ``seed``, and the
        ``coarsest`` ones.
        """
        most = len(tree) if len(tree) <= WHOLE_NODES else RANGE_NODES
        drawn = _drawn(len(tree), most, np.random.default_rng([seed, 1]))
        ids = np.union1d(np.arange(min(coarsest, len(tree)), dtype=np.int32), drawn)
        scene = tree.gaussians
        return cls(
            ids,
            scene.scales[ids],
            scene.opacities[ids],
            scene.sh[ids, 0],
            tree.radius[ids],
            tree.extent[ids],
            tree.child_count[ids] > 0,
        )


def train_codebook(tree: LodTree, seed: int, words: int, stages: int) -> Codebook | None:
    """From at most ``CODEBOOK_NODES`` nodes drawn with ``seed``; None for SH degree 0."""
    if not tree.sh_degree:
        return None
    nodes = drawn_nodes(tree, seed)
    return Codebook.train(harmonics(tree.gaussians, nodes), words=words, stages=stages, seed=seed)


def drawn_nodes(tree: LodTree, seed: int) -> Int32:
    """At most ``CODEBOOK_NODES`` nodes, drawn with ``seed``; ascending."""
    return _drawn(len(tree), CODEBOOK_NODES, np.random.default_rng(seed))


def words_of(
    tree: LodTree, ids: Int32, codebook: Codebook | None
) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
    """Codebook words [N, stages] of nodes, and whether they are near enough."""
    if codebook is None:
        return np.empty((len(ids), 0), np.uint16), np.ones(len(ids), np.bool_)
    return codebook.encode(harmonics(tree.gaussians, ids))


def within(values: NDArray[Any]) -> NDArray[Any]:
    """The values [N] or [N, 3], those outside of nearly all clipped: what a range should cover.

    So one wild node costs itself bytes, and not everyone else precision.
    """
    if not len(values):
        return values
    low, high = np.quantile(values, [_OUTSIDE, 1 - _OUTSIDE], axis=0, method="nearest")
    return np.clip(values, low, high)


def harmonics(scene: Scene, ids: NDArray[np.integer]) -> Float32:
    """[N, 3 (K - 1)] coefficients above degree 0."""
    return scene.sh[ids, 1:].reshape(len(ids), 3 * (scene.sh.shape[1] - 1))


def _drawn(count: int, most: int, rng: np.random.Generator) -> Int32:
    """Ascending numbers below ``count``, all of them if they are at most ``most``, else runs."""
    if count <= most:
        return np.arange(count, dtype=np.int32)
    runs = np.sort(rng.choice(count // _RUN, most // _RUN, replace=False))
    return (runs[:, None] * _RUN + np.arange(_RUN)).reshape(-1).astype(np.int32)


# ---------------------------------------------------------------- parameters as bytes


def pack(parameters: dict[str, Any], codebook: Codebook | None) -> bytes:
    """Parameters that JSON knows, and the words of the codebook as float16."""
    books = codebook.stages if codebook else ()
    text = json.dumps(parameters | {"words": [len(book) for book in books]}).encode()
    words = b"".join(np.ascontiguousarray(book, "<f2").tobytes() for book in books)
    return struct.pack("<I", len(text)) + text + words


def unpack(data: bytes) -> tuple[dict[str, Any], Codebook | None]:
    """Inverse of `pack`. Raises RemoteProtocolError for anything it would not write."""
    reader = ColumnReader(data)
    try:
        parameters = json.loads(reader.raw(struct.unpack("<I", reader.raw(4))[0]))
        if parameters["sh_degree"] not in range(4):
            raise RemoteProtocolError("a codec's SH degree must be 0 to 3")
        dimensions = 3 * ((parameters["sh_degree"] + 1) ** 2 - 1)
        books = tuple(_words(reader, words, dimensions) for words in parameters["words"])
        reader.finish()
    except (KeyError, TypeError, ValueError) as error:
        raise RemoteProtocolError(f"codec parameters must be complete: {error}") from error
    return parameters, Codebook(books) if books else None


def _words(reader: ColumnReader, words: int, dimensions: int) -> NDArray[np.float16]:
    data = np.frombuffer(reader.raw(2 * words * dimensions), "<f2")
    return data.reshape(words, dimensions).astype(np.float16)


def check_words(words: NDArray[np.unsignedinteger], codebook: Codebook) -> None:
    """Raise RemoteProtocolError for words [N, stages] that no stage has."""
    for book, column in zip(codebook.stages, words.T, strict=True):
        if len(column) and column.max() >= len(book):
            raise RemoteProtocolError(f"codebook words must be below {len(book)}")


def version_of(data: bytes) -> int:
    """64-bit hash of a packed codec."""
    return int.from_bytes(hashlib.blake2b(data, digest_size=8).digest(), "little")
