"""Harmonics above degree 0 of some nodes: words of a codebook, float32 where no word is near.

They travel behind the other fields of a node, or later and alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gaussians.codebook import Codebook
from gaussians.compression import UInt16
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
    layout: Layout
    tables: Tables

    def encode(self, words: UInt16, near: Mask, exact: Float32, inner: Mask) -> Encoded:
        """See `HarmonicsCoder.encode`."""
        writer, pusher = ColumnWriter(), Pusher()
        writer.begin("escapes")
        self.write_far(writer, near, exact)
        self.push(pusher, words[near], inner[near])
        pusher.write(writer)
        self.write_low(writer, words[near])
        return Encoded(writer.bytes(), len(words), int(np.count_nonzero(~near)), writer.sizes)

    def decode(self, payload: bytes, inner: Mask) -> Float32:
        """See `HarmonicsCoder.decode`."""
        reader = ColumnReader(payload)
        above, near = self.read_far(reader, len(inner))
        puller = Puller(reader)
        values = self.pull(puller, inner[near])
        puller.finish()
        self.read_low(reader, values, above, near)
        reader.finish()
        return above.reshape(len(inner), self.codebook.dimensions // 3, 3)

    @staticmethod
    def write_far(writer: ColumnWriter, near: Mask, exact: Float32) -> None:
        """Nodes that no word is near."""
        writer.positions(np.flatnonzero(~near))
        writer.plain(exact)

    def read_far(self, reader: ColumnReader, count: int) -> tuple[Float32, Mask]:
        """[count, dimensions] numbers where nodes are not [count] near."""
        far = reader.positions(count)
        above = np.empty((count, self.codebook.dimensions), np.float32)
        above[far] = reader.plain(np.float32, len(far), self.codebook.dimensions).reshape(
            len(far), self.codebook.dimensions
        )
        near = np.ones(count, np.bool_)
        near[far] = False
        return above, near

    def push(self, pusher: Pusher, words: UInt16, inner: Mask) -> None:
        """Words of nodes, but what `write_low` does."""
        self.layout.harmonics(pushing(pusher, self.tables), inner, self.layout.high_parts(words))

    def pull(self, puller: Puller, inner: Mask) -> dict[str, Column]:
        """Inverse of `push`."""
        return self.layout.harmonics(pulling(puller, self.tables), inner, None)

    def write_low(self, writer: ColumnWriter, words: UInt16) -> None:
        """The lowest bits of long words."""
        writer.begin("harmonics")
        for column, (_, low) in zip(words.T, self.layout.words, strict=True):
            writer.bits(column, low)

    def read_low(
        self, reader: ColumnReader, values: Mapping[str, Column], above: Float32, near: Mask
    ) -> None:
        """The rows of ``above`` that are ``near``, by their columns."""
        count = int(near.sum())
        columns = [
            values[f"harmonics.{stage}"].astype(np.uint32) << low | reader.bits(count, low)
            for stage, (_, low) in enumerate(self.layout.words)
        ]
        words = np.stack(columns, axis=1)
        check_words(words, self.codebook)
        above[near] = self.codebook.decode(words.astype(np.uint16))
