"""What of the solving at once is for one robot."""

from __future__ import annotations

import pytest

from plr.controlplane.core.base import member_table
from plr.controlplane.core.overload.urgency import LEAST_PAIRS, PAIRS_BURST, PAIRS_PER_S, Urgency
from plr.protos.model.ids import NodeName

ROBOT, OTHER = NodeName("robot"), NodeName("other")


@pytest.mark.audit("ops-20")
@pytest.mark.parametrize("pairs", [0, 6, 500, 100_000])
def test_a_robot_has_its_share_and_takes_nothing_of_the_others(pairs: int) -> None:
    shares = Urgency()
    cost = min(max(pairs, LEAST_PAIRS), PAIRS_BURST)
    taken = sum(shares.take(ROBOT, pairs, now=0.0) for _ in range(200))
    assert taken == PAIRS_BURST // cost
    assert shares.held == 200 - taken
    assert shares.take(OTHER, pairs, now=0.0)
    assert not shares.take(ROBOT, pairs, now=0.9 * cost / PAIRS_PER_S - (PAIRS_BURST % cost) / PAIRS_PER_S)
    assert shares.take(ROBOT, pairs, now=cost / PAIRS_PER_S)


def test_as_many_robots_are_counted_as_there_is_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(member_table, "MAX_MEMBERS", 3)
    shares = Urgency()
    for number in range(9):
        shares.take(NodeName(f"robot-{number}"), 6, now=0.0)
    assert (len(shares.shares), shares.shares.forgotten) == (3, 6)
