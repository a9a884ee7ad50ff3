"""How often one name may call."""

from __future__ import annotations

import pytest

from plr.controlplane.serve.access import CALLS_BURST, CALLS_PER_S, LONGEST_WAIT_S, CallRates


@pytest.mark.audit("ops-16")
def test_who_calls_now_and_then_never_waits() -> None:
    rates = CallRates()
    assert all(rates.take_turn("robot", second / CALLS_PER_S) == 0.0 for second in range(1000))


@pytest.mark.audit("ops-16")
def test_a_burst_is_answered_at_once_then_each_call_has_its_turn() -> None:
    rates = CallRates()
    waits = [rates.take_turn("robot", 0.0) for _ in range(int(CALLS_BURST) + 3)]
    assert waits[: int(CALLS_BURST)] == [0.0] * int(CALLS_BURST)
    assert waits[int(CALLS_BURST) :] == pytest.approx([number / CALLS_PER_S for number in (1, 2, 3)])
    assert rates.take_turn("other", 0.0) == 0.0


@pytest.mark.audit("ops-16")
def test_calls_that_would_wait_too_long_are_refused_and_leave_the_turns_to_others() -> None:
    rates = CallRates()
    for _ in range(10_000):
        rates.take_turn("robot", 0.0)
    assert rates.take_turn("robot", 0.0) is None
    wait_s = rates.take_turn("robot", 1.0)
    assert wait_s is not None
    assert wait_s <= LONGEST_WAIT_S
    assert rates.take_turn("robot", 2 * LONGEST_WAIT_S + CALLS_BURST / CALLS_PER_S) == 0.0
