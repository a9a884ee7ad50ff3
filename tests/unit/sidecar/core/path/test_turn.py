from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.core.path.turn import PATIENCE, SMALL, Turn
from tests.support.builders import message

if TYPE_CHECKING:
    from plr.sidecar.core.message.symbols import MessageSymbols

SIZE, PACE, ROUND_TRIP_S = 100_000, 200_000.0, 0.1
"""Half a second to send, 0.6 s to the answer."""


def copies(*, deadline: float = 2.0) -> tuple[MessageSymbols, MessageSymbols]:
    """A request's copies over two paths."""
    shared: list[MessageSymbols] = []
    one = message(1, SIZE, deadline=deadline, siblings=shared)
    other = message(2, SIZE, deadline=deadline, siblings=shared)
    return one, other


def covered_until(turn: Turn, now: float = 0.0, pace: float = PACE) -> float | None:
    return turn.covered_until(now, pace, ROUND_TRIP_S)


def test_a_copy_tells_its_siblings_when_to_expect_its_answer() -> None:
    one, other = copies()
    turn = Turn(one)
    turn.take(1000)
    turn.goes_on(0.0, PACE, ROUND_TRIP_S)
    assert one.expected_at == pytest.approx(ROUND_TRIP_S), "all of it has been taken"
    half = Turn(other)
    half.take(other.count // 2)
    half.goes_on(1.0, PACE, ROUND_TRIP_S)
    assert other.expected_at == pytest.approx(1.0 + 0.25 + ROUND_TRIP_S, rel=0.02)


def test_what_is_expected_sooner_elsewhere_is_left_to_it_until_overdue() -> None:
    one, other = copies()
    other.expected_at = 0.4
    overdue_at = 0.4 + PATIENCE * (2.0 - 0.4)
    for now in (0.0, 0.39, overdue_at - 0.01):
        assert covered_until(Turn(one), now) == pytest.approx(overdue_at)
    assert covered_until(Turn(one), overdue_at) is None


@pytest.mark.parametrize(
    ("expected_at", "why"), [(NEVER, "not being sent"), (0.7, "later than here"), (2.1, "too late")]
)
def test_it_is_not_left_to_a_path_that_is_no_better(expected_at: float, why: str) -> None:
    one, other = copies()
    other.expected_at = expected_at
    assert covered_until(Turn(one)) is None, why


def test_it_is_left_to_a_path_that_makes_the_deadline_which_this_one_does_not() -> None:
    one, other = copies(deadline=0.5)
    other.expected_at = 0.45
    assert covered_until(Turn(one)) is not None
    other.expected_at = 0.55
    assert covered_until(Turn(one)) is None, "both too late"


def test_what_is_small_is_not_left_to_others() -> None:
    one, other = copies()
    other.expected_at = 0.01
    fast = SIZE / (SMALL * 2.0)
    assert covered_until(Turn(one), pace=1.1 * fast) is None
    assert covered_until(Turn(one), pace=0.9 * fast) is not None
    rest = Turn(one)
    rest.take(int(0.7 * one.count))
    assert covered_until(rest) is None, "what is nearly finished is small"


def test_without_siblings_or_a_known_pace_nothing_is_left_to_others() -> None:
    alone = message(1, SIZE)
    alone.expected_at = 0.1
    assert covered_until(Turn(alone)) is None
    one, other = copies()
    other.expected_at = 0.1
    assert covered_until(Turn(one), pace=0.0) is None


def test_what_has_to_wait_is_not_expected_any_more() -> None:
    one, other = copies()
    turn = Turn(other)
    turn.take(1)
    turn.goes_on(0.0, PACE, 0.0)
    assert covered_until(Turn(one)) is not None
    turn.waits()
    assert covered_until(Turn(one)) is None


def test_what_was_cut_again_is_no_rival_of_what_it_became() -> None:
    one, other = copies()
    one.expected_at = 0.1
    successor = one.cut_again(3, 1000)
    assert covered_until(Turn(successor)) is None
    other.expected_at = 0.1
    assert covered_until(Turn(successor)) is not None


def test_what_may_get_no_answer_is_not_relied_on() -> None:
    one, other = copies()
    other.expected_at = 0.1
    other.stand_down()
    assert covered_until(Turn(one)) is None
    other.stand_down()  # also twice
    assert one.siblings == [one]
