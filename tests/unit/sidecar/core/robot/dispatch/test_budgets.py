"""What is earned, what is spent, and that nothing else is."""

from __future__ import annotations

import random

import pytest

from plr.sidecar.core.robot.dispatch.budgets import DAY_S, MAX_SAVED_BYTES, Budgets
from plr.sidecar.core.rules.budget import Budget
from plr.sidecar.core.seam.stats import EngineStats
from tests.support.builders import ECHO, WLAN, WWAN


def spend(budgets: Budgets, size: int, now: float = 0.0) -> bool:
    if not budgets.allows(WLAN, ECHO, size, now):
        return False
    budgets.spend(WLAN, size)
    return True


@pytest.mark.parametrize("seed", range(5))
def test_extra_load_never_exceeds_its_share_of_what_was_answered(seed: int) -> None:
    rng, budgets = random.Random(seed), Budgets((Budget("wlan*", extra_load=0.1),), EngineStats())
    answered = extra = 0
    for _ in range(2000):
        size = rng.randrange(1, 100_000)
        if rng.random() < 0.7:
            budgets.earn(size, {WLAN})
            answered += size
        elif spend(budgets, size):
            extra += size
        assert extra <= 0.1 * answered + 1e-6 * answered
    assert extra > 0.05 * answered


def test_nothing_is_earned_while_nothing_is_answered() -> None:
    stats = EngineStats()
    budgets = Budgets((Budget("wlan*", extra_load=1.0),), stats)
    budgets.earn(1000, {WLAN})
    assert [spend(budgets, 600), spend(budgets, 600), spend(budgets, 400), spend(budgets, 1)] == [
        True,
        False,
        True,
        False,
    ]
    assert stats.copies_refused == {(WLAN, ECHO, "load"): 2}


def test_what_is_saved_is_bounded() -> None:
    budgets = Budgets((Budget("wlan*", extra_load=10.0),), EngineStats())
    budgets.earn(MAX_SAVED_BYTES, {WLAN})
    assert spend(budgets, MAX_SAVED_BYTES)
    assert not spend(budgets, 1)


def test_a_day_has_so_many_bytes() -> None:
    stats = EngineStats()
    budgets = Budgets((Budget("wlan*", extra_bytes_a_day=1000),), stats)
    assert [spend(budgets, 600, 5.0), spend(budgets, 401, 6.0), spend(budgets, 400, 7.0)] == [True, False, True]
    assert not spend(budgets, 1, 5.0 + DAY_S - 0.1)
    assert spend(budgets, 1000, 5.0 + DAY_S)
    assert stats.copies_refused == {(WLAN, ECHO, "day"): 2}


def test_the_first_entry_that_matches_decides_and_others_are_free() -> None:
    budgets = Budgets((Budget("wlan*"), Budget("*", extra_load=0.0)), EngineStats())
    assert budgets.limit
    assert budgets.allows(WLAN, ECHO, 10**9, 0.0)
    assert not budgets.allows(WWAN, ECHO, 1, 0.0)
    assert not Budgets((Budget("*"),), EngineStats()).limit
