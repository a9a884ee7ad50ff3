from __future__ import annotations

import pytest

from plr.sidecar.core.path.congestion.rtt import LONGEST_ANSWER_S, RttEstimator
from plr.sidecar.core.path.in_flight import Sent
from plr.sidecar.core.path.reordering import MAX_LOST_RUNS, PACKET_THRESHOLD, PERSISTS, Reordering
from plr.sidecar.core.wire.frame import MAX_ACK_RANGES
from tests.support.builders import message


def steady() -> RttEstimator:
    rtt = RttEstimator()
    for at in range(50):
        rtt.sample(0.1, at / 10)
    return rtt


def run(first: int, count: int = 1, at: float = 10.0, symbol: int = 0) -> Sent:
    return Sent(first, count, at, 100, 60, message(), symbol)


def test_without_reordering_the_standard_thresholds_hold() -> None:
    known = Reordering()
    rtt = steady()
    known.note_lost([run(1)], by_threshold=True)
    assert known.late([(5, 9)], rtt, 10.1) == []
    assert known.packet_threshold == PACKET_THRESHOLD
    assert known.loss_delay(rtt) == rtt.loss_delay()


def test_a_late_acknowledgement_leaves_only_time_to_judge_and_more_of_it() -> None:
    known = Reordering()
    rtt = steady()
    known.note_lost([run(1)], by_threshold=True)
    assert [part.first for part in known.late([(1, 1)], rtt, 10.15)] == [1]
    assert known.spurious == 1
    assert known.packet_threshold is None
    assert known.loss_delay(rtt) == pytest.approx(0.15)
    assert known.late([(1, 1)], rtt, 10.16) == [], "told once"


def test_the_wait_grows_by_one_round_trip_at_most() -> None:
    known = Reordering()
    rtt = steady()
    known.note_lost([run(1)], by_threshold=True)
    known.late([(1, 1)], rtt, 10.35)
    assert known.loss_delay(rtt) <= rtt.loss_delay() + rtt.smoothed


def test_a_probe_timeout_that_was_too_early_says_nothing_of_the_order() -> None:
    known = Reordering()
    known.note_lost([run(1)], by_threshold=False)
    assert known.late([(1, 1)], steady(), 10.2)
    assert known.spurious == 1
    assert known.packet_threshold == PACKET_THRESHOLD


def test_losses_that_stay_losses_make_it_forget() -> None:
    known = Reordering()
    rtt = steady()
    known.note_lost([run(1)], by_threshold=True)
    known.late([(1, 1)], rtt, 10.15)
    for number in range(PERSISTS):
        assert known.packet_threshold is None
        known.note_lost([run(100 + number)], by_threshold=True)
    assert known.packet_threshold == PACKET_THRESHOLD
    assert known.loss_delay(rtt) == rtt.loss_delay()


def test_parts_of_runs_turn_up_one_after_the_other() -> None:
    known = Reordering()
    rtt = steady()
    known.note_lost([run(10, 10, symbol=30)], by_threshold=True)
    parts = known.late([(18, 25), (12, 13)], rtt, 10.12)
    assert [(part.first, part.indices, part.size) for part in parts] == [
        (12, range(32, 34), 200),
        (18, range(38, 40), 160),
    ]
    assert [(part.first, part.end) for part in known.late([(10, 19)], rtt, 10.13)] == [(10, 12), (14, 18)]
    assert known.spurious == 10
    assert known.late([(0, 99)], rtt, 10.14) == []


def test_what_is_remembered_is_bounded_and_forgotten_in_time() -> None:
    known = Reordering()
    rtt = steady()
    known.note_lost([run(number) for number in range(10 * MAX_LOST_RUNS)], by_threshold=True)
    assert len(known.late([(0, 10 * MAX_LOST_RUNS)], rtt, 10.1)) == MAX_LOST_RUNS
    known.note_lost([run(1), run(2, at=99.9)], by_threshold=True)
    known.forget_old(100.0)
    assert [part.first for part in known.late([(0, 9)], rtt, 100.0)] == [2]


@pytest.mark.audit("dp-2")
def test_what_a_timeout_gave_up_is_missed_only_once_something_later_arrived() -> None:
    known = Reordering()
    known.note_lost([run(1), run(2)], by_threshold=False)
    assert known.missed == 0
    known.overtaken(2)
    assert known.missed == 1
    assert known.late([(2, 2)], steady(), 14.0), "a slow path, not a loss"
    known.overtaken(9)
    assert known.missed == 1
    assert known.late([(1, 1)], steady(), 14.1)
    assert (known.missed, known.spurious) == (0, 2)


@pytest.mark.audit("dp-2")
def test_what_a_path_carried_when_it_went_down_may_turn_up_and_was_never_missed() -> None:
    known = Reordering()
    known.note_given_up([run(1), run(2)])
    assert [part.first for part in known.late([(1, 1)], steady(), 10.0 + 0.9 * LONGEST_ANSWER_S)] == [1]
    assert known.packet_threshold == PACKET_THRESHOLD
    known.overtaken(9)
    assert known.missed == 0
    known.forget()
    assert known.late([(2, 2)], steady(), 10.1) == []


def test_no_message_that_is_over_is_held() -> None:
    known = Reordering()
    given_up = run(1)
    known.note_given_up([given_up])
    assert given_up.message is not None
    given_up.message.over = True
    known.forget_old(10.1)
    assert known.remembers
    (late,) = known.late([(1, 1)], steady(), 10.2)
    assert late.message is None
    assert not known.remembers


@pytest.mark.audit("dp-2")
def test_ranges_that_acknowledge_nothing_are_hardly_looked_at() -> None:
    """A peer may say 32 of them in each datagram, of its choice, while the most that can be is remembered."""
    looked_at = 0

    class Numbers(int):
        """A range's end that counts how often it is compared."""

        def __lt__(self, other: int) -> bool:
            nonlocal looked_at
            looked_at += 1
            return int(self) < int(other)

        def __add__(self, other: int) -> int:
            nonlocal looked_at
            looked_at += 1
            return int(self) + other

    known = Reordering()
    known.note_lost([run(1000 + 4 * number) for number in range(MAX_LOST_RUNS)], by_threshold=True)
    none = [(number, Numbers(number)) for number in range(990, 990 - 2 * MAX_ACK_RANGES, -2)]
    assert known.late(none, steady(), 10.1) == []
    assert looked_at <= 7 * MAX_LOST_RUNS, "not 32 times as often"
    assert len(known.late([(1000, 1004), (0, 9)], steady(), 10.1)) == 2
