"""Frequencies of the symbols of all columns, from the nodes of a tree."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gaussians.codebook import Codebook
from lod_cloud.codec.interface import References
from lod_cloud.codec.node_columns import Column, Layout, Rows
from lod_cloud.codec.node_fields import NodeFields
from lod_cloud.codec.rans import Frequencies
from lod_cloud.codec.training import words_of
from lod_cloud.lod_tree import Int32, LodTree
from lod_cloud.node_records import NodeRecords

Tables = Mapping[str, Frequencies]


def layout_of(fields: NodeFields, codebook: Codebook | None) -> Layout:
    """The columns of a codec with these fields and this codebook."""
    return Layout.of(fields.dc.top + 1, [len(book) for book in codebook.stages] if codebook else [])


def count_tables(
    tree: LodTree, ids: Int32, fields: NodeFields, codebook: Codebook | None, tolerance: float
) -> Tables:
    """Of nodes ``ids`` (ascending), each as a client gets it that holds its parent."""
    nodes = NodeRecords.of(tree, ids)
    codes, exact = fields.encode(nodes)
    words, near = words_of(tree, ids, codebook)
    layout, scene, above = layout_of(fields, codebook), tree.gaussians, np.maximum(nodes.parents, 0)
    references = References(scene.means[above], scene.scales[above].max(axis=1))
    kept, inner = ~exact, nodes.child_counts > 0
    choices = fields.position.choose(
        codes.places[kept], codes.sigmas[kept, 0], references.take(np.flatnonzero(kept)), tolerance
    )
    given = codes.columns(kept, inner, layout.colours) | layout.high_parts(words[near])
    tables: dict[str, Frequencies] = {}

    def count(
        key: str, shape: tuple[int, int], contexts: Column, values: Column | None, /
    ) -> Column:
        assert values is not None
        tables[key] = Frequencies.counted(values, contexts, shape)
        return values

    rows = [Rows.of(inner[some], nodes.parents[some]) for some in (kept, near)]
    layout.pass_through(
        count,
        rows,
        given | {"position": choices},
    )
    return tables
