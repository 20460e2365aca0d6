"""A compact coding of tree nodes: half the bytes of the paper's, and less for what is collapsed.

Field, coding, largest error:

* mean: a whole number of steps per axis, of which only the lowest bits travel; half a step. The
  step is the power of two at most 2^-`position.bits` times the node's coded largest standard
  deviation
* scales: the largest of the three in an 8-bit logarithm over the tree's range, the others as 8-bit
  logarithms of their ratio to it, 2^-12 to 1 (what is smaller is coded as 0); `LogField.max_ratio`
* rotation: smallest three, 3 x 8 bit and a 2-bit index, of the axes ordered by scale; 0.02 rad
* opacity: 8-bit logarithm over the tree's range, 0 exactly
* SH degree 0: `colour_bits` each, linear over the tree's range
* SH above: words of a residual codebook; 1 per coefficient
* R, e of interior nodes: 4-bit logarithm, rounded up, of their ratio to what follows from the
  decoded scales
* id, parent, number of children: exact

The decoded value of a node does not depend on what the client was sent before, although positions
are coded relative to what it holds (`lod_cloud.codec.positions`) and it may have merged that itself
(`lod_cloud.codec.tolerance`). A node whose decoded value would be off by more than that relies on,
or that is outside a range, is an *escape*: float32, exact, counted.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gaussians.codebook import Codebook
from gaussians.compression import (
    LinearField,
    LogField,
    UInt16,
    decode_rotation,
    encode_rotation,
)
from gaussians.errors import InputError
from gaussians.scene import Scene
from lod_cloud.codec.axes import sorted_axes
from lod_cloud.codec.interface import Encoded, References
from lod_cloud.codec.positions import PositionSteps
from lod_cloud.codec.shapes import BYTE, ShapeFields, surface
from lod_cloud.codec.tolerance import CODED_MASS_ERROR, merge_tolerance
from lod_cloud.codec.training import (
    Sample,
    check_words,
    harmonics,
    pack,
    train_codebook,
    version_of,
    within,
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

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

RULE = "opacity x surface"  # by which a tree says that its interior nodes are merges
_OPACITY_LOW = np.float32(2.0**-12)
_COLOUR_MARGIN = 0.125  # of the sampled range at either end: fewer escapes for 2 dB of 61
_MOST_COLOUR_BITS = 16


@dataclass(frozen=True)
class CompactCodec:
    """Parameters and codebook of one session. Both ends hold an equal one; `version` proves it."""

    sh_degree: int
    merge_levels: int  # of a tree whose interior nodes are merges; 0 of any other
    position: PositionSteps
    shape: ShapeFields
    opacity: LogField
    dc: LinearField
    codebook: Codebook | None  # None exactly for SH degree 0

    def __post_init__(self) -> None:
        if not 1 <= self.dc.top < 1 << _MOST_COLOUR_BITS:
            raise InputError(f"colour bits must be 1 to {_MOST_COLOUR_BITS}")

    @classmethod
    def train(
        cls,
        tree: LodTree,
        seed: int,
        *,
        words: int = 256,
        stages: int = 2,
        position_bits: int = 6,
        colour_bits: int = 7,
    ) -> CompactCodec:
        """Ranges and codebook from nodes of ``tree``, drawn with ``seed`` where it is large.

        Clients merge collapsed nodes where the tree's metadata say that its interior nodes are
        merges.
        """
        sample = Sample.of(tree, seed)
        merges = tree.metadata.build.get("merge") == RULE
        dc = within(sample.dc)
        low, high = float(dc.min()), float(dc.max())
        margin = _COLOUR_MARGIN * (high - low) if high > low else 1.0
        opacities = np.maximum(within(sample.opacities), _OPACITY_LOW)
        return cls(
            sh_degree=tree.sh_degree,
            merge_levels=tree.levels if merges else 0,
            position=PositionSteps(position_bits),
            shape=ShapeFields.train(sample.scales, sample.inner, sample.radius, sample.extent),
            opacity=LogField.covering(opacities, top=BYTE),
            dc=LinearField(low - margin, high + margin, (1 << colour_bits) - 1),
            codebook=train_codebook(tree, seed, words, stages),
        )

    @property
    def merges(self) -> bool:
        """Whether clients merge the children of collapsed nodes."""
        return self.merge_levels > 0

    @property
    def relative(self) -> bool:
        """Positions are."""
        return True

    @cached_property
    def version(self) -> int:
        """64-bit hash of all parameters and the codebook."""
        return version_of(self.to_bytes())

    @property
    def codebook_bytes(self) -> int:
        """Bytes of the codebook as it is sent, before zstd."""
        return self.codebook.size_bytes if self.codebook else 0

    @property
    def tolerance(self) -> float:
        """Largest error per axis of the mean of a node that a client holds, in the node's largest
        standard deviation.
        """
        return merge_tolerance(self.position.max_error, self.merge_levels)

    def to_bytes(self) -> bytes:
        """Parameters and codebook, for `lod_cloud.codec.read_codec`."""
        parameters = {
            "codec": "compact",
            "sh_degree": self.sh_degree,
            "merge_levels": self.merge_levels,
            "position_bits": self.position.bits,
            "shape": self.shape.ranges,
            "opacity": [self.opacity.low, self.opacity.high],
            "dc": [self.dc.low, self.dc.high, self.dc.top],
        }
        return pack(parameters, self.codebook)

    @classmethod
    def from_parameters(cls, p: dict[str, Any], codebook: Codebook | None) -> CompactCodec:
        """Inverse of `to_bytes`, for `lod_cloud.codec.read_codec`, which words the errors."""
        return cls(
            sh_degree=p["sh_degree"],
            merge_levels=int(p["merge_levels"]),
            position=PositionSteps(int(p["position_bits"])),
            shape=ShapeFields.of(p["shape"]),
            opacity=LogField(p["opacity"][0], p["opacity"][1], top=BYTE),
            dc=LinearField(*p["dc"]),
            codebook=codebook,
        )

    def assign_words(self, tree: LodTree, ids: Int32) -> tuple[UInt16, Mask]:
        """Codebook words [N, stages] of nodes, and whether they are near enough; costly."""
        if self.codebook is None:
            return np.empty((len(ids), 0), np.uint16), np.ones(len(ids), np.bool_)
        return self.codebook.encode(harmonics(tree.gaussians, ids))

    # ------------------------------------------------------------ encoding

    def encode(
        self,
        nodes: NodeRecords,
        words: UInt16,
        near: Mask,
        *,
        places: bool,
        references: References | None = None,
    ) -> Encoded:
        """See `Codec.encode`."""
        codes, exact = self._codes(nodes)
        kept = np.flatnonzero(~exact)
        inner = nodes.child_counts > 0
        writer = ColumnWriter()
        nodes.write_places(writer, places=places)
        writer.begin("child counts")
        writer.bits(inner, 1)
        writer.integers(nodes.child_counts[inner])
        writer.begin("escapes")
        writer.positions(np.flatnonzero(exact))
        writer.plain(nodes.float32_rows(np.flatnonzero(exact), coefficients=1))
        writer.positions(np.flatnonzero(~near))
        writer.plain(harmonics(nodes.gaussians, np.flatnonzero(~near)))
        writer.begin("position")
        self.position.write(
            writer,
            codes.places[kept],
            codes.sigmas[kept, 0],
            references.take(kept) if references else None,
            self.tolerance,
        )
        for name, column in (("scale", codes.shape), ("rotation", codes.rotation)):
            writer.begin(name)
            writer.plain(column[kept].astype(np.uint8))
        writer.bits(codes.omitted[kept], 2)
        writer.begin("opacity")
        writer.plain(codes.opacity[kept].astype(np.uint8))
        writer.begin("colour")
        writer.bits(codes.dc[kept].T, self.dc.top.bit_length())
        writer.begin("harmonics")
        for book, column in zip(self._books, words[near].T, strict=True):
            writer.bits(column, _bits(book))
        writer.begin("spheres")
        writer.bits(codes.spheres[kept][inner[kept]], 4)
        escapes = int(np.count_nonzero(exact | ~near))
        return Encoded(writer.bytes(), len(nodes), escapes, writer.sizes)

    def _codes(self, nodes: NodeRecords) -> tuple[_Codes, Mask]:
        """Codes of every node, and which nodes they do not stand for well enough."""
        scene = nodes.gaussians
        scales, quaternions = sorted_axes(scene.scales, scene.quaternions)
        shape, in_range = self.shape.encode(scales)
        sigmas = self.shape.decode(shape)
        places, placed = self.position.encode(scene.means, sigmas[:, 0])
        opacity, fits = self.opacity.encode(scene.opacities)
        dc, dc_fits = self.dc.encode(scene.sh[:, 0])
        spheres, wrapped = self.shape.encode_spheres(sigmas, nodes.radius, nodes.extent)
        omitted, rotation = encode_rotation(quaternions.astype(np.float32), BYTE)
        off = np.abs(self.position.decode(places, sigmas[:, 0]).astype(np.float64) - scene.means)
        mass = scene.opacities * surface(scales)
        lost = np.abs(self.opacity.decode(opacity) * surface(sigmas) - mass)
        valid = in_range & placed & fits & dc_fits.all(axis=1)
        valid &= wrapped | (nodes.child_counts == 0)
        valid &= (off <= self.position.max_error * scales[:, :1]).all(axis=1)
        valid &= lost <= CODED_MASS_ERROR * mass
        return _Codes(places, shape, omitted, rotation, opacity, dc, spheres, sigmas), ~valid

    # ------------------------------------------------------------ decoding

    def decode(
        self,
        payload: bytes,
        places: tuple[Int32, Int32] | None = None,
        references: Float32 | None = None,
    ) -> NodeRecords:
        """See `Codec.decode`."""
        reader = ColumnReader(payload)
        ids, parents = read_places(reader, places)
        count = len(ids)
        inner = reader.bits(count, 1).astype(np.bool_)
        child_counts = np.zeros(count, np.int32)
        child_counts[inner] = read_child_counts(reader, int(inner.sum()))
        exact = reader.positions(count)
        rows = reader.plain(np.float32, len(exact), row_width(0))
        far = reader.positions(count)
        width = 3 * ((self.sh_degree + 1) ** 2 - 1)
        above = np.empty((count, width), np.float32)
        above[far] = reader.plain(np.float32, len(far), width).reshape(len(far), width)
        coded = np.ones(count, np.bool_)
        coded[exact] = False
        near = None if references is None else references[coded]
        gaussians = self._read_gaussians(reader, int(coded.sum()), near)
        self._read_harmonics(reader, above, far)
        spheres = np.zeros((len(gaussians), 2), np.float32)
        below = inner[coded]
        sigmas = gaussians.scales[below].astype(np.float64)
        spheres[below] = self.shape.read_spheres(reader, sigmas)
        reader.finish()
        records = with_rows((ids, parents, child_counts), spheres, gaussians, exact, rows)
        sh = np.concatenate([records.gaussians.sh, above.reshape(count, width // 3, 3)], axis=1)
        whole = dataclasses.replace(records.gaussians, sh=sh)
        return dataclasses.replace(records, gaussians=whole).check()

    def _read_gaussians(
        self, reader: ColumnReader, count: int, references: Float32 | None
    ) -> Scene:
        """Of SH degree 0."""
        lowest = self.position.read(reader, count)
        shape = reader.plain(np.uint8, count, 3).astype(np.uint16)
        rotation = reader.plain(np.uint8, count, 3).astype(np.uint16)
        omitted = reader.bits(count, 2).astype(np.uint8)
        opacity = reader.plain(np.uint8, count).astype(np.uint16)
        dc = reader.bits(3 * count, self.dc.top.bit_length()).reshape(3, count).T
        sigmas = self.shape.decode(shape)
        places = self.position.nearest(lowest, sigmas[:, 0], references)
        return Scene(
            self.position.decode(places, sigmas[:, 0]),
            decode_rotation(omitted, rotation, BYTE),
            sigmas.astype(np.float32),
            self.opacity.decode(opacity),
            self.dc.decode(dc.astype(np.uint16))[:, None],
        )

    def _read_harmonics(self, reader: ColumnReader, above: Float32, far: Int64) -> None:
        """The rows of ``above`` that are not ``far``."""
        if self.codebook:
            others = np.ones(len(above), np.bool_)
            others[far] = False
            count = int(others.sum())
            words = np.stack([reader.bits(count, _bits(book)) for book in self._books], axis=1)
            check_words(words, self.codebook)
            above[others] = self.codebook.decode(words.astype(np.uint16))

    @property
    def _books(self) -> tuple[NDArray[np.float16], ...]:
        return self.codebook.stages if self.codebook else ()


def _bits(book: NDArray[np.float16]) -> int:
    """Of a word's number."""
    return (len(book) - 1).bit_length()


@dataclass(frozen=True)
class _Codes:
    """What may be sent of some nodes."""

    places: Int64  # [N, 3]
    shape: UInt16  # [N, 3]
    omitted: NDArray[np.uint8]  # [N]
    rotation: UInt16  # [N, 3]
    opacity: UInt16  # [N]
    dc: UInt16  # [N, 3]
    spheres: UInt16  # [N, 2]
    sigmas: Float64  # [N, 3] as they will be decoded
