"""What events mean to a client, by what it was told before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lod_cloud.events import Events
from lod_cloud.lod_tree import Int32
from lod_cloud.management_table import ManagementTable
from lod_cloud.protocol import RemoteProtocolError
from lod_cloud.subgraph import LocalSubgraph


@dataclass(frozen=True)
class Outcome:
    """What events mean to a client."""

    entered: Int32  # in the cut now, ascending
    left: Int32  # in the cut before, ascending
    needed: Int32  # of ``entered``: not held
    needed_parents: Int32


def outcome(events: Events, table: ManagementTable, held: LocalSubgraph) -> Outcome:
    """Nodes from events, by what a client holds. Raises RemoteProtocolError for events that do not
    fit it.
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
    drawn = ~np.isin(nodes, events.expanded)
    collapsed = np.union1d(events.tops, events.inner).astype(np.int32)
    below = held.children(collapsed)
    left = np.union1d(events.expanded[known], below[table.in_cut(below)]).astype(np.int32)
    new_tops = ~table.holds(events.tops)
    if np.count_nonzero(new_tops) != len(events.top_parents):
        raise RemoteProtocolError("a collapsed node must be held or tell its parent")
    top_parents = np.full(len(events.tops), -1, np.int32)
    top_parents[new_tops] = events.top_parents
    entered = np.concatenate([nodes[drawn], events.tops])
    above = np.concatenate([parents[drawn], top_parents])
    order = np.argsort(entered)
    entered, above = entered[order], above[order]
    if len(entered) and not 0 <= entered[0] <= entered[-1] < table.nodes:
        raise RemoteProtocolError(f"node ids must be below {table.nodes}")
    new = ~table.holds(entered)
    return Outcome(entered, left, entered[new], above[new])
