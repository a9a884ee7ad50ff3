"""No robot outweighs the others when it comes to what a server needs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plr.controlplane.core.estimate.processing import ComputeTimes
from plr.controlplane.core.estimate.witnesses import COUNTS_ANYWAY, MAX_WITNESSES, MOST_ALONE, Witnesses, thinned
from plr.protos.base.histogram import BUCKETS, MAX_COUNT, Histogram
from plr.protos.model.ids import NodeName
from tests.support.samples import PLAN, histogram

if TYPE_CHECKING:
    from collections.abc import Iterable

pytestmark = pytest.mark.audit("sec-10")

A = NodeName("cloud-a")
HALF_LIFE_S = 60.0
HONEST = tuple(NodeName(f"robot-{number}") for number in range(3))
EVIL = NodeName("evil")
LIE = Histogram.from_sparse([341], [MAX_COUNT], 0)
DEADLINE_S = 0.1


def late(compute: ComputeTimes, now: float) -> float:
    """The share of what is known of the server that took longer than the deadline."""
    return compute.requests(A, PLAN, now, sample=1000).fraction_over(DEADLINE_S)


def reported(seconds: Iterable[int], *, honest_hz: int, lies_every_s: int = 0) -> tuple[ComputeTimes, int]:
    """What came of reports a second; and how many changes were believed."""
    compute, changes = ComputeTimes(HALF_LIFE_S), 0
    for second in seconds:
        for robot in HONEST:
            changes += compute.merge(robot, A, PLAN, histogram(0.02, times=honest_hz), float(second))
        if lies_every_s and second % lies_every_s == 0 and second > 30:
            for part in range(4):
                changes += compute.merge(EVIL, A, PLAN, LIE, second + 0.2 * (part + 1))
    return compute, changes


@pytest.mark.parametrize("every_s", [1, 10])
def test_a_liar_with_any_number_of_samples_counts_as_one_of_the_robots(every_s: int) -> None:
    """Before: one report was all that was known of the server from then on."""
    compute, changes = reported(range(120), honest_hz=10, lies_every_s=every_s)
    assert changes == 0
    assert late(compute, 120.0) < 0.3


def test_where_hardly_anybody_calls_a_liar_counts_for_no_more_than_a_few_hundred() -> None:
    compute, _ = reported(range(60), honest_hz=1, lies_every_s=1)
    assert compute.requests(A, PLAN, 60.0, sample=1).total <= COUNTS_ANYWAY + 3 * 60 + 1


def test_a_change_that_two_robots_see_is_believed_and_that_of_the_only_one_as_well() -> None:
    compute = ComputeTimes(HALF_LIFE_S)
    for second in range(30):
        for robot in HONEST[:2]:
            compute.merge(robot, A, PLAN, histogram(0.02, times=10), float(second))
    slow = histogram(0.4, times=10)
    assert not compute.merge(HONEST[0], A, PLAN, slow, 30.0)
    assert not compute.merge(HONEST[0], A, PLAN, slow, 30.9), "the other one still reports otherwise"
    assert compute.merge(HONEST[1], A, PLAN, slow, 31.0)
    for second in range(32, 60):
        compute.merge(HONEST[0], A, PLAN, slow, float(second))
    assert not compute.merge(HONEST[0], A, PLAN, histogram(0.02, times=10), 60.0)
    assert compute.merge(HONEST[0], A, PLAN, histogram(0.02, times=10), 61.0), "nobody else has reported lately"


def test_a_robot_alone_counts_for_a_thousand_and_is_cut_down_when_others_come() -> None:
    witnesses = Witnesses(HALF_LIFE_S)
    assert witnesses.weigh(EVIL, LIE, 0.0).total == MOST_ALONE
    assert witnesses.weigh(EVIL, LIE, 0.0).total == 0
    assert witnesses.weigh(HONEST[0], histogram(0.02, times=500), 1.0).total == 500
    assert witnesses.weigh(EVIL, LIE, 1.0).total == 0
    name, share = witnesses.largest_share(1.0) or (None, 0.0)
    assert name == EVIL
    assert share == pytest.approx(0.66, abs=0.02)
    assert witnesses.weigh(EVIL, LIE, 300.0).total <= COUNTS_ANYWAY


def test_so_many_witnesses_are_remembered() -> None:
    witnesses = Witnesses(HALF_LIFE_S)
    for number in range(3 * MAX_WITNESSES):
        witnesses.weigh(NodeName(f"robot-{number}"), histogram(0.02), float(number))
        witnesses.accuses(NodeName(f"robot-{number}"))
    assert len(witnesses) == len(witnesses._heard_at) == len(witnesses._accusers) == MAX_WITNESSES
    assert Witnesses(HALF_LIFE_S).largest_share(0.0) is None


@given(
    st.dictionaries(st.integers(0, BUCKETS - 1), st.integers(1, MAX_COUNT // 21), min_size=1, max_size=20),
    st.integers(0, 1000),
    st.floats(0.0, 1.0),
)
def test_what_is_thinned_out_keeps_its_shape(counts: dict[int, int], lost: int, share: float) -> None:
    buckets = sorted(counts)
    whole = Histogram.from_sparse(buckets, [counts[bucket] for bucket in buckets], lost)
    kept = min(int(whole.total * share), 100_000)
    thin = thinned(whole, kept)
    assert thin.total == kept
    exact = whole.counts * (kept / whole.total)
    assert np.all(np.abs(thin.counts - exact) <= 1.0 + 1e-6 * exact)
    assert abs(thin.lost - lost * kept / whole.total) <= 1.0 + 1e-6 * kept
