from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.core.base.values import SHARE, Priority
from plr.sidecar.core.path.send_queue import PURGE_AT, SendQueue
from plr.sidecar.core.path.turn import MAX_RUN, MAX_RUN_BYTES
from plr.sidecar.core.wire.frame import FRAGMENT_OVERHEAD_BYTES
from tests.support.builders import message

if TYPE_CHECKING:
    from plr.sidecar.core.message.symbols import MessageSymbols

ONE = 1
"""A budget for one symbol."""
MUCH = 1_000_000
PACE = 100_000.0


def drain(queue: SendQueue, now: float = 0.0, budget: int = ONE) -> list[tuple[int, int]]:
    out = []
    while (run := queue.take(now, budget)) is not None:
        out += [(run.message.number, index) for index in range(run.first, run.first + run.symbols)]
    return out


def take(queue: SendQueue, now: float = 0.0, budget: int = ONE, pace: float = 0.0) -> tuple[int, int, int]:
    run = queue.take(now, budget, pace)
    assert run is not None
    return run.message.number, run.first, run.symbols


def test_earliest_deadline_first_and_in_order_of_coming_among_equals() -> None:
    queue = SendQueue()
    for number, deadline in ((1, 5.0), (2, 3.0), (3, 3.0)):
        queue.add(message(number, deadline=deadline))
    assert drain(queue) == [(number, index) for number in (2, 3, 1) for index in range(3)]
    assert len(queue) == 0


def test_an_urgent_message_overtakes_one_half_sent() -> None:
    queue = SendQueue()
    queue.add(message(1, deadline=5.0))
    assert take(queue) == (1, 0, 1)
    queue.add(message(2, 10, deadline=1.0))
    assert drain(queue) == [(2, 0), (1, 1), (1, 2)]


def test_a_run_is_what_the_budget_and_one_offload_take() -> None:
    queue = SendQueue()
    large = message(1, 500_000)
    queue.add(large)
    datagram = large.symbol + FRAGMENT_OVERHEAD_BYTES
    assert take(queue, budget=3 * datagram + 5) == (1, 0, 3)
    assert take(queue, budget=0) == (1, 3, 1)
    symbols = min(MAX_RUN, MAX_RUN_BYTES // datagram)
    assert take(queue, budget=MUCH) == (1, 4, symbols)


def test_a_run_ends_where_a_symbol_has_arrived() -> None:
    queue, outbound = SendQueue(), message(1, 12_000)
    queue.add(outbound)
    outbound.acked[0] = outbound.acked[4] = outbound.acked[5] = 1
    assert take(queue, budget=MUCH) == (1, 1, 3)
    assert take(queue, budget=MUCH) == (1, 6, outbound.count - 6)
    assert queue.take(0.0, MUCH) is None


def test_a_resend_goes_first_within_its_message_and_alone_when_the_message_left() -> None:
    queue, outbound = SendQueue(), message()
    queue.add(outbound)
    assert take(queue) == (1, 0, 1)
    queue.resend(outbound, (0,))
    assert drain(queue) == [(1, 0), (1, 1), (1, 2)]
    queue.resend(outbound, (1,))
    assert drain(queue) == [(1, 1)]


def test_neighbours_to_be_sent_again_make_a_run() -> None:
    queue, outbound = SendQueue(), message(1, 12_000)
    queue.resend(outbound, (1, 2, 3, 7))
    outbound.acked[3] = 1
    assert take(queue, budget=MUCH) == (1, 1, 2)
    assert take(queue, budget=MUCH) == (1, 7, 1)


def test_adding_twice_sends_once() -> None:
    queue, outbound = SendQueue(), message()
    queue.add(outbound)
    queue.add(outbound)
    assert len(drain(queue)) == 3


def test_what_was_acknowledged_or_is_over_does_not_leave() -> None:
    queue, one, two = SendQueue(), message(1), message(2)
    queue.add(one)
    queue.add(two)
    one.acked[1] = 1
    two.over = True
    assert drain(queue) == [(1, 0), (1, 2)]
    assert queue.expired == 0


def test_the_expired_are_dropped_and_counted() -> None:
    queue = SendQueue()
    queue.add(message(1, expires=20.0))
    queue.add(message(2, expires=30.0))
    assert drain(queue, now=20.0) == [(2, 0), (2, 1), (2, 2)]
    assert queue.expired == 1


def test_what_is_over_holds_no_memory_although_it_never_comes_up() -> None:
    queue = SendQueue()
    first = message(0, deadline=0.0)
    queue.add(first)
    for number in range(1, 10 * PURGE_AT):
        outbound = message(number, 10)
        queue.add(outbound)
        outbound.over = True
        assert len(queue) <= PURGE_AT + 1
    assert drain(queue) == [(0, 0), (0, 1), (0, 2)]


@pytest.mark.audit("dp-13")
def test_of_the_late_the_oldest_that_can_still_be_of_use_goes_first() -> None:
    queue = SendQueue()
    for number, deadline, expires in ((1, 1.0, 5.1), (2, 2.0, 5.4), (3, 3.0, 13.0), (4, 4.0, 14.0), (5, 5.5, 15.0)):
        queue.add(message(number, 50_000, deadline=deadline, expires=expires))
    order = []
    while (run := queue.take(5.0, MUCH, PACE)) is not None:
        order += [run.message.number] * (run.message.number not in order)
    assert order == [5, 3, 4, 2, 1], "what cannot arrive before it expires goes last, in case the pace rises"


@pytest.mark.audit("dp-13")
def test_of_what_is_hopeless_at_this_pace_the_oldest_goes_first() -> None:
    queue = SendQueue()
    for number in (1, 2, 3):
        queue.add(message(number, 150_000, deadline=number * 0.2, expires=100.0))
    assert take(queue, pace=PACE)[0] == 1
    assert take(queue, now=1.0, pace=PACE)[0] == 1


@pytest.mark.audit("dp-13")
def test_what_seemed_hopeless_is_fresh_again_when_the_pace_rises() -> None:
    queue = SendQueue()
    for number, size, deadline in ((1, 400_000, 1.0), (2, 150_000, 1.1), (3, 120_000, 1.2)):
        queue.add(message(number, size, deadline=deadline, expires=100.0))
    assert take(queue, pace=PACE)[0] == 1
    assert take(queue, now=0.1, pace=PACE)[0] == 1
    assert take(queue, now=0.1, pace=2 * PACE)[0] == 2
    assert take(queue, now=0.1, pace=2 * PACE)[0] == 2


def test_what_seemed_hopeless_is_not_remembered_when_it_has_left() -> None:
    queue = SendQueue()
    for number in range(1, 2000):
        queue.add(message(number, 100, deadline=number + 0.001, expires=1e9))
        assert take(queue, now=float(number), pace=PACE)[0] == number
    held = queue._classes[Priority.NORMAL].newest
    assert len(held) <= 2 * PURGE_AT


def test_the_late_wait_for_all_that_can_still_make_it() -> None:
    queue = SendQueue()
    for number, deadline in ((1, 1.0), (2, 2.0), (3, 6.0), (4, 7.0)):
        queue.add(message(number, 10, deadline=deadline))
    assert drain(queue, now=5.0) == [(3, 0), (4, 0), (1, 0), (2, 0)]


def test_what_is_begun_is_finished_before_newer_late_ones() -> None:
    queue = SendQueue()
    queue.add(message(1, deadline=1.0))
    assert take(queue, now=5.0) == (1, 0, 1)
    queue.add(message(2, 10, deadline=2.0))
    queue.add(message(3, 10, deadline=9.0))
    assert drain(queue, now=5.0) == [(3, 0), (1, 1), (1, 2), (2, 0)]


def test_what_can_not_make_it_at_this_pace_is_late_already() -> None:
    queue = SendQueue()
    queue.add(message(1, 150_000, deadline=1.0))
    queue.add(message(2, 50_000, deadline=1.5))
    assert take(queue, pace=PACE)[0] == 2
    assert take(queue, pace=PACE)[0] == 2


def test_what_came_too_late_waits_also_for_what_is_hopeless_at_this_pace() -> None:
    """After an outage: the backlog, then a large message that a low first pace makes look hopeless."""
    queue = SendQueue()
    for number in (1, 2):
        queue.add(message(number, 10_000, deadline=1.0))
    assert take(queue, now=5.0, pace=PACE)[0] == 1
    queue.add(message(3, 150_000, deadline=5.1))
    for now in (5.0, 5.2):
        assert take(queue, now=now, pace=PACE)[0] == 3, "also when its deadline is over by now"


def test_what_is_begun_is_finished_when_it_just_makes_it() -> None:
    def second_taken(*, begin: bool) -> int:
        queue = SendQueue()
        queue.add(message(1, 100_000, deadline=1.15))
        if begin:
            assert take(queue)[0] == 1
        queue.add(message(2, 10, deadline=2.0))
        return take(queue, pace=PACE)[0]

    assert second_taken(begin=True) == 1
    assert second_taken(begin=False) == 2


def test_a_higher_priority_goes_before_an_earlier_deadline() -> None:
    queue = SendQueue()
    queue.add(message(1, 10, priority=Priority.LOW, deadline=1.0))
    queue.add(message(2, 10, priority=Priority.NORMAL, deadline=2.0))
    queue.add(message(3, 10, priority=Priority.HIGH, deadline=3.0))
    assert drain(queue) == [(3, 0), (2, 0), (1, 0)]


def test_a_lower_priority_gets_its_share_whatever_the_higher_ones_have() -> None:
    queue = SendQueue()
    for priority in Priority:
        queue.add(message(priority, 3_000_000, priority=priority))
    turns = [take(queue) for _ in range(10 * (SHARE + 1))]
    by_priority = [sum(symbols for number, _, symbols in turns if number == priority) for priority in Priority]
    assert by_priority[Priority.HIGH] > 0.8 * len(turns)
    assert min(by_priority) >= len(turns) // (2 * SHARE)


def test_a_lower_priority_has_no_claim_from_before_it_waited() -> None:
    queue = SendQueue()
    queue.add(message(1, 300_000, priority=Priority.HIGH))
    for _ in range(2 * SHARE):
        take(queue)
    queue.add(message(2, 10, priority=Priority.LOW))
    assert take(queue)[0] == 1


def test_clearing_hands_back_what_did_not_leave_and_only_that() -> None:
    queue = SendQueue()
    flying, done, over = message(1), message(2, 10), message(3)
    for outbound in (flying, done, over):
        queue.add(outbound)
    assert take(queue) == (1, 0, 1)
    done.acked[0] = 1
    over.over = True
    assert left(queue) == [(1, (1, 2))]
    assert len(queue) == 0
    assert queue.take(0.0, MUCH) is None


def left(queue: SendQueue) -> list[tuple[int, tuple[int, ...]]]:
    cleared: list[tuple[MessageSymbols, tuple[int, ...]]] = queue.clear()
    return [(outbound.number, indices) for outbound, indices in cleared]


def covered(number: int, *, expected_at: float, size: int = 60_000, deadline: float = 4.0) -> MessageSymbols:
    """A copy whose request another path answers at this time."""
    sibling = message(100 + number, size, deadline=deadline, siblings=[])
    sibling.expected_at = expected_at
    return message(number, size, deadline=deadline, siblings=sibling.siblings)


def test_what_another_path_answers_in_time_waits_for_all_else_but_does_not_wait_alone() -> None:
    queue = SendQueue()
    queue.add(covered(1, expected_at=0.001))
    queue.add(message(2, 10, deadline=5.0))
    queue.add(message(3, 10, deadline=-1.0))
    assert [take(queue, pace=PACE)[0] for _ in range(3)] == [2, 3, 1]


def test_what_another_path_does_not_answer_when_expected_takes_its_turn_again() -> None:
    queue = SendQueue()
    queue.add(covered(1, expected_at=0.001))
    queue.add(covered(2, expected_at=0.004, deadline=3.0))
    queue.add(message(3, 900_000, deadline=20.0))
    assert take(queue, pace=PACE)[0] == 3
    assert take(queue, now=1.4, pace=PACE)[0] == 3
    assert take(queue, now=1.6, pace=PACE)[0] == 2
    assert take(queue, now=2.1, pace=PACE)[0] == 2, "its deadline is earlier"


def test_nothing_is_expected_of_what_is_put_off_or_cleared() -> None:
    queue, first = SendQueue(), message(1, 60_000, deadline=4.0, siblings=[])
    second = message(2, 60_000, deadline=4.0, siblings=first.siblings)
    queue.add(first)
    assert take(queue, pace=PACE)[0] == 1
    assert first.expected_at < 4.0
    second.expected_at = 0.001
    queue.add(message(3, 10, deadline=5.0))
    assert take(queue, pace=PACE)[0] == 3
    assert first.expected_at == NEVER
    queue.add(last := message(4))
    assert take(queue, pace=PACE)[0] == 4
    assert last.expected_at < NEVER
    queue.clear()
    assert last.expected_at == NEVER
