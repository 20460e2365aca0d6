"""Harmonics above degree 0 of some nodes: words of a codebook, of leaves with what these leave over
(`lod_cloud.codec.harmonic_rests`), float32 where neither is near.

They travel behind the other fields of a node, or later and alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.codebook import Codebook
from gaussians.compression import UInt16
from lod_cloud.codec.harmonic_rests import HarmonicRests, Told
from lod_cloud.codec.interface import Encoded
from lod_cloud.codec.node_columns import Column, Layout
from lod_cloud.codec.node_tables import Tables, pulling, pushing
from lod_cloud.codec.rans import Puller, Pusher
from lod_cloud.codec.training import check_words
from lod_cloud.columns import ColumnReader, ColumnWriter
from lod_cloud.lod_tree import Float32

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class HarmonicWords:
    """How they are coded in one session."""

    codebook: Codebook
    rests: HarmonicRests
    layout: Layout
    tables: Tables

    def encode(self, words: UInt16, near: Mask, exact: Float32, inner: Mask) -> Encoded:
        """See `HarmonicsCoder.encode`."""
        writer, pusher = ColumnWriter(), Pusher()
        writer.begin("escapes")
        told = self.write_far(writer, words, near, exact, inner)
        self.push(pusher, words[told.by_words], inner[told.by_words], told)
        pusher.write(writer)
        self.write_low(writer, words[told.by_words])
        escapes = int(np.count_nonzero(~told.by_words))
        return Encoded(writer.bytes(), len(words), escapes, writer.sizes)

    def decode(self, payload: bytes, inner: Mask) -> Float32:
        """See `HarmonicsCoder.decode`."""
        reader = ColumnReader(payload)
        above, by_words = self.read_far(reader, len(inner))
        puller = Puller(reader)
        values = self.pull(puller, inner[by_words])
        puller.finish()
        above[by_words] = self.read_low(reader, values, inner[by_words])
        reader.finish()
        return above.reshape(len(inner), self.codebook.dimensions // 3, 3)

    def write_far(
        self, writer: ColumnWriter, words: UInt16, near: Mask, exact: Float32, inner: Mask
    ) -> Told:
        """Nodes that are not told by words; how they all are."""
        told = self.rests.told(self.codebook, words, near, exact, inner)
        writer.positions(np.flatnonzero(~told.by_words))
        writer.plain(exact[~told.by_words[~near]])
        return told

    def read_far(self, reader: ColumnReader, count: int) -> tuple[Float32, Mask]:
        """[count, dimensions] numbers where nodes are not [count] told by words."""
        far, dimensions = reader.positions(count), self.codebook.dimensions
        above = np.empty((count, dimensions), np.float32)
        above[far] = reader.plain(np.float32, len(far), dimensions).reshape(len(far), dimensions)
        by_words = np.ones(count, np.bool_)
        by_words[far] = False
        return above, by_words

    def push(self, pusher: Pusher, words: UInt16, inner: Mask, told: Told) -> None:
        """Words of nodes, but what `write_low` does, and rests."""
        given = self.layout.high_parts(words) | {"harmonics.rest": told.rests.reshape(-1)}
        self.layout.harmonics(pushing(pusher, self.tables), inner, given)

    def pull(self, puller: Puller, inner: Mask) -> dict[str, Column]:
        """Inverse of `push`."""
        return self.layout.harmonics(pulling(puller, self.tables), inner, None)

    def write_low(self, writer: ColumnWriter, words: UInt16) -> None:
        """The lowest bits of long words."""
        writer.begin("harmonics")
        for column, (_, low) in zip(words.T, self.layout.words, strict=True):
            writer.bits(column, low)

    def read_low(self, reader: ColumnReader, values: Mapping[str, Column], inner: Mask) -> Float32:
        """[N, dimensions] coefficients of nodes told by words, by their columns."""
        columns = [
            values[f"harmonics.{stage}"].astype(np.uint32) << low | reader.bits(len(inner), low)
            for stage, (_, low) in enumerate(self.layout.words)
        ]
        words = np.stack(columns, axis=1)
        check_words(words, self.codebook)
        above = self.codebook.decode(words.astype(np.uint16))
        rests = values["harmonics.rest"].reshape(-1, self.codebook.dimensions)
        above[~inner] += self.rests.left_over(rests)
        return above
