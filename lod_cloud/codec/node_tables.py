"""Frequencies of the symbols of all columns, from the nodes of a tree."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from gaussians.codebook import Codebook
from lod_cloud.codec.harmonic_rests import HarmonicRests
from lod_cloud.codec.interface import References
from lod_cloud.codec.node_columns import Coder, Column, Layout, Rows
from lod_cloud.codec.node_fields import NodeFields
from lod_cloud.codec.rans import Frequencies, Puller, Pusher
from lod_cloud.codec.training import harmonics, words_of
from lod_cloud.lod_tree import Int32, LodTree
from lod_cloud.node_records import NodeRecords

Tables = Mapping[str, Frequencies]

_LEVELS_UP = (0, 1, 2, 4)  # from one to the next: parent, grandparent and so on


def layout_of(fields: NodeFields, codebook: Codebook | None) -> Layout:
    """The columns of a codec with these fields and this codebook."""
    if codebook is None:
        return Layout.of(fields.dc.top + 1, [], 0)
    return Layout.of(
        fields.dc.top + 1, [len(book) for book in codebook.stages], codebook.dimensions
    )


def pushing(pusher: Pusher, tables: Tables) -> Coder:
    """What columns go through to be sent."""

    def push(key: str, _: tuple[int, int], contexts: Column, values: Column | None, /) -> Column:
        assert values is not None
        pusher.add(key.split(".")[0], tables[key], values, contexts)
        return values

    return push


def pulling(puller: Puller, tables: Tables) -> Coder:
    """What columns come from."""
    return lambda key, _, contexts, __: puller.column(tables[key], contexts)


def count_tables(
    tree: LodTree,
    ids: Int32,
    fields: NodeFields,
    codebook: Codebook | None,
    rests: HarmonicRests | None,
    tolerance: float,
) -> Tables:
    """Of nodes ``ids`` (ascending), each as a client gets it that holds its parent; how positions
    are told, also as one gets it that holds nothing near.
    """
    nodes = NodeRecords.of(tree, ids)
    codes, exact = fields.encode(nodes)
    layout = layout_of(fields, codebook)
    kept, inner = ~exact, nodes.child_counts > 0
    where = codes.places[kept], codes.sigmas[kept, 0]
    choices, *others = (
        fields.position.choose(*where, held, tolerance)
        for held in _ancestors(tree, nodes.parents[kept])
    )
    given = codes.columns(kept, inner, layout.colours)
    rows = [Rows.of(inner, nodes.parents, held) for held in (nodes.parents, None)]
    tables: dict[str, Frequencies] = {}

    def count(
        key: str, shape: tuple[int, int], contexts: Column, values: Column | None, /
    ) -> Column:
        assert values is not None
        if key == "position":
            far = rows[1].take(kept)
            values = np.concatenate([values, *others])
            contexts = np.concatenate([contexts, *[far.inner + 2 * far.siblings] * len(others)])
        tables[key] = Frequencies.counted(values, contexts, shape)
        return values

    layout.fields(count, rows[0].take(kept), given | {"position": choices})
    if codebook and rests:
        words, near = words_of(tree, ids, codebook)
        near &= inner
        numbers = harmonics(tree.gaussians, ids[~near])
        told = rests.told(codebook, words, near, numbers, inner)
        found = {"harmonics.rest": told.rests.reshape(-1)}
        found |= layout.high_parts(words[told.by_words])
        layout.harmonics(count, inner[told.by_words], found)
    return tables


def _ancestors(tree: LodTree, parents: Int32) -> Iterator[References]:
    """What a client may hold next to nodes with these parents: these, and ancestors above them."""
    scene, held = tree.gaussians, parents
    for levels in _LEVELS_UP:
        for _ in range(levels):
            held = tree.parent[np.maximum(held, 0)]
        near = np.maximum(held, 0)
        yield References(held, scene.means[near], scene.scales[near].max(axis=1))
