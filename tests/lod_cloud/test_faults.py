"""A pair of ends over a line that loses, reorders, repeats and damages messages."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lod_cloud.client import EARLY_MESSAGES
from lod_cloud.delta_cut import Report
from lod_cloud.protocol import REPORT, RemoteProtocolError, seal
from tests.lod_cloud.hostile_link import PLACES, Action, HostilePair, schedules, settled, world

LIMITS = ((256, 1 << 20), (256, 1 << 20), (4, 1 << 20), (256, 40), (1, 1))
WINDOWS = ((4, 32), (1, 3), (4, 0), (2, 7))


BUDGETS = (None, None, 1, 250, 600)


@dataclasses.dataclass(frozen=True)
class Play:
    """What happens, in which session."""

    schedule: list[Action]
    seed: int
    windows: tuple[int, int]
    limits: tuple[int, int]
    budget: int | None
    hysteresis: float
    lose: bool
    compact: bool

    def run(self) -> None:
        where = world(12 + 24 * (self.seed % 3), self.seed, compact=self.compact)
        w, window = self.windows
        pair = HostilePair(
            where,
            w=w,
            window=window,
            unacknowledged=self.limits,
            budget=self.budget,
            hysteresis=self.hysteresis,
        )
        for action in self.schedule:
            pair.act(action)
        pair.heal(lose_what_is_underway=self.lose)


PLAYS = st.builds(
    Play,
    schedules(),
    st.integers(0, 5),
    st.sampled_from(WINDOWS),
    st.sampled_from(LIMITS),
    st.sampled_from(BUDGETS),
    st.sampled_from((0.0, 0.0, 0.05)),
    st.booleans(),
    st.booleans(),
)


@given(PLAYS)
@settings(max_examples=250)
def test_nothing_is_lost(play: Play) -> None:
    play.run()


@pytest.mark.slow
@given(PLAYS)
@settings(max_examples=10_000)
def test_nothing_is_lost_at_length(play: Play) -> None:
    play.run()


def test_a_lost_message_is_made_good_by_one_difference() -> None:
    pair = settled()
    for action in [("walk", 2), ("lose_down", 0), ("walk", 2), ("down", 0), ("up", 0)]:
        pair.act(action)
    assert pair.client.applied == 1
    for action in [("walk", 2), ("down", 0)]:
        pair.act(action)
    assert pair.kinds == ["start", "step", "step", "repair"]
    assert pair.client.applied == pair.cloud.sequence == 4


def test_what_is_in_flight_is_not_sent_again_for_every_report() -> None:
    """Ten messages underway, the first of them lost: one repair, then steps."""
    pair = settled()
    for action in [("walk", 2)] * 10 + [("lose_down", 0)] + [("down", 0)] * 9 + [("up", 0)]:
        pair.act(action)
    for _ in range(8):  # the other reports say the same
        pair.act(("walk", 2))
        pair.act(("up", 0))
    assert pair.kinds[11:] == ["repair", *["step"] * 7]
    while pair.down:
        pair.act(("down", 0))
    assert pair.client.applied == pair.cloud.sequence


@pytest.mark.parametrize("budget", [None, 250])
@pytest.mark.parametrize("repair_arrives", [True, False])
def test_an_acknowledgement_of_what_a_repair_replaced_does_not_count(
    budget: int | None, repair_arrives: bool
) -> None:
    """Messages 2 and 3 arrive late, after the repair 4 that made them superfluous was sent. What
    the client then says it has was never the cloud's newest state, so the cloud must go on from
    message 1, and must not start over either.
    """
    pair = settled(budget=budget)
    for action in [("walk", 2), ("walk", 2), ("down", 1), ("up", 0), ("walk", 2)]:
        pair.act(action)
    assert pair.kinds == ["start", "step", "step", "repair"]
    assert pair.client.applied == 1 and len(pair.down) == 2
    pair.act(("down", 0))
    assert pair.client.applied == 3
    pair.act(("up", 0))
    assert pair.cloud._journal.applied == 1
    pair.act(("down" if repair_arrives else "lose_down", 0))
    pair.act(("walk", 2))
    assert pair.kinds[-1] == "step"
    pair.heal(lose_what_is_underway=False)
    assert pair.kinds.count("start") == 1


def test_a_repair_heals_within_a_round_trip_and_a_search_whatever_the_budget() -> None:
    """The report that follows the loss and the message that answers it: then both tables are equal,
    though the client's cut may still lag behind the one found.
    """
    pair = settled(budget=300)
    for action in [("teleport", 2), ("lose_down", 0), ("walk", 2), ("down", 0), ("up", 0)]:
        pair.act(action)
    pair.act(("walk", 1))
    assert pair.kinds[-1] == "repair"
    pair.act(("down", 0))
    assert pair.client.table is not None
    assert pair.client.table.state_hash == pair.cloud.table.state_hash
    assert pair.client.table.ids.tolist() == pair.cloud.table.ids.tolist()
    pair._deliver_all()
    assert pair.settle()[0] > 0


def test_reports_may_be_lost() -> None:
    pair = settled()
    for _ in range(20):
        for action in [("walk", 2), ("down", 0), ("lose_up", 0)]:
            pair.act(action)
    assert pair.kinds == ["start", *["step"] * 20]
    pair.act(("walk", 2))
    pair.act(("down", 0))
    pair.act(("up", 0))
    assert pair.cloud._journal.applied == pair.cloud.sequence


def test_after_a_stall_one_difference() -> None:
    """The walk goes on while nothing is acknowledged; what was found meanwhile is one message,
    without the nodes that came and went.
    """
    pair = settled(unacknowledged=(3, 1 << 20))
    for place in [*range(24, 40), *range(39, 29, -1)]:
        pair.act(("teleport", place))
    assert pair.kinds == ["start", *["step"] * 3, *["probe"] * 23]
    assert all(len(message) < 80 for message in pair.down[3:])
    for _ in range(3):
        pair.act(("lose_down", 0))
    pair.act(("down", 0))
    pair.act(("up", 0))
    pair.act(("walk", 1))
    assert pair.kinds[-1] == "repair"
    pair.down = pair.down[-1:]
    pair.act(("down", 0))
    assert pair.client.applied == pair.cloud.sequence
    assert pair.client.table is not None
    assert pair.cloud.found is not None
    assert np.array_equal(pair.client.table.cut_ids, pair.cloud.found.cut)


def test_a_client_that_never_reads_costs_bounded_memory() -> None:
    """At most twice the limit of ids are kept; later messages are probes."""
    pair = settled(unacknowledged=(1000, 200))
    for index in range(300):
        pair.act(("teleport", 7 * index % PLACES))
    tree = pair.world.tree
    assert pair.kinds[-250:] == ["probe"] * 250
    assert pair.cloud._journal.node_count <= 2 * 200
    assert pair.cloud.state_bytes <= len(tree) * (1 + 8 + 4 + 2 * 4) + 4 * (4096 + 400)
    pair.heal(lose_what_is_underway=True)


def test_a_teleport_storm_keeps_the_memory_bounded() -> None:
    pair = settled()
    for index in range(200):
        for action in [("teleport", 31 * index % PLACES), ("down", 0), ("up", 0)]:
            pair.act(action)
    assert pair.cloud._journal.node_count == 0
    assert pair.cloud.state_bytes <= 13 * len(pair.world.tree) + 4 * 4096


def test_resume_after_a_disconnection() -> None:
    """What was underway is gone; the difference follows from the last message applied."""
    pair = settled()
    for action in [("walk", 2), ("walk", 2), ("down", 0), ("disconnect", 0), ("up", 0)]:
        pair.act(action)
    applied = pair.client.applied
    pair.act(("walk", 2))
    assert (applied, pair.kinds[-1]) == (2, "repair")
    pair.act(("down", 0))
    assert pair.client.applied == pair.cloud.sequence == 4


def test_a_client_that_lost_its_state_gets_everything_again() -> None:
    pair = settled()
    pair.act(("walk", 2))
    pair.act(("down", 0))
    pair.act(("up", 0))
    for again in (Report(0, 1, 1, 0, 1, True, False), Report(0, 2, 2, 0, 2, False, True)):
        pair.cloud.receive(seal(REPORT, again.to_bytes()))
        pair.act(("walk", 2))
        assert pair.kinds[-1] == "start"
        pair.act(("down", 0))
        assert pair.client.applied == pair.cloud.sequence
    pair.cloud.receive(seal(REPORT, Report(0, 2, 4, 12345, 4, False, False).to_bytes()))
    pair.act(("walk", 2))
    assert pair.kinds[-1] == "start"


def test_reports_of_what_was_never_sent_are_refused() -> None:
    pair = settled()
    for applied, seen in ((2, 2), (1, 9)):
        report = Report(0, 0, applied, 0, seen, False, False)
        with pytest.raises(RemoteProtocolError, match="must be at most 1, the newest sent"):
            pair.cloud.receive(seal(REPORT, report.to_bytes()))
    with pytest.raises(RemoteProtocolError, match="kind must be 4, not 1"):
        pair.cloud.receive(pair.cloud.session_start())


def test_early_messages_wait_in_bounded_memory() -> None:
    pair = settled()
    for _ in range(EARLY_MESSAGES + 20):
        pair.act(("walk", 2))
    pair.down.append(pair.down.pop(0))
    for _ in range(EARLY_MESSAGES + 19):
        pair.act(("down", 0))
    assert len(pair.client._early) == EARLY_MESSAGES
    pair.act(("down", 0))
    assert pair.client.applied == EARLY_MESSAGES + 2
    pair.up = pair.up[-1:]
    pair.heal(lose_what_is_underway=False)
    assert not pair.client._early


def test_two_clients_with_different_codebooks() -> None:
    """Each is served by its own codec and refuses what is meant for the other."""
    pairs = [HostilePair(world(60, 2, codebook)) for codebook in (1, 2)]
    for pair in pairs:
        pair.act(("walk", 1))
    starts, firsts = zip(*(pair.down for pair in pairs), strict=True)
    for pair, start in zip(pairs, starts, strict=True):
        pair.client.receive(start)
    for pair, other in zip(pairs, reversed(firsts), strict=True):
        with pytest.raises(RemoteProtocolError, match="codebook version must be"):
            pair.client.receive(other)
        pair.down = pair.down[1:]
        pair.heal(lose_what_is_underway=False)
