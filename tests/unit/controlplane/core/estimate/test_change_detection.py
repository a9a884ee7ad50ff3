"""What a server needs changes at once; what is odd now and then is no change."""

from __future__ import annotations

import random

import pytest

from plr.controlplane.core.estimate.processing import ComputeTimes
from plr.protos.base.histogram import Histogram
from plr.protos.model.ids import NodeName
from tests.support.samples import PLAN, histogram

A, B, C = (NodeName(name) for name in "abc")
ROBOT = NodeName("robot")
IDLE_S, BUSY_S = 0.02, 0.25
INTERVAL_S = 0.5
HALF_LIFE_S = 60.0


class Fed:
    """Processing times of servers as reports of half a second bring them."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = random.Random(seed)
        self.compute = ComputeTimes(HALF_LIFE_S)
        self.now = 0.0

    def feed(self, needs: dict[NodeName, float], seconds: float, *, odd: float = 0.0) -> int:
        """Two answers of each server in each report, an `odd` share of them busy; how many changes were noticed."""
        noticed = 0
        for _ in range(round(seconds / INTERVAL_S)):
            self.now += INTERVAL_S
            for server, median_s in needs.items():
                times = Histogram()
                for _ in range(2):
                    took = BUSY_S if self.rng.random() < odd else median_s
                    times.record(took * self.rng.lognormvariate(0.0, 0.25))
                noticed += self.compute.merge(ROBOT, server, PLAN, times, self.now)
        return noticed

    def late(self, server: NodeName) -> float:
        """The share of its answers that take more than 0.1 s, as believed."""
        times = self.compute.times(server, PLAN, self.now).times
        assert times is not None
        return times.sum_exceeds(None, 0.1)


@pytest.mark.parametrize(("before", "after"), [(IDLE_S, BUSY_S), (BUSY_S, IDLE_S)])
def test_a_change_is_noticed_within_a_few_answers_and_the_past_forgotten(before: float, after: float) -> None:
    for seed in range(10):
        fed = Fed(seed)
        fed.feed({A: before}, 60.0)
        assert fed.feed({A: after}, 2.5) == 1
        assert abs(fed.late(A) - (after > 0.1)) < 0.25, "of before it keeps one answer at most"
        assert fed.feed({A: after}, 20.0) == 0


@pytest.mark.parametrize("odd", [0.0, 0.05, 0.2])
def test_a_steady_server_hardly_ever_seems_to_change(odd: float) -> None:
    assert sum(Fed(seed).feed({A: IDLE_S}, 120.0, odd=odd) for seed in range(4)) <= 1


def test_one_hiccup_is_no_change_however_many_waited_behind_it() -> None:
    fed = Fed()
    fed.feed({A: IDLE_S}, 30.0)
    assert not fed.compute.merge(ROBOT, A, PLAN, histogram(BUSY_S, times=20), fed.now)


def test_when_one_server_changes_the_others_are_doubted_unless_they_are_in_use() -> None:
    fed = Fed()
    fed.feed({A: IDLE_S, B: IDLE_S, C: BUSY_S}, 30.0)
    fed.feed({A: IDLE_S, B: IDLE_S}, 8.0)
    assert fed.late(C) > 0.9
    fed.feed({A: BUSY_S, B: IDLE_S}, 2.5)
    assert fed.late(A) > 0.9
    assert fed.late(B) < 0.1
    assert 0.2 < fed.late(C) < 0.7, "as the others are, one busy and one not"


def test_a_service_usually_needs_what_its_servers_need_however_often_each_was_asked() -> None:
    compute = ComputeTimes(HALF_LIFE_S)
    compute.merge(ROBOT, A, PLAN, histogram(BUSY_S, times=1000), 0.0)
    compute.merge(ROBOT, B, PLAN, histogram(IDLE_S, times=20), 0.0)
    times = compute.times(C, PLAN, 0.0).times
    assert times is not None
    assert times.sum_exceeds(None, 0.1) == pytest.approx(0.5, abs=0.05)
