"""Whether two interfaces are said to fail together, from requests in seeded streaks of trouble."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.core.estimate.shared_fate import HALF_LIFE_S, SharedFate
from plr.protos.model.explanation import Correlation
from plr.protos.model.ids import InterfaceName, ServiceName
from plr.protos.model.report import InterfaceJointReport
from plr.sidecar.core.robot.measure.measurements import InterfacePair, JointCounts, PairOutcome

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.controlplane.core.estimate.shared_fate import CommonMisses

RATE_HZ = 5
PAIR = InterfacePair(ServiceName("/plan"), InterfaceName("wlan0"), InterfaceName("wwan0"), None)


def trouble(rng: random.Random, seconds: int, *, every_s: float, lasts_s: float) -> list[bool]:
    """Whether each of 5 requests a second meets trouble, which mostly comes and lasts so many seconds."""
    bad, states = False, []
    for _ in range(seconds * RATE_HZ):
        bad = rng.random() >= 1 / (lasts_s * RATE_HZ) if bad else rng.random() < 1 / (every_s * RATE_HZ)
        states.append(bad)
    return states


def known(missed: Iterator[tuple[bool, bool]], rng: random.Random) -> CommonMisses:
    """Reported every second, one request in eight being a race."""
    fate, now, counts = SharedFate(0.0), 0.0, JointCounts()
    for number, (first, second) in enumerate(missed, 1):
        counts.add(PairOutcome(first, second, raced=rng.random() < 1 / 8))
        if number % RATE_HZ == 0:
            now += 1.0
            fate.add(counts.report(PAIR), now)
            counts = JointCounts()
    found = fate.common_misses(now)
    assert found is not None
    return found


def drive(seed: int, *, shared: bool) -> CommonMisses:
    """240 s in which each interface is in trouble for a fifth of the time, its own or mostly that of the other."""
    rng = random.Random(seed)
    first, second = (trouble(rng, 240, every_s=24.0, lasts_s=6.0) for _ in range(2))
    if shared:
        alone = trouble(rng, 240, every_s=60.0, lasts_s=3.0)
        second = [common or here for common, here in zip(first, alone, strict=True)]
    return known(zip(first, second, strict=True), rng)


def test_trouble_that_is_shared_is_told_from_trouble_that_meets_by_chance() -> None:
    alone = [drive(seed, shared=False).correlation for seed in range(40)]
    shared = [drive(seed, shared=True).correlation for seed in range(40)]
    assert alone.count(Correlation.TOGETHER) <= 1
    assert alone.count(Correlation.LIKELY) <= 3
    assert shared.count(Correlation.INDEPENDENT) <= 2
    assert shared.count(Correlation.TOGETHER) >= 26


def test_what_missed_on_each_is_estimated_from_races_and_common_misses() -> None:
    rng = random.Random(1)
    found = known(((n % 10 == 0, n % 10 == 0 or n % 5 == 1) for n in range(3000)), rng)
    fading = 1 - 600 / HALF_LIFE_S * 0.3
    assert found.requests == pytest.approx(3000 * fading, rel=0.1)
    assert found.both_missed / found.requests == pytest.approx(0.1, rel=0.05)
    assert found.first_missed / found.requests == pytest.approx(0.1, rel=0.1)
    assert found.second_missed / found.requests == pytest.approx(0.3, rel=0.2)
    assert found.correlation is Correlation.TOGETHER


def test_a_single_streak_of_common_misses_is_no_proof() -> None:
    rng = random.Random(1)
    both = [200 <= n < 230 for n in range(600)]
    first = [missed or 400 <= n < 460 for n, missed in enumerate(both)]
    second = [missed or 500 <= n < 560 for n, missed in enumerate(both)]
    found = known(zip(first, second, strict=True), rng)
    assert found.both_missed > 20
    assert found.correlation is Correlation.INDEPENDENT


def test_interfaces_that_never_or_always_miss_prove_nothing() -> None:
    rng = random.Random(1)
    assert known(iter([(False, False)] * 600), rng).correlation is Correlation.INDEPENDENT
    assert known(iter([(True, True)] * 600), rng).correlation is Correlation.INDEPENDENT
    assert known(iter([(True, False)] * 600), rng).correlation is Correlation.INDEPENDENT


def test_old_requests_are_forgotten() -> None:
    fate = SharedFate(0.0)
    assert fate.common_misses(0.0) is None
    fate.add(InterfaceJointReport(PAIR.service, PAIR.first, PAIR.second, None, 1000, 100, 500, 50, 50), 0.0)
    half, gone = fate.common_misses(HALF_LIFE_S), fate.common_misses(100 * HALF_LIFE_S)
    assert half is not None
    assert half.requests == pytest.approx(500.0)
    assert gone is None
