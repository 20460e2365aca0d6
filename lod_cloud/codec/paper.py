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

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

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
from gaussians.scene import Scene
from lod_cloud.codec.interface import Encoded, Neighbours, References
from lod_cloud.codec.training import (
    Sample,
    check_words,
    pack,
    train_codebook,
    version_of,
    words_of,
)
from lod_cloud.columns import ColumnReader, ColumnWriter
from lod_cloud.lod_tree import Float32, Int32, LodTree
from lod_cloud.node_records import (
    NodeRecords,
    read_child_counts,
    read_places,
    row_width,
    with_rows,
)

TILE_LIMIT_M = 16.0  # 0.12 mm; measured 60-74 dB for the whole 16-bit set on real scenes
STEP_PER_SIGMA = 1 / 64  # position step at most this share of the median leaf's largest sigma
OPACITY_LIMIT = 64.0  # 44 is the largest merged opacity seen in real scenes
COLOUR_LIMIT = 16.0


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
        """Ranges and codebook from nodes of ``tree``, drawn with ``seed`` where it is large."""
        sample = Sample.of(tree, seed)
        opacity = min(OPACITY_LIMIT, float(sample.opacities.max()))
        return cls(
            sh_degree=tree.sh_degree,
            position=PositionField(_tile_edge(tree, sample)),
            scale=LogField.covering(sample.scales),
            opacity=SquareRootField(opacity if opacity > 0 else 1.0),
            dc=_colour_field(sample.dc),
            radius=LogField.covering(sample.radius[sample.inner], round_up=True),
            extent=LogField.covering(sample.extent[sample.inner], round_up=True),
            codebook=train_codebook(tree, seed, words, stages),
        )

    @property
    def apart(self) -> None:
        """The paper's coding is one word per node: nothing is sent without it."""
        return None

    @property
    def merges(self) -> bool:
        """Everything is sent."""
        return False

    @property
    def relative(self) -> bool:
        """Every node stands for itself."""
        return False

    @cached_property
    def version(self) -> int:
        """64-bit hash of all parameters and the codebook."""
        return version_of(self.to_bytes())

    @property
    def codebook_bytes(self) -> int:
        """Bytes of the codebook as it is sent, before zstd."""
        return self.codebook.size_bytes if self.codebook else 0

    def to_bytes(self) -> bytes:
        """Parameters and codebook, for `lod_cloud.codec.read_codec`."""
        parameters = {
            "codec": "paper",
            "sh_degree": self.sh_degree,
            "tile_m": self.position.tile_m,
            "scale": [self.scale.low, self.scale.high],
            "opacity": self.opacity.high,
            "dc": [self.dc.low, self.dc.high],
            "radius": [self.radius.low, self.radius.high],
            "extent": [self.extent.low, self.extent.high],
        }
        return pack(parameters, self.codebook)

    @classmethod
    def from_parameters(cls, p: dict[str, Any], codebook: Codebook | None) -> PaperCodec:
        """Inverse of `to_bytes`, for `lod_cloud.codec.read_codec`, which words the errors."""
        return cls(
            sh_degree=p["sh_degree"],
            position=PositionField(p["tile_m"]),
            scale=LogField(*p["scale"]),
            opacity=SquareRootField(p["opacity"]),
            dc=LinearField(*p["dc"]),
            radius=LogField(p["radius"][0], p["radius"][1], True),
            extent=LogField(p["extent"][0], p["extent"][1], True),
            codebook=codebook,
        )

    def assign_words(self, tree: LodTree, ids: Int32) -> tuple[UInt16, NDArray[np.bool_]]:
        """Codebook words [N, stages] of nodes, and whether they are near enough; costly."""
        return words_of(tree, ids, self.codebook)

    def encode(
        self,
        nodes: NodeRecords,
        words: UInt16,
        near: NDArray[np.bool_],
        *,
        places: bool,
        references: References | None = None,
        plain: bool = False,
    ) -> Encoded:
        """See `Codec.encode`; references are not looked at, and nothing is ever plain."""
        scene = nodes.gaussians
        tile, offset, valid = self.position.encode(scene.means)
        scale, scale_valid = self.scale.encode(scene.scales)
        opacity, opacity_valid = self.opacity.encode(scene.opacities)
        dc, dc_valid = self.dc.encode(scene.sh[:, 0])
        radius, radius_valid = self.radius.encode(nodes.radius)
        extent, extent_valid = self.extent.encode(nodes.extent)
        valid = valid & near & opacity_valid & radius_valid & extent_valid
        valid &= scale_valid.all(axis=1) & dc_valid.all(axis=1)
        largest, rotation = encode_rotation(scene.quaternions)
        escaped = np.flatnonzero(~valid).astype(np.int32)
        inner = valid & (nodes.child_counts > 0)
        writer = ColumnWriter()
        nodes.write_places(writer, places=places)
        writer.begin("child counts")
        writer.integers(nodes.child_counts)
        writer.begin("escapes")
        writer.positions(escaped)
        writer.plain(nodes.float32_rows(escaped))
        writer.begin("position")
        writer.differences(tile[valid])
        named = {"position": offset, "scale": scale, "opacity": opacity, "colour": dc}
        for name, codes in (named | {"rotation": rotation}).items():
            writer.begin(name)
            writer.plain(codes[valid])
        writer.bits(largest[valid], 2)
        writer.begin("harmonics")
        if self.codebook:
            writer.plain(words[valid].astype(self.codebook.index_type))
        writer.begin("spheres")
        writer.plain(radius[inner])
        writer.plain(extent[inner])
        return Encoded(writer.bytes(), len(nodes), len(escaped), writer.sizes)

    def decode(
        self,
        payload: bytes,
        places: tuple[Int32, Int32] | None = None,
        references: Neighbours | None = None,
        *,
        plain: bool = False,
    ) -> NodeRecords:
        """See `Codec.decode`; references are not looked at, and nothing is ever plain."""
        reader = ColumnReader(payload)
        ids, parents = read_places(reader, places)
        count = len(ids)
        child_counts = read_child_counts(reader, count)
        escaped = reader.positions(count)
        rows = reader.plain(np.float32, len(escaped), row_width(self.sh_degree))
        coded = np.ones(count, np.bool_)
        coded[escaped] = False
        inner = child_counts[coded] > 0
        others = count - len(escaped)
        gaussians = self._decode_scene(reader, others)
        spheres = np.zeros((others, 2), np.float32)
        for column, field in enumerate((self.radius, self.extent)):
            spheres[inner, column] = field.decode(reader.plain(np.uint16, int(inner.sum())))
        reader.finish()
        structure = (ids, parents, child_counts)
        return with_rows(structure, spheres, gaussians, escaped, rows)

    def _decode_scene(self, reader: ColumnReader, count: int) -> Scene:
        tile = reader.differences(np.int16, count, 3)
        offset, scale = (reader.plain(np.uint16, count, 3) for _ in range(2))
        opacity = reader.plain(np.uint16, count)
        dc, rotation = (reader.plain(np.uint16, count, 3) for _ in range(2))
        largest = reader.bits(count, 2).astype(np.uint8)
        sh = np.empty((count, (self.sh_degree + 1) ** 2, 3), np.float32)
        sh[:, 0] = self.dc.decode(dc)
        if self.codebook:
            stages = len(self.codebook.stages)
            words = reader.plain(self.codebook.index_type, count, stages).reshape(count, stages)
            check_words(words, self.codebook)
            sh[:, 1:] = self.codebook.decode(words).reshape(count, sh.shape[1] - 1, 3)
        return Scene(
            self.position.decode(tile, offset),
            decode_rotation(largest, rotation),
            self.scale.decode(scale),
            self.opacity.decode(opacity),
            sh,
        )


def _colour_field(dc: Float32) -> LinearField:
    """Range of the SH coefficients of degree 0, within the colours of ``COLOUR_LIMIT``."""
    limit = COLOUR_LIMIT / float(SH_C0)
    low, high = max(-limit, float(dc.min())), min(limit, float(dc.max()))
    return LinearField(low, high) if low < high else LinearField(-limit, limit)


def _tile_edge(tree: LodTree, sample: Sample) -> float:
    """Largest power of two <= 16 m whose step suits the leaves (points: the size of the scene)."""
    reference = float(np.median(sample.scales[~sample.inner].max(axis=1)))
    if not reference > 0:
        low, high = np.array(tree.metadata.bounds)
        reference = float((high - low).max()) / 1024
    if not reference > 0:
        return TILE_LIMIT_M
    wanted = reference * STEP_PER_SIGMA * 65536
    return float(2.0 ** max(-100, min(4, math.floor(math.log2(wanted)))))
