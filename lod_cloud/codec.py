"""The paper's coding of tree nodes (Sec. 4.3): 16-bit fixed point and a codebook for the harmonics.

Field, coding, largest error:

* mean: tile number and 16-bit offset per axis in a tile of at most 16 m; edge / 131072 per axis and
  the rounding to float32 (`PositionField.max_error`)
* scales: 16-bit logarithm over the tree's range, 0 exactly; factor `LogField.max_ratio` (0.01 % for
  a range of 10^5 : 1)
* rotation: smallest three, 3 x 16 bit and a 2-bit index; 8e-5 rad
* opacity o: 16 bit, companded by the square root, 0 to the tree's maximum; sqrt(o maximum) / 65535
  (`SquareRootField.max_error`)
* SH degree 0: 16 bit linear over the tree's range; range / 131070 (`LinearField.max_error`)
* SH above: words of a residual codebook; 1 per coefficient (typically 0.01 to 0.03)
* R, e: 16-bit logarithm, rounded up, interior nodes only; factor `LogField.max_ratio`
* id, parent, number of children: exact

A node with any value outside its field's range is sent as an *escape*: the whole node in float32,
exact, counted. Ranges are capped where real scenes end (opacity 64, colour -16..16), so that one
wild node costs itself bytes and not everyone else precision.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gaussians.codebook import Codebook
from gaussians.compression import (
    LinearField,
    LogField,
    PositionField,
    SquareRootField,
    UInt16,
    decode_rotation,
    encode_rotation,
)
from gaussians.constants import SH_C0
from gaussians.errors import InputError
from gaussians.scene import Scene
from lod_cloud.columns import ColumnReader, ColumnWriter
from lod_cloud.lod_tree import Float32, Int32, LodTree
from lod_cloud.node_records import NodeRecords, row_width, with_rows
from lod_cloud.protocol import RemoteProtocolError

TILE_LIMIT_M = 16.0  # 0.12 mm; measured 60-74 dB for the whole 16-bit set on real scenes
STEP_PER_SIGMA = 1 / 64  # position step at most this share of the median leaf's largest sigma
OPACITY_LIMIT = 64.0  # 44 is the largest merged opacity seen in real scenes
COLOUR_LIMIT = 16.0
SAMPLE_NODES = 50_000
_FAN_OUT_LIMIT = 65535
_COUNTS = struct.Struct("<II")  # nodes, escapes


@dataclass(frozen=True)
class PaperCodec:
    """Parameters and codebook of one session. Both ends hold an equal one; `version` proves it."""

    sh_degree: int
    position: PositionField
    scale: LogField
    opacity: SquareRootField
    dc: LinearField
    radius: LogField
    extent: LogField
    codebook: Codebook | None  # None exactly for SH degree 0

    @classmethod
    def train(cls, tree: LodTree, seed: int, *, words: int = 4096, stages: int = 1) -> PaperCodec:
        """Ranges from all nodes of ``tree``, codebook from at most 50 000 drawn with ``seed``.

        Raises InputError for a tree with more than 65535 children below one node.
        """
        scene = tree.gaussians
        if tree.child_count.max() > _FAN_OUT_LIMIT:
            raise InputError(f"a node must have at most {_FAN_OUT_LIMIT} children")
        inner = tree.child_count > 0
        opacity = min(OPACITY_LIMIT, float(scene.opacities.max()))
        codebook = None
        if tree.sh_degree:
            rng = np.random.default_rng(seed)
            nodes = rng.choice(len(tree), min(SAMPLE_NODES, len(tree)), replace=False)
            codebook = Codebook.train(
                _harmonics(scene, nodes), words=words, stages=stages, seed=seed
            )
        return cls(
            sh_degree=tree.sh_degree,
            position=PositionField(_tile_edge(tree)),
            scale=LogField.covering(scene.scales),
            opacity=SquareRootField(opacity if opacity > 0 else 1.0),
            dc=_colour_field(scene),
            radius=LogField.covering(tree.radius[inner], round_up=True),
            extent=LogField.covering(tree.extent[inner], round_up=True),
            codebook=codebook,
        )

    @cached_property
    def version(self) -> int:
        """64-bit hash of all parameters and the codebook."""
        return int.from_bytes(hashlib.blake2b(self.to_bytes(), digest_size=8).digest(), "little")

    @property
    def codebook_bytes(self) -> int:
        """Bytes of the codebook as it is sent, before zstd."""
        return self.codebook.size_bytes if self.codebook else 0

    def to_bytes(self) -> bytes:
        """Parameters and codebook, for `from_bytes`."""
        books = self.codebook.stages if self.codebook else ()
        parameters = {
            "codec": "paper",
            "sh_degree": self.sh_degree,
            "tile_m": self.position.tile_m,
            "scale": [self.scale.low, self.scale.high],
            "opacity": self.opacity.high,
            "dc": [self.dc.low, self.dc.high],
            "radius": [self.radius.low, self.radius.high],
            "extent": [self.extent.low, self.extent.high],
            "words": [len(book) for book in books],
        }
        text = json.dumps(parameters).encode()
        words = b"".join(np.ascontiguousarray(book, "<f2").tobytes() for book in books)
        return struct.pack("<I", len(text)) + text + words

    @classmethod
    def from_bytes(cls, data: bytes) -> PaperCodec:
        """Inverse of `to_bytes`. Raises RemoteProtocolError for anything it would not write."""
        reader = ColumnReader(data)
        try:
            p = json.loads(reader.raw(struct.unpack("<I", reader.raw(4))[0]))
            if p["codec"] != "paper" or p["sh_degree"] not in range(4):
                raise RemoteProtocolError("codec must be 'paper' with SH degree 0 to 3")
            books = tuple(_read_words(reader, words, p["sh_degree"]) for words in p["words"])
            reader.finish()
            return cls(
                sh_degree=p["sh_degree"],
                position=PositionField(p["tile_m"]),
                scale=LogField(*p["scale"]),
                opacity=SquareRootField(p["opacity"]),
                dc=LinearField(*p["dc"]),
                radius=LogField(p["radius"][0], p["radius"][1], True),
                extent=LogField(p["extent"][0], p["extent"][1], True),
                codebook=Codebook(books) if books else None,
            )
        except (KeyError, TypeError, ValueError) as error:
            raise RemoteProtocolError(f"codec parameters must be complete: {error}") from error

    def assign_words(self, tree: LodTree, ids: Int32) -> tuple[UInt16, NDArray[np.bool_]]:
        """Codebook words [N, stages] of nodes, and whether they are near enough; costly."""
        if self.codebook is None:
            return np.empty((len(ids), 0), np.uint16), np.ones(len(ids), np.bool_)
        return self.codebook.encode(_harmonics(tree.gaussians, ids))

    def encode(
        self,
        nodes: NodeRecords,
        words: UInt16,
        words_valid: NDArray[np.bool_],
        *,
        places: bool = True,
    ) -> tuple[bytes, int]:
        """Payload of these nodes with their words (see `assign_words`); bytes and number of
        escapes. Without ``places`` ids and parents are left out: the client knows them.
        """
        scene = nodes.gaussians
        tile, offset, valid = self.position.encode(scene.means)
        scale, scale_valid = self.scale.encode(scene.scales)
        opacity, opacity_valid = self.opacity.encode(scene.opacities)
        dc, dc_valid = self.dc.encode(scene.sh[:, 0])
        radius, radius_valid = self.radius.encode(nodes.radius)
        extent, extent_valid = self.extent.encode(nodes.extent)
        valid = valid & words_valid & opacity_valid & radius_valid & extent_valid
        valid &= scale_valid.all(axis=1) & dc_valid.all(axis=1)
        largest, rotation = encode_rotation(scene.quaternions)
        escaped = np.flatnonzero(~valid).astype(np.int32)
        inner = valid & (nodes.child_counts > 0)
        writer = ColumnWriter()
        writer.raw(_COUNTS.pack(len(nodes), len(escaped)))
        if places:
            writer.differences(nodes.ids)
            writer.differences(nodes.parents)
        writer.plain(nodes.child_counts.astype(np.uint16))
        writer.differences(escaped)
        writer.differences(tile[valid])
        for codes in (offset, scale, rotation, opacity, dc):
            writer.plain(codes[valid])
        if self.codebook:
            writer.plain(words[valid].astype(self.codebook.index_type))
        writer.raw(_packed_pairs(largest[valid]))
        writer.plain(radius[inner])
        writer.plain(extent[inner])
        writer.plain(nodes.float32_rows(escaped))
        return writer.bytes(), len(escaped)

    def decode(self, payload: bytes, places: tuple[Int32, Int32] | None = None) -> NodeRecords:
        """Inverse of `encode`, given ids and parents where these were left out.

        Raises RemoteProtocolError for anything it would not write.
        """
        reader = ColumnReader(payload)
        count, escapes = _COUNTS.unpack(reader.raw(_COUNTS.size))
        if places is None:
            ids = reader.differences(np.int32, count)
            parents = reader.differences(np.int32, count)
        else:
            ids, parents = places
            if len(ids) != count:
                raise RemoteProtocolError(f"payload must have {len(ids)} nodes, not {count}")
        child_counts = reader.plain(np.uint16, count).astype(np.int32)
        escaped = reader.differences(np.int32, escapes)
        _check_escapes(escaped, count)
        coded = np.ones(count, np.bool_)
        coded[escaped] = False
        inner = child_counts[coded] > 0
        gaussians = self._decode_scene(reader, count - escapes)
        spheres = np.zeros((count - escapes, 2), np.float32)
        for column, field in enumerate((self.radius, self.extent)):
            spheres[inner, column] = field.decode(reader.plain(np.uint16, int(inner.sum())))
        rows = reader.plain(np.float32, escapes, row_width(self.sh_degree))
        reader.finish()
        structure = (ids, parents, child_counts)
        return with_rows(structure, spheres, gaussians, escaped, rows).check()

    def _decode_scene(self, reader: ColumnReader, count: int) -> Scene:
        stages = len(self.codebook.stages) if self.codebook else 0
        tile = reader.differences(np.int16, count, 3)
        offset, scale, rotation = (reader.plain(np.uint16, count, 3) for _ in range(3))
        opacity = reader.plain(np.uint16, count)
        dc = reader.plain(np.uint16, count, 3)
        words = np.empty((count, 0), np.uint16)
        if self.codebook:
            words = reader.plain(self.codebook.index_type, count, stages).reshape(count, stages)
        largest = _unpacked_pairs(reader.raw((count + 3) // 4), count)
        sh = np.empty((count, (self.sh_degree + 1) ** 2, 3), np.float32)
        sh[:, 0] = self.dc.decode(dc)
        if self.codebook:
            for book, column in zip(self.codebook.stages, words.T, strict=True):
                if count and column.max() >= len(book):
                    raise RemoteProtocolError(f"codebook words must be below {len(book)}")
            sh[:, 1:] = self.codebook.decode(words).reshape(count, sh.shape[1] - 1, 3)
        return Scene(
            self.position.decode(tile, offset),
            decode_rotation(largest, rotation),
            self.scale.decode(scale),
            self.opacity.decode(opacity),
            sh,
        )


def _colour_field(scene: Scene) -> LinearField:
    """Range of the SH coefficients of degree 0, within the colours of ``COLOUR_LIMIT``."""
    limit = COLOUR_LIMIT / float(SH_C0)
    low = max(-limit, float(scene.sh[:, 0].min()))
    high = min(limit, float(scene.sh[:, 0].max()))
    return LinearField(low, high) if low < high else LinearField(-limit, limit)


def _tile_edge(tree: LodTree) -> float:
    """Largest power of two <= 16 m whose step suits the leaves (points: the size of the scene)."""
    leaves = tree.child_count == 0
    reference = float(np.median(tree.gaussians.scales[leaves].max(axis=1)))
    if not reference > 0:
        low, high = np.array(tree.metadata.bounds)
        reference = float((high - low).max()) / 1024
    if not reference > 0:
        return TILE_LIMIT_M
    wanted = reference * STEP_PER_SIGMA * 65536
    return float(2.0 ** max(-100, min(4, math.floor(math.log2(wanted)))))


def _harmonics(scene: Scene, ids: NDArray[np.integer]) -> Float32:
    """[N, 3 (K - 1)] coefficients above degree 0."""
    return scene.sh[ids, 1:].reshape(len(ids), 3 * (scene.sh.shape[1] - 1))


def _read_words(reader: ColumnReader, words: int, sh_degree: int) -> NDArray[np.float16]:
    dimensions = 3 * ((sh_degree + 1) ** 2 - 1)
    data = np.frombuffer(reader.raw(2 * words * dimensions), "<f2")
    return data.reshape(words, dimensions).astype(np.float16)


def _check_escapes(escaped: Int32, count: int) -> None:
    wide = escaped.astype(np.int64)
    if (wide < 0).any() or (wide >= count).any() or (np.diff(wide) <= 0).any():
        raise RemoteProtocolError(f"escapes must ascend and be below {count}")


def _packed_pairs(values: NDArray[np.uint8]) -> bytes:
    """Four 2-bit numbers per byte."""
    padded = np.zeros(-(-len(values) // 4) * 4, np.uint8)
    padded[: len(values)] = values
    quads = padded.reshape(-1, 4)
    return (quads[:, 0] | quads[:, 1] << 2 | quads[:, 2] << 4 | quads[:, 3] << 6).tobytes()


def _unpacked_pairs(data: bytes, count: int) -> NDArray[np.uint8]:
    packed = np.frombuffer(data, np.uint8)
    return np.stack([packed >> shift & 3 for shift in (0, 2, 4, 6)], axis=1).reshape(-1)[:count]
