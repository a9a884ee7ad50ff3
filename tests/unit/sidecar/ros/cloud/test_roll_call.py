"""Who is taken for silent: who answers neither calls nor requests."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.sidecar.ros.cloud import roll_call
from plr.sidecar.ros.cloud.roll_call import CALL_S, CALLS_MISSED, RollCall
from tests.support.participant_messages import endpoint, participant_info

if TYPE_CHECKING:
    from collections.abc import Iterator

PLAN, NEGATE, OTHER = endpoint(7, 3), endpoint(7, 4), endpoint(8, 3)


class Topic:
    """One that a test answers."""

    usable = True
    said: tuple[bytes, ...] = ()

    def __init__(self, _node: object) -> None:
        self.is_open = False

    def open(self) -> bool:
        self.is_open = True
        return True

    def take(self) -> Iterator[bytes]:
        yield from self.said

    def close(self) -> None:
        self.is_open = False


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> RollCall:
    """Of processes none of which waits for a processor."""
    monkeypatch.setattr(roll_call, "DiscoveryTopic", Topic)
    return RollCall(None, lambda _participant: False)


def call(calls: RollCall, now: float) -> bool:
    """Make one call of both, to its end."""
    assert not calls.turn((PLAN, OTHER), now)
    return calls.turn((PLAN, OTHER), now + CALL_S)


def miss(calls: RollCall) -> float:
    """Make so many calls that whoever answers none is silent; return when the last one ended."""
    changed = [call(calls, number * (CALL_S + 1.0)) for number in range(CALLS_MISSED)]
    assert changed == [False] * (CALLS_MISSED - 1) + [True]
    return CALLS_MISSED * (CALL_S + 1.0)


@pytest.mark.audit("dp-15")
def test_silence_is_of_the_whole_process(calls: RollCall, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Topic, "said", (participant_info(8, []),))
    miss(calls)
    assert calls.is_silent(PLAN)
    assert calls.is_silent(NEGATE)
    assert not calls.has_ever_heard(PLAN)
    assert calls.has_ever_heard(OTHER)
    assert not calls.is_silent(OTHER)


@pytest.mark.audit("dp-15")
def test_an_answer_to_a_request_is_a_sign_of_life(calls: RollCall) -> None:
    now = miss(calls)
    assert calls.answered(NEGATE, now)
    assert not calls.is_silent(PLAN)
    assert calls.is_silent(OTHER)
    assert calls.has_heard(PLAN, now)
    assert not calls.answered(PLAN, now + 1.0), "nothing changed"
    assert not call(calls, now + 2.0), "one call missed is no silence"
    assert not calls.is_silent(PLAN)
    calls.keep((OTHER,))
    assert not calls.has_ever_heard(PLAN)
