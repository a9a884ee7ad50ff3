"""How often one name may call."""

from __future__ import annotations

import asyncio

import pytest

from plr.controlplane.serve import access
from plr.controlplane.serve.access import CALLS_BURST, CALLS_PER_S, LONGEST_WAIT_S, CallRates, first_words


class Context:
    """One call's; the client sends its first message after a while, or never."""

    def __init__(self, delay_s: float | None) -> None:
        self._delay_s = delay_s
        self.read_it = False

    async def read(self) -> bytes:
        await asyncio.sleep(3600.0 if self._delay_s is None else self._delay_s)
        self.read_it = True
        return b"words"


@pytest.mark.parametrize(("delay_s", "arrives"), [(0.0, True), (0.01, True), (None, False)])
def test_the_first_message_of_a_refused_call_is_awaited_but_not_for_ever(
    monkeypatch: pytest.MonkeyPatch, delay_s: float | None, arrives: bool
) -> None:
    if not arrives:
        monkeypatch.setattr(access, "FIRST_WORDS_S", 0.01)
    context = Context(delay_s)
    asyncio.run(first_words(context))
    assert context.read_it == arrives


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
