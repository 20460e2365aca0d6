"""Two ends of a session and a line between them that does whatever a schedule says."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from gaussians.scene import FIELDS, Scene
from lod_cloud.client import Client, _Arrival
from lod_cloud.cloud import Cloud
from lod_cloud.codec import Codec, CompactCodec, PaperCodec
from lod_cloud.criterion import SearchRequest
from lod_cloud.cut import is_complete
from lod_cloud.delta_cut import DeltaCut
from lod_cloud.lod_tree import Int32, LodTree
from lod_cloud.management_table import ManagementTable
from lod_cloud.protocol import RemoteProtocolError
from lod_cloud.search import SearchTree, make_search
from lod_cloud.subgraph import LocalSubgraph
from lod_cloud.tree_encoder import TreeEncoder
from tests.lod_cloud.trees import random_tree

PLACES = 48  # along a walk; a step is short, a teleport is not

Action = tuple[str, int]


@dataclasses.dataclass(frozen=True)
class World:
    """One tree, how it is coded, and places along a walk through it."""

    tree: LodTree
    hot: SearchTree
    encoder: TreeEncoder
    decoded: Scene  # what a client must have for every node
    places: list[SearchRequest]

    def values(self, ids: Int32, plain: NDArray[np.bool_]) -> Scene:
        """What a client must have of nodes that it was sent, and holds plain or complete."""
        scene = self.decoded.take(ids)
        sh = np.where(plain[:, None, None], 0, scene.sh)
        sh[:, 0] = scene.sh[:, 0]
        return dataclasses.replace(scene, sh=sh)


@cache
def world(leaves: int, seed: int, codebook: int = 1, *, compact: bool = False) -> World:
    tree = random_tree(leaves, seed)
    train = CompactCodec.train if compact else PaperCodec.train
    codec: Codec = train(tree, codebook, words=8)
    encoder = TreeEncoder(tree, codec)
    payload = encoder.encode(np.arange(len(tree), dtype=np.int32)).payload
    decoded = codec.decode(payload).gaussians
    places = [SearchRequest((0.7 * i - 16.0, 0.5, 0.0), 200, 6) for i in range(PLACES)]
    return World(tree, SearchTree.of(tree), encoder, decoded, places)


def world_of(tree: LodTree, codec: CompactCodec, seed: int) -> World:
    """The same with a codec of its own and places of a random walk."""
    encoder = TreeEncoder(tree, codec)
    everything = encoder.encode(np.arange(len(tree), dtype=np.int32))
    rng = np.random.default_rng(seed)
    step, position = rng.uniform(0.1, 1.5), rng.uniform(-5, 5, 3)
    places = []
    for _ in range(PLACES):
        position = position + rng.normal(0, step, 3)
        places.append(SearchRequest(tuple(position), 200, 6))
    decoded = codec.decode(everything.payload).gaussians
    return World(tree, SearchTree.of(tree), encoder, decoded, places)


class CheckedClient(Client):
    """A client that knows what should come."""

    def __init__(self, where: World) -> None:
        super().__init__()
        self.world = where

    def _from_events(
        self, delta: DeltaCut, table: ManagementTable, graph: LocalSubgraph
    ) -> _Arrival:
        arrival, events = super()._from_events(delta, table, graph), delta.events
        assert events is not None
        merged = np.isin(arrival.fresh.ids, events.tops) & self.world.encoder.codec.merges
        merged &= ~np.isin(arrival.fresh.ids, events.unmerged)
        assert np.count_nonzero(merged) == arrival.merged
        sent = arrival.fresh.take(np.flatnonzero(~merged))
        assert np.array_equal(arrival.sent, sent.ids)
        right = self.world.values(sent.ids, np.full(len(sent), delta.plain))
        for name in FIELDS:
            assert np.array_equal(getattr(sent.gaussians, name), getattr(right, name))
        return arrival


class HostilePair:
    """A cloud and a client, and what is underway between them. Compares both at every message."""

    def __init__(
        self,
        where: World,
        *,
        w: int = 4,
        window: int = 32,
        unacknowledged: tuple[int, int] = (256, 1 << 20),
        budget: int | None = None,
        hysteresis: float = 0.0,
    ) -> None:
        self.world = where
        self.cloud = Cloud(
            where.tree,
            where.encoder,
            search=make_search("flat", where.hot, hysteresis=hysteresis),
            frames_per_search=w,
            reuse_window_frames=window,
            budget_bytes=budget,
            unacknowledged=unacknowledged,
        )
        self.client = CheckedClient(where)
        self.down = [self.cloud.session_start()]
        self.up: list[bytes] = []
        self.kinds: list[str] = []  # of messages sent
        self.merged = 0  # nodes found that the client had merged itself
        self._budget = budget
        self._place, self._frame = PLACES // 2, 0
        nothing = np.empty(0, np.int32)
        # of the cloud's table, by sequence number
        self._states = {0: (nothing, nothing, nothing.astype(np.bool_), 0)}
        self.plain = self.completed = 0  # nodes of messages sent

    def act(self, action: Action) -> None:
        """One event: a search, or something that happens to what is underway."""
        kind, number = action
        getattr(self, f"_{kind}")(number)

    def heal(self, *, lose_what_is_underway: bool) -> None:
        """From now on the line works: one round trip and one search make both ends equal, and where
        the camera rests nothing stays pending.
        """
        if self.client.table is None:
            self.down.append(self.cloud.session_start())  # the service repeats it until it arrives
            self._deliver_all()
        if lose_what_is_underway:
            self.down.clear()
            self.up.clear()
        self._deliver_all()
        self._walk(0)
        self._deliver_all()
        self._walk(0)
        self._deliver_all()
        assert self.cloud.found is not None and self.cloud.stats is not None
        assert self.client.table is not None
        assert self.client.applied == self.cloud.sequence
        self.settle()
        assert np.array_equal(self.client.table.cut_ids, self.cloud.found.cut)

    def settle(self) -> list[int]:
        """Search from the same place until nothing is pending and tau is the one asked for; nodes
        pending, search by search.
        """
        assert self.cloud.stats is not None
        tau_px = self.world.places[self._place].tau_px
        pending = [self.cloud.stats.pending]
        while pending[-1] or self.cloud.stats.tau_px > tau_px or self.cloud.stats.pending_harmonics:
            self._search()
            self._deliver_all()
            pending.append(self.cloud.stats.pending)
            assert len(pending) <= 3 * len(self.world.tree)
        return pending

    def _deliver_all(self) -> None:
        while self.down:
            self._down(0)
        while self.up:
            self._up(0)

    def _walk(self, step: int) -> None:
        self._place = (self._place + step % 3 - 1) % PLACES
        self._search()

    def _teleport(self, place: int) -> None:
        self._place = place % PLACES
        self._search()

    def _search(self) -> None:
        self._frame += self.cloud.table.frames_per_search
        message = self.cloud.search(self.world.places[self._place], self._frame)
        stats, found = self.cloud.stats, self.cloud.found
        assert stats is not None and found is not None
        table, cut = self.cloud.table, found.cut
        self.kinds.append(stats.kind)
        if self.cloud.sequence:
            assert is_complete(self.world.tree, table.cut_ids)
        assert stats.pending == np.count_nonzero(~table.in_cut(cut))
        if stats.kind != "probe" and self._budget is None:
            assert stats.pending == 0
        if self._budget is not None and len(message) > self._budget:
            events = stats.added + stats.removed
            assert stats.kind != "step" or events <= 1 + self.world.tree.child_count.max()
            assert stats.completed == 0 or (stats.completed, events) == (1, 0)
        plain = table.plain(table.ids)
        bare = np.count_nonzero(plain & table.in_cut(table.ids))
        assert stats.pending_harmonics == table.plain_in_cut == bare
        assert not plain.any() or self._budget is not None
        self.plain, self.completed = self.plain + stats.plain, self.completed + stats.completed
        self._states[self.cloud.sequence] = table.ids, table.last, plain, table.state_hash
        self.down.append(message)

    def _down(self, which: int) -> None:
        if self.down:
            self._arrive(self.down.pop(which % len(self.down)), damaged=False)

    def _up(self, which: int) -> None:
        if self.up:
            self.cloud.receive(self.up.pop(which % len(self.up)))

    def _lose_down(self, which: int) -> None:
        if self.down:
            self.down.pop(which % len(self.down))

    def _lose_up(self, which: int) -> None:
        if self.up:
            self.up.pop(which % len(self.up))

    def _twice_down(self, which: int) -> None:
        if self.down:
            self.down.append(self.down[which % len(self.down)])

    def _twice_up(self, which: int) -> None:
        if self.up:
            self.up.append(self.up[which % len(self.up)])

    def _corrupt(self, bit: int) -> None:
        if self.down:
            damaged = bytearray(self.down.pop(0))
            damaged[bit // 8 % len(damaged)] ^= 1 << bit % 8
            self._arrive(bytes(damaged), damaged=True)

    def _truncate(self, size: int) -> None:
        if self.down:
            message = self.down.pop(0)
            self._arrive(message[: size % len(message)], damaged=True)

    def _corrupt_up(self, bit: int) -> None:
        if self.up:
            damaged = bytearray(self.up.pop(0))
            damaged[bit // 8 % len(damaged)] ^= 1 << bit % 8
            try:
                self.cloud.receive(bytes(damaged))
            except RemoteProtocolError:
                return
            raise AssertionError("damage must be noticed")

    def _disconnect(self, _: int) -> None:
        self.down.clear()
        self.up.clear()
        if self.client.table is None:
            self.down.append(self.cloud.session_start())
        else:
            self.up.append(self.client.reconnect())

    def _arrive(self, message: bytes, *, damaged: bool) -> None:
        """A message reaches the client, which then reports."""
        before = self.client.applied
        try:
            self.client.receive(message)
            assert not damaged
        except RemoteProtocolError as error:
            too_early = "session start must come before" in str(error)
            assert damaged or too_early, error
            assert self.client.applied == before
        if self.client.table is not None:
            self.up.append(self.client.report())
            self.compare()

    def compare(self) -> None:
        """The client holds what the cloud's table held after the message it applied last."""
        table, graph = self.client.table, self.client._subgraph
        assert table is not None
        ids, last, plain, state_hash = self._states[self.client.applied]
        assert np.array_equal(table.ids, ids)
        assert np.array_equal(table.last, last)
        assert np.array_equal(table.plain(ids), plain)
        assert table.state_hash == state_hash
        assert len(table) == len(ids)
        assert np.array_equal(graph.ids, ids)
        assert np.array_equal(graph._parents, self.world.tree.parent[ids])
        assert np.array_equal(graph._child_counts, self.world.tree.child_count[ids])
        held, right = (
            graph.gaussians(np.arange(len(ids), dtype=np.int32)),
            self.world.values(ids, plain),
        )
        same = np.ones(len(ids), np.bool_)
        for name in FIELDS:
            equal = getattr(held, name) == getattr(right, name)
            same &= equal.all(axis=tuple(range(1, equal.ndim)))
        self.merged += int(np.count_nonzero(~same))
        codec, true = self.world.encoder.codec, self.world.tree.gaussians.take(ids[~same])
        assert not held.sh[plain, 1:].any()
        if not codec.merges:
            assert same.all()
        elif not same.all():  # merged by the client
            assert isinstance(codec, CompactCodec)
            assert self.world.tree.child_count[ids[~same]].all()
            off = np.abs(held.means[~same].astype(float) - true.means)
            assert (off <= codec.tolerance * true.scales.max(axis=1, keepdims=True)).all()


def settled(**changes: object) -> HostilePair:
    """A session in which one message was applied and acknowledged."""
    pair = HostilePair(world(60, 2), **changes)  # type: ignore[arg-type]
    for action in (("walk", 1), ("down", 0), ("down", 0), ("up", 0), ("up", 0)):
        pair.act(action)
    assert pair.client.applied == 1
    return pair


FAULTS = (
    "lose_down",
    "lose_up",
    "twice_down",
    "twice_up",
    "corrupt",
    "corrupt_up",
    "truncate",
    "disconnect",
    "down",  # anything that is underway, not the oldest
    "up",
)
ARRIVE: list[Action] = [("down", 0), ("up", 0)]


def schedules() -> st.SearchStrategy[list[Action]]:
    """What happens, in order. A stall is a run of searches with nothing arriving; a reordering is
    an arrival of something that is not the oldest; a storm is a run of teleports.
    """
    step = st.integers(0, 2)
    fault = st.tuples(st.sampled_from(FAULTS), st.integers(0, 4095))
    calm = st.lists(step, min_size=1, max_size=4).map(
        lambda steps: [a for s in steps for a in (("walk", s), *ARRIVE)]
    )
    trouble = st.tuples(
        st.lists(step, min_size=1, max_size=4), st.lists(fault, min_size=1, max_size=3)
    )
    troubled = trouble.map(lambda t: [*(("walk", s) for s in t[0]), *t[1], *ARRIVE])
    stall = st.lists(step, min_size=2, max_size=6).map(lambda steps: [("walk", s) for s in steps])
    storm = st.lists(st.integers(0, PLACES - 1), min_size=1, max_size=3).map(
        lambda places: [a for place in places for a in (("teleport", place), *ARRIVE)]
    )
    part = st.one_of(calm, troubled, troubled, troubled, stall, storm)
    begun = st.sampled_from([[], [("walk", 1), *ARRIVE, *ARRIVE]])
    parts = st.lists(part, min_size=2, max_size=8)
    return st.tuples(begun, parts).map(lambda t: [*t[0], *(a for p in t[1] for a in p)])
