"""What cloud and client ask of a codec."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gaussians.codebook import Codebook
from lod_cloud.lod_tree import Float32, Int32, LodTree
from lod_cloud.node_records import NodeRecords

UInt16 = NDArray[np.uint16]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Neighbours:
    """For each node to be coded, one that the client holds already: as the client has it."""

    ids: Int32  # [N]
    means: Float32  # [N, 3]


@dataclass(frozen=True)
class References(Neighbours):
    """The same as the tree has it."""

    sigmas: Float32  # [N] largest standard deviation

    def take(self, rows: NDArray[np.integer]) -> References:
        """Those of some of the nodes."""
        return References(self.ids[rows], self.means[rows], self.sigmas[rows])


@dataclass(frozen=True)
class Encoded:
    """Coded nodes."""

    payload: bytes
    sent: int  # nodes in it
    escapes: int  # of them: some field is float32, exact
    columns: dict[str, int]  # bytes of the payload by kind of field


NOTHING_CODED = Encoded(b"", 0, 0, {})


class HarmonicsCoder(Protocol):
    """How nodes that a client holds *plain*, without harmonics above degree 0, are completed."""

    def encode(self, words: UInt16, near: Mask, exact: Float32, inner: Mask) -> Encoded:
        """Payload of nodes that are known but for their harmonics: ``words`` [N, stages] where they
        are ``near``, else ``exact`` [far, dimensions]. ``inner``: which are not leaves.
        """

    def decode(self, payload: bytes, inner: Mask) -> Float32:
        """[N, K - 1, 3] coefficients. Raises RemoteProtocolError for anything `encode` would not
        write.
        """


class Codec(Protocol):
    """Parameters and codebook of one session. Both ends hold an equal one; `version` proves it.

    The decoded value of a node depends on the codec, on the node and on whether its harmonics are
    there, not on what the client was sent before.
    """

    @property
    def sh_degree(self) -> int:
        """Of every node."""

    @property
    def apart(self) -> HarmonicsCoder | None:
        """How harmonics above degree 0 travel alone; None: a node comes with them or has none."""

    @property
    def merges(self) -> bool:
        """Whether a client merges the children it holds when a node takes their place."""

    @property
    def relative(self) -> bool:
        """Whether a step codes nodes relative to nodes held."""

    @property
    def codebook(self) -> Codebook | None:
        """None exactly for SH degree 0."""

    @property
    def version(self) -> int:
        """64-bit hash of all parameters and the codebook."""

    def to_bytes(self) -> bytes:
        """Parameters and codebook, for `lod_cloud.codec.read_codec`."""

    def assign_words(self, tree: LodTree, ids: Int32) -> tuple[UInt16, Mask]:
        """Codebook words [N, stages] of nodes, and whether they are near enough; costly."""

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
        """Payload of these nodes, in the order they come in, with their words (see
        `assign_words`). Without ``places`` ids and parents are left out: the client knows them.
        With them, ids must ascend. ``plain``: without harmonics above degree 0, which only a
        codec can do that sends them `apart`.
        """

    def decode(
        self,
        payload: bytes,
        places: tuple[Int32, Int32] | None = None,
        references: Neighbours | None = None,
        *,
        plain: bool = False,
    ) -> NodeRecords:
        """Inverse of `encode`, given ids and parents where these were left out, and the
        references; harmonics that were not sent are 0.

        Raises RemoteProtocolError for anything `encode` would not write.
        """
