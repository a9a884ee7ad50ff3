"""Refusals make few events, whoever is refused and under how many names."""

from __future__ import annotations

from plr.controlplane.core.overload.refusal_share import (
    MAX_REFUSED_NAMES,
    REFUSALS_BURST,
    REFUSALS_PER_S,
    TELL_AGAIN_S,
    RefusalShare,
)


def test_one_that_is_refused_all_the_time_is_told_once_a_minute_for_each_reason() -> None:
    refusals = RefusalShare()
    hour_s = 3600
    tried = [refusals.take("robot", "name_taken", float(second)) for second in range(hour_s)]
    told = [left_out for left_out in tried if left_out is not None]
    assert len(told) == hour_s / TELL_AGAIN_S
    assert sum(told) <= refusals.left_out == hour_s - len(told)
    assert told[1] == TELL_AGAIN_S - 1
    assert refusals.take("robot", "version", hour_s) == 0
    assert refusals.take("other", "version", hour_s) == 0


def test_ever_new_names_share_one_rate_and_are_not_all_remembered() -> None:
    refusals = RefusalShare()
    tried = 3 * MAX_REFUSED_NAMES
    taken = sum(refusals.take(f"stranger-{number}", "name_taken", 0.0) is not None for number in range(tried))
    assert taken == REFUSALS_BURST
    assert refusals.left_out == tried - taken
    assert len(refusals) == MAX_REFUSED_NAMES
    assert refusals.take("robot", "name_taken", 1.0) is None
    assert refusals.take("robot", "name_taken", 1.0 + 1.0 / REFUSALS_PER_S) == 1


def test_one_that_is_told_already_takes_nothing_of_the_others() -> None:
    refusals = RefusalShare()
    for _ in range(1000):
        refusals.take("robot", "name_taken", 0.0)
    assert refusals.take("other", "name_taken", 0.0) == 0
