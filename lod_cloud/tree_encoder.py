"""Codes the nodes of one tree for all sessions that look at it."""

from __future__ import annotations

import numpy as np

from gaussians.errors import InputError
from lod_cloud.codec import PaperCodec
from lod_cloud.lod_tree import Int32, LodTree
from lod_cloud.node_records import NodeRecords


class TreeEncoder:
    """Codes nodes of one tree, looking for a node's codebook words only once. Serves many
    sessions.
    """

    def __init__(self, tree: LodTree, codec: PaperCodec) -> None:
        if codec.sh_degree != tree.sh_degree:
            raise InputError(
                f"codec must be trained for SH degree {tree.sh_degree}, not {codec.sh_degree}"
            )
        self.tree, self.codec = tree, codec
        stages = len(codec.codebook.stages) if codec.codebook else 0
        self._words = np.zeros((len(tree), stages), np.uint16)
        self._near = np.zeros(len(tree), np.bool_)
        self._known = np.zeros(len(tree), np.bool_)

    def encode(self, ids: Int32, *, places: bool = True) -> tuple[bytes, int]:
        """Payload of the nodes ``ids`` (ascending), and how many of them are escapes; see
        `PaperCodec.encode`.
        """
        fresh = ids[~self._known[ids]]
        self._words[fresh], self._near[fresh] = self.codec.assign_words(self.tree, fresh)
        self._known[fresh] = True
        nodes = NodeRecords.of(self.tree, ids)
        return self.codec.encode(nodes, self._words[ids], self._near[ids], places=places)
