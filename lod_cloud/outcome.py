"""What events mean to a client, by what it was told before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lod_cloud.cut import without
from lod_cloud.depth_first import depth_first
from lod_cloud.events import Events
from lod_cloud.families import Families
from lod_cloud.lod_tree import Int32
from lod_cloud.management_table import ManagementTable
from lod_cloud.node_records import NodeRecords
from lod_cloud.protocol import RemoteProtocolError
from lod_cloud.subgraph import LocalSubgraph

_ROOT = np.zeros(1, np.int32)


@dataclass(frozen=True)
class Outcome:
    """What events mean to a client."""

    entered: Int32  # in the cut now, ascending
    left: Int32  # in the cut before, ascending
    sent: Int32  # of ``entered``: not held, and not merged from what is held; as they travel
    sent_parents: Int32
    references: Int32  # for each of ``sent`` a node held, which its coding may refer to; if any is
    merged: NodeRecords  # of ``entered``: not held, but their children


def outcome(
    events: Events, table: ManagementTable, held: LocalSubgraph, *, merges: bool
) -> Outcome:
    """Nodes from events, by what a client holds, which merges collapsed nodes itself if ``merges``.
    To one that holds nothing the root is new, and may be expanded at once. Raises
    RemoteProtocolError for events that do not fit it.
    """
    for ids in (events.expanded, events.tops, events.inner):
        if len(ids) and ids[-1] >= table.nodes:
            raise RemoteProtocolError(f"node ids must be below {table.nodes}")
    known = table.in_cut(events.expanded)
    if len(events.fan_outs) != np.count_nonzero(~known):
        raise RemoteProtocolError("an expanded node must be in the cut or tell its fan-out")
    counts = np.empty(len(events.expanded), np.int64)
    counts[known] = held.child_counts(events.expanded[known])
    counts[~known] = events.fan_outs
    total = int(counts.sum())
    if (counts < 1).any() or total > table.nodes:
        raise RemoteProtocolError("expanded nodes must have children, all together those of a tree")
    begins = np.cumsum(counts) - counts
    offsets = np.arange(total) - np.repeat(begins, counts)
    nodes = (np.repeat(events.first_children, counts) + offsets).astype(np.int32)
    parents = np.repeat(events.expanded, counts)
    if not len(table):
        nodes, parents = np.append(_ROOT, nodes), np.append(_ROOT - 1, parents)
    if (np.diff(nodes) <= 0).any():
        raise RemoteProtocolError("children of different nodes must differ")
    drawn = ~np.isin(nodes, events.expanded)
    families = Families.of(events, table, held)
    left = np.union1d(events.expanded[known], families.drawn).astype(np.int32)
    new_tops = ~table.holds(events.tops)
    wanted, wanted_parents = events.tops[new_tops], events.top_parents[new_tops]
    if (parents >= nodes).any() or (wanted_parents >= wanted).any():
        raise RemoteProtocolError("a parent must have a smaller id than its child")
    entered = np.concatenate([nodes[drawn], events.tops])
    if len(entered) and not 0 <= entered.min() <= entered.max() < table.nodes:
        raise RemoteProtocolError(f"node ids must be below {table.nodes}")
    merged = without(wanted, events.unmerged) if merges else wanted[:0]
    apart = np.isin(wanted, merged, invert=True)
    fresh = nodes[drawn][~table.holds(nodes[drawn])]
    sent = np.concatenate([fresh, wanted[apart]])
    above = np.concatenate([_parents(fresh, nodes, parents), wanted_parents[apart]])
    near = np.concatenate(
        [_ancestors(fresh, nodes, parents, table), families.first_held(wanted[apart], table)]
    )
    ascending = np.argsort(sent)
    sent, above, near = sent[ascending], above[ascending], near[ascending]
    order = depth_first(
        sent, above, events.expanded, _parents_if_any(events.expanded, nodes, parents)
    )
    return Outcome(
        np.sort(entered),
        left,
        sent[order],
        above[order],
        near[order],
        families.merged(merged, wanted_parents[~apart], held, table),
    )


def _parents(ids: Int32, nodes: Int32, parents: Int32) -> Int32:
    """Parents of some of ``nodes`` (ascending)."""
    return parents[np.searchsorted(nodes, ids)]


def _parents_if_any(ids: Int32, nodes: Int32, parents: Int32) -> Int32:
    """The same, -1 for other nodes."""
    found = np.full(len(ids), -1, np.int32)
    known = np.isin(ids, nodes, assume_unique=True)
    found[known] = _parents(ids[known], nodes, parents)
    return found


def _ancestors(ids: Int32, nodes: Int32, parents: Int32, table: ManagementTable) -> Int32:
    """The nearest ancestor held of each of ``ids``, some of ``nodes``; -1 if nothing is held."""
    if not len(table):
        return np.full(len(ids), -1, np.int32)
    near = _parents(ids, nodes, parents)
    while not (there := table.holds(near)).all():
        if not np.isin(near[~there], nodes).all():
            raise RemoteProtocolError("an expanded node must be below a node that is held")
        near[~there] = _parents(near[~there], nodes, parents)
    return near
