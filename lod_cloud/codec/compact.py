"""A compact coding of tree nodes: half the bytes of the paper's, and less for what is collapsed.

Field, coding, largest error:

* mean: a whole number of steps per axis, of which only the lowest bits travel; half a step. The
  step is the power of two at most 2^-`position.bits` times the node's coded largest standard
  deviation
* scales: the largest of the three as a logarithm over the tree's range, the others as 8-bit
  logarithms of their ratio to it, 2^-12 to 1 (what is smaller is coded as 0); `LogField.max_ratio`
* rotation: smallest three, 3 x 6 bit and a 2-bit index, of the axes ordered by scale; 0.09 rad
* opacity: logarithm over the tree's range, 0 exactly
* SH degree 0: `colour_bits` each, linear over the tree's range
* SH above: words of a residual codebook; 1 per coefficient. Of leaves also what these leave over,
  in even steps; half a step
* R, e of interior nodes: 4-bit logarithm, rounded up, of their ratio to what follows from the
  decoded scales
* id, parent, number of children: exact

All but the lowest bits of positions (and of long words) goes through an entropy coder with the
frequencies of the tree, `lod_cloud.codec.node_columns`.

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
from gaussians.compression import UInt16
from gaussians.errors import InputError
from lod_cloud.codec.harmonic_rests import HarmonicRests
from lod_cloud.codec.harmonic_words import HarmonicWords
from lod_cloud.codec.interface import Encoded, Neighbours, References
from lod_cloud.codec.node_columns import Layout, Rows
from lod_cloud.codec.node_fields import NodeFields
from lod_cloud.codec.node_tables import Tables, count_tables, layout_of, pulling, pushing
from lod_cloud.codec.rans import Frequencies, Puller, Pusher
from lod_cloud.codec.tolerance import merge_tolerance
from lod_cloud.codec.training import (
    Sample,
    drawn_nodes,
    harmonics,
    pack,
    train_codebook,
    version_of,
    words_of,
)
from lod_cloud.columns import ColumnReader, ColumnWriter
from lod_cloud.lod_tree import Int32, LodTree
from lod_cloud.node_records import (
    NodeRecords,
    read_child_counts,
    read_places,
    row_width,
    with_rows,
)

Mask = NDArray[np.bool_]

RULE = "opacity x surface"  # by which a tree says that its interior nodes are merges
_COARSEST_NODES = 1 << 14  # which every client gets first: none of them should be an escape


@dataclass(frozen=True)
class CompactCodec:
    """Parameters, codebook and frequencies of one session. Both ends hold an equal one; `version`
    proves it. Raises InputError for frequencies that do not fit the other two.
    """

    sh_degree: int
    merge_levels: int  # of a tree whose interior nodes are merges; 0 of any other
    fields: NodeFields
    codebook: Codebook | None  # None exactly for SH degree 0
    rests: HarmonicRests | None  # likewise
    tables: Tables  # by the keys of `lod_cloud.codec.node_columns`

    def __post_init__(self) -> None:
        for key, shape in self.layout.shapes().items():
            if key not in self.tables or self.tables[key].table.shape != shape:
                contexts, symbols = shape
                raise InputError(f"frequencies of {key} must be {contexts} x {symbols}")

    @classmethod
    def train(
        cls,
        tree: LodTree,
        seed: int,
        *,
        words: int = 512,
        stages: int = 2,
        position_bits: int = 6,
        colour_bits: int = 7,
    ) -> CompactCodec:
        """Ranges, codebook and frequencies from nodes of ``tree``, drawn with ``seed`` where it is
        large.

        Clients merge collapsed nodes where the tree's metadata say that its interior nodes are
        merges.
        """
        sample = Sample.of(tree, seed, coarsest=_COARSEST_NODES)
        fields = NodeFields.train(sample, position_bits, colour_bits)
        codebook = train_codebook(tree, seed, words, stages)
        levels = tree.levels if tree.metadata.build.get("merge") == RULE else 0
        tolerance = merge_tolerance(fields.position.max_error, levels)
        drawn = drawn_nodes(tree, seed)
        more = HarmonicRests.train(tree, drawn, codebook) if codebook else None
        tables = count_tables(tree, drawn, fields, codebook, more, tolerance)
        return cls(tree.sh_degree, levels, fields, codebook, more, tables)

    @cached_property
    def layout(self) -> Layout:
        """The columns of a payload."""
        return layout_of(self.fields, self.codebook)

    @cached_property
    def apart(self) -> HarmonicWords | None:
        """How harmonics above degree 0 travel alone; None without any."""
        if self.codebook is None or self.rests is None:
            return None
        return HarmonicWords(self.codebook, self.rests, self.layout, self.tables)

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
        """64-bit hash of all parameters, frequencies and the codebook."""
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
        return merge_tolerance(self.fields.position.max_error, self.merge_levels)

    def to_bytes(self) -> bytes:
        """Parameters, frequencies and codebook, for `lod_cloud.codec.read_codec`."""
        parameters = {
            "codec": "compact",
            "sh_degree": self.sh_degree,
            "merge_levels": self.merge_levels,
            **self.fields.parameters,
            "harmonic_step": self.rests.step if self.rests else None,
            "frequencies": {key: found.table.tolist() for key, found in self.tables.items()},
        }
        return pack(parameters, self.codebook)

    @classmethod
    def from_parameters(cls, p: dict[str, Any], codebook: Codebook | None) -> CompactCodec:
        """Inverse of `to_bytes`, for `lod_cloud.codec.read_codec`, which words the errors."""
        fields = NodeFields.of(p)
        keys = layout_of(fields, codebook).shapes()
        tables = {key: Frequencies.of(p["frequencies"][key]) for key in keys}
        rests = HarmonicRests(p["harmonic_step"]) if codebook else None
        return cls(p["sh_degree"], int(p["merge_levels"]), fields, codebook, rests, tables)

    def assign_words(self, tree: LodTree, ids: Int32) -> tuple[UInt16, Mask]:
        """Codebook words [N, stages] of nodes, and whether they are near enough, which they are of
        no leaf; costly.
        """
        words, near = words_of(tree, ids, self.codebook)
        return words, near & (tree.child_count[ids] > 0) if self.codebook else near

    # ------------------------------------------------------------ encoding

    def encode(
        self,
        nodes: NodeRecords,
        words: UInt16,
        near: Mask,
        *,
        places: bool,
        references: References | None = None,
        plain: bool = False,
    ) -> Encoded:
        """See `Codec.encode`."""
        codes, exact = self.fields.encode(nodes)
        kept, inner = ~exact, nodes.child_counts > 0
        where = codes.places[kept], codes.sigmas[kept, 0]
        held = references.take(np.flatnonzero(kept)) if references else None
        choices = self.fields.position.choose(*where, held, self.tolerance)
        writer = ColumnWriter()
        nodes.write_places(writer, places=places)
        writer.begin("child counts")
        writer.bits(inner, 1)
        writer.integers(nodes.child_counts[inner])
        writer.begin("escapes")
        writer.positions(np.flatnonzero(exact))
        writer.plain(nodes.float32_rows(np.flatnonzero(exact), coefficients=1))
        above = None if plain else self.apart
        if above:
            numbers = harmonics(nodes.gaussians, np.flatnonzero(~near))
            told = above.write_far(writer, words, near, numbers, inner)
        rows, pusher = (
            Rows.of(inner, nodes.parents, references.ids if references else None),
            Pusher(),
        )
        given = codes.columns(kept, inner, self.layout.colours) | {"position": choices}
        self.layout.fields(pushing(pusher, self.tables), rows.take(kept), given)
        if above:
            above.push(pusher, words[told.by_words], inner[told.by_words], told)
        pusher.write(writer)
        writer.begin("position")
        self.fields.position.write(writer, where[0], choices)
        if above:
            above.write_low(writer, words[told.by_words])
            exact |= ~told.by_words
        escapes = int(np.count_nonzero(exact))
        return Encoded(writer.bytes(), len(nodes), escapes, writer.sizes)

    # ------------------------------------------------------------ decoding

    def decode(
        self,
        payload: bytes,
        places: tuple[Int32, Int32] | None = None,
        references: Neighbours | None = None,
        *,
        plain: bool = False,
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
        kept = np.ones(count, np.bool_)
        kept[exact] = False
        sh = np.zeros((count, (self.sh_degree + 1) ** 2, 3), np.float32)
        above = None if plain else self.apart
        if above:
            numbers, by_words = above.read_far(reader, count)
        known, puller = (
            Rows.of(inner, parents, references.ids if references else None),
            Puller(reader),
        )
        values = self.layout.fields(pulling(puller, self.tables), known.take(kept), None)
        words = above.pull(puller, inner[by_words]) if above else {}
        puller.finish()
        sigmas = self.fields.sigmas(values)
        choices = values["position"].astype(np.int64)
        held = None if references is None else references.means[kept]
        whole = self.fields.position.read(reader, choices, sigmas[:, 0], held)
        gaussians = self.fields.decode(values, sigmas, whole)
        if above:
            numbers[by_words] = above.read_low(reader, words, inner[by_words])
            sh[:, 1:] = numbers.reshape(sh[:, 1:].shape)
        reader.finish()
        spheres = np.zeros((len(gaussians), 2), np.float32)
        spheres[inner[kept]] = self.fields.spheres(values, sigmas[inner[kept]])
        records = with_rows((ids, parents, child_counts), spheres, gaussians, exact, rows)
        sh[:, :1] = records.gaussians.sh
        scene = dataclasses.replace(records.gaussians, sh=sh)
        return dataclasses.replace(records, gaussians=scene)
