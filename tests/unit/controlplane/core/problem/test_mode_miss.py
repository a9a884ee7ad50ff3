"""The prediction for each way to send copies, from what the estimator knows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from plr.controlplane.core.estimate.late_fate import LateFate
from plr.controlplane.core.estimate.posterior import USUAL_STREAK
from plr.controlplane.core.problem.mode_miss import (
    DELAYS,
    TOGETHER,
    TOGETHER_MISSES,
    PairTiming,
    Sending,
    asked_times,
    miss_of,
    pair_timing,
)
from plr.controlplane.core.problem.objectives import joint_miss
from plr.controlplane.core.problem.problem import Block, BlockKey
from plr.protos.model.ids import InterfaceName, NodeName
from plr.protos.model.redundancy_mode import RedundancyMode
from tests.support.samples import PLAN, use

pytestmark = pytest.mark.audit("ops-12")

NICS = tuple(InterfaceName(name) for name in ("wlan0", "wwan0", "eth0"))
A, B, C = (NodeName(name) for name in "abc")
LAST = len(DELAYS) - 1


def block(*epsilons: float) -> Block:
    """An interface for each, to a server of its own."""
    rows = tuple(tuple(epsilon if i == j else 1.0 for j in range(len(epsilons))) for i, epsilon in enumerate(epsilons))
    return Block(BlockKey(NodeName("robot"), PLAN), NICS[: len(epsilons)], (A, B, C)[: len(epsilons)], rows)


def timing(carried: float, *late: float, delay: int = LAST) -> PairTiming:
    return PairTiming(carried, delay, late)


def sending(*timings: PairTiming, first_missed: float = 0.0, all_missed: float = 0.0) -> Sending:
    pairs = zip(NICS, (A, B, C), strict=True)
    return Sending(dict(zip(pairs, timings, strict=False)), first_missed, all_missed)


def miss(mode: RedundancyMode, of: Block, known: Sending, *, budgeted: bool = False) -> float:
    wanted = replace(use(), redundancy=mode, budgeted=budgeted)
    return miss_of(wanted, of, tuple(range(len(of.interfaces))), known)


TWO = block(0.02, 0.04)
SOON = sending(timing(90.0, 0.02, 0.02, 0.02, 0.02), timing(10.0, 0.5, 0.6, 0.7, 0.8))


def test_replicate_misses_what_all_copies_miss() -> None:
    assert miss(RedundancyMode.REPLICATE, TWO, SOON) == joint_miss(TWO, (0, 1))


def test_single_misses_what_the_pairs_in_use_miss() -> None:
    assert miss(RedundancyMode.SINGLE, TWO, SOON) == pytest.approx(0.9 * 0.02 + 0.1 * 0.04)
    assert miss(RedundancyMode.BACKUP, TWO, SOON) == pytest.approx(0.9 * 0.02 + 0.1 * 0.04)


def test_without_requests_the_worst_pair_stands_for_the_one_in_use() -> None:
    assert miss(RedundancyMode.SINGLE, TWO, sending()) == pytest.approx(0.04)


def test_a_hedge_misses_where_the_second_copy_is_too_late_as_well() -> None:
    first_a, first_b = 0.02 * 0.8, 0.04 * TOGETHER
    assert miss(RedundancyMode.HEDGE, TWO, SOON) == pytest.approx(0.9 * first_a + 0.1 * first_b)
    early = sending(timing(100.0, 0.02, 0.02, 0.02, 0.02, delay=0), timing(0.0, 0.5, 0.6, 0.7, 0.8))
    assert miss(RedundancyMode.HEDGE, TWO, early) == pytest.approx(0.02 * 0.5)
    assert miss(RedundancyMode.ADAPTIVE, TWO, early) == pytest.approx(0.02 * 0.8), "it may wait for half the deadline"


def test_paths_that_fail_together_save_little() -> None:
    together = replace(TWO, lifts={((0, 0), (1, 1)): 20.0})
    assert miss(RedundancyMode.HEDGE, together, SOON) == pytest.approx(0.9 * 0.02 + 0.1 * 0.04 * 20 * 0.02)


def test_a_hedge_goes_over_the_pair_that_the_robot_believes_to_be_the_best() -> None:
    three = block(0.02, 0.001, 0.3)
    known = sending(timing(100.0), timing(50.0, 0.3, 0.3, 0.3, 0.3), timing(50.0, 0.9, 0.9, 0.9, 0.9))
    found = miss(RedundancyMode.HEDGE, three, known)
    assert found == pytest.approx((100 * 0.02 * 0.3 + 50 * 0.001 * 1.0 + 50 * 0.3 * 0.3) / 200)


@pytest.mark.parametrize("mode", [RedundancyMode.HEDGE, RedundancyMode.BACKUP, RedundancyMode.ADAPTIVE])
def test_what_became_of_earlier_requests_counts_for_more_than_what_was_believed(mode: RedundancyMode) -> None:
    steady = sending(timing(100.0, 0.02, 0.02, 0.02, 0.02), timing(0.0, 1.0, 1.0, 1.0, 1.0), first_missed=99.0)
    assert miss(mode, TWO, steady) == pytest.approx(max(0.02 * TOGETHER_MISSES / 100.0, joint_miss(TWO, (0, 1))))
    hopeless = replace(steady, all_missed=99.0)
    assert miss(mode, TWO, hopeless) == pytest.approx(0.02)


def test_nothing_is_promised_that_a_budget_may_keep_back() -> None:
    for mode in RedundancyMode:
        assert miss(mode, TWO, SOON, budgeted=True) == pytest.approx(0.9 * 0.02 + 0.1 * 0.04)


def test_no_mode_misses_less_than_all_copies_at_once() -> None:
    known = sending(timing(100.0, 0.0, 0.0, 0.0, 0.0), timing(0.0, 0.0, 0.0, 0.0, 0.0), first_missed=1e9)
    for mode in RedundancyMode:
        assert miss(mode, TWO, known) >= joint_miss(TWO, (0, 1))


def test_a_hedge_leaves_after_the_quantile_and_by_half_the_deadline() -> None:
    """Answers take 10 ms, one in ten 50 ms, one in fifty never."""
    deadline_s = 0.16
    times = asked_times(deadline_s)
    slower = np.select([times < 0.01, times < 0.05], [1.0, 0.12], 0.02)
    found = pair_timing(7.0, 0.05, slower, 0.85)
    assert found.carried == 7.0
    assert DELAYS[found.delay] * deadline_s == pytest.approx(0.01)
    assert found.late == pytest.approx((0.05, 0.05, 0.05, 0.05)), "a later start costs nothing"
    assert DELAYS[pair_timing(7.0, 0.05, slower, 0.97).delay] == 0.5
    slow = np.select([times < 0.1], [1.0], 0.02)
    assert pair_timing(7.0, 0.02, slow, 0.95).late == pytest.approx((0.02, 0.02, 0.02, 1.0))


def test_of_a_network_that_is_not_known_a_late_copy_promises_nothing() -> None:
    assert pair_timing(7.0, 0.05, None, 0.95) == PairTiming(7.0)
    unknown = sending(timing(100.0), timing(0.0))
    assert miss(RedundancyMode.HEDGE, TWO, unknown) == pytest.approx(0.02)


def test_first_copies_are_reckoned_from_the_sample_that_is_measured() -> None:
    fate = LateFate(0.0)
    assert fate.counts(0.0) == (0.0, 0.0)
    fate.add_first(100.0, 10.0, 0.0)
    assert fate.counts(0.0) == (0.0, 0.0)
    fate.add_requests(800.0, 20.0, 0.0)
    assert fate.counts(0.0) == pytest.approx((80.0 / USUAL_STREAK, 20.0 / USUAL_STREAK))
    first, every = fate.counts(600.0)
    assert (first, every) == pytest.approx((40.0 / USUAL_STREAK, 10.0 / USUAL_STREAK))
    assert math.isclose(every / first, 0.25)
