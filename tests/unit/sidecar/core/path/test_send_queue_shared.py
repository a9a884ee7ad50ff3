"""One message on the queues of two paths that carry it together."""

from __future__ import annotations

import pytest

from plr.sidecar.core.base.values import Priority
from plr.sidecar.core.message.sharing import OFFER_S
from plr.sidecar.core.message.symbols import MessageSymbols
from plr.sidecar.core.path.send_queue import LOOK_AT_LEAST_EVERY_S, PURGE_AT, SendQueue
from plr.sidecar.core.path.turn import LOOK_AGAIN_S
from plr.sidecar.core.wire.messages import Encoded
from tests.support.builders import message

ONE = 1
"""A budget for one symbol."""
MUCH = 1_000_000
PACE = 1_000_000.0
RTT_S = 0.02


def shared(repeats: float = 1.0, size: int = 12_000, number: int = 1, deadline: float = 5.0) -> MessageSymbols:
    return message(number, size, deadline=deadline, repeats=repeats)


def both(*messages: MessageSymbols) -> tuple[SendQueue, SendQueue]:
    queues = SendQueue(), SendQueue()
    for queue in queues:
        for each in messages:
            queue.add(each)
    return queues


def take(
    queue: SendQueue,
    budget: int = ONE,
    now: float = 0.0,
    pace: float = PACE,
    rtt_s: float = RTT_S,
    *,
    repeats: bool = True,
) -> tuple[int, int, int] | None:
    run = queue.take(now, budget, pace, rtt_s, repeats=repeats)
    return None if run is None else (run.message.number, run.first, run.symbols)


def test_each_path_takes_what_it_has_room_for() -> None:
    first, second = both(shared())
    assert take(first) == (1, 0, 1)
    assert take(second, 3 * 1300) == (1, 1, 3)
    assert take(first) == (1, 4, 1)


def test_spare_time_repeats_the_newest_that_only_the_other_carries() -> None:
    outbound = shared()
    first, second = both(outbound)
    assert take(first, MUCH) == (1, 0, outbound.count)
    assert take(second) == (1, outbound.count - 1, 1)
    outbound.acked[outbound.count - 2] = 1
    assert take(second, 2 * 1300) == (1, outbound.count - 4, 2)
    assert take(first) is None, "it has carried all of it"
    assert len(first) == 0


def test_no_more_is_repeated_than_allowed() -> None:
    outbound = shared(repeats=0.25)
    first, second = both(outbound)
    take(first, MUCH)
    again = 0
    while (run := take(second, MUCH)) is not None:
        again += run[2]
    assert again == outbound.count // 4
    assert len(second) == 0


def test_what_can_still_be_taken_goes_before_what_may_be_repeated() -> None:
    begun, later = shared(), shared(number=2, deadline=9.0)
    first, second = both(begun, later)
    take(first, MUCH)
    assert take(second) == (2, 0, 1)


def test_a_slow_path_leaves_the_end_to_a_fast_one_and_repeats_only() -> None:
    outbound = shared(repeats=0.0)
    fast, slow = both(outbound)
    assert take(fast) == (1, 0, 1)
    assert take(slow, rtt_s=1.0) is None
    assert len(slow) == 1
    assert slow.rests_until == LOOK_AGAIN_S
    assert take(fast, MUCH) == (1, 1, outbound.count - 1)


def test_a_slow_path_goes_on_when_the_fast_one_has_no_room_any_more() -> None:
    fast, slow = both(shared(repeats=0.0))
    take(fast)
    assert take(slow, rtt_s=1.0) is None
    assert take(slow, now=2 * OFFER_S, rtt_s=1.0) == (1, 1, 1)
    assert slow.rests_until == 0.0


def test_a_path_that_dies_hands_back_only_what_nobody_else_takes() -> None:
    outbound = shared()
    first, second = both(outbound)
    take(first)
    first.resend(outbound, (0,))
    assert first.clear() == [(outbound, (0,))]
    assert second.clear() == [(outbound, tuple(range(1, outbound.count)))]


def test_what_is_sent_again_goes_first_also_on_a_path_that_had_finished() -> None:
    outbound = shared()
    first, second = both(outbound)
    take(first, MUCH)
    assert take(second) == (1, outbound.count - 1, 1)
    second.resend(outbound, (0,))
    assert take(second) == (1, 0, 1)
    assert take(first) is None
    first.resend(outbound, (3,))
    assert take(first, MUCH) == (1, 3, 1)
    assert take(first, MUCH) is None, "what it carried before is not repeated"


def test_what_all_paths_together_can_do_in_time_is_fresh() -> None:
    pace = 10_000.0  # 1.2 s for 12 kB alone, 0.6 s together
    slow, other = both(shared(deadline=1.0, number=1), shared(deadline=9.0, number=2))
    assert take(slow, pace=pace) == (2, 0, 1), "alone it is hopeless"
    assert take(other, pace=pace, rtt_s=0.0) == (1, 0, 1)
    assert take(slow, pace=pace, rtt_s=0.0) == (1, 1, 1)


def test_what_is_over_is_forgotten_and_what_expired_is_not_repeated() -> None:
    over, expired = shared(), message(2, 12_000, deadline=1.0, expires=2.0, repeats=1.0)
    first, second = both(over, expired)
    take(first, MUCH)
    take(first, MUCH)
    over.over = True
    assert take(second, now=3.0) is None
    assert len(second) == 0


def test_what_another_path_lost_is_taken_by_whoever_looks_again() -> None:
    outbound = shared(repeats=0.0)
    first, second = both(outbound)
    assert take(first, MUCH) == (1, 0, outbound.count)
    assert take(second) is None
    assert len(second) == 0
    assert outbound.sharing is not None
    outbound.sharing.give_back((3, 4))
    second.resend(outbound, ())
    assert take(second, MUCH) == (1, 3, 2)
    assert take(second) is None
    assert len(second) == 0


def test_nothing_is_repeated_without_capacity_to_spare() -> None:
    outbound = shared()
    first, second = both(outbound)
    take(first, MUCH)
    assert second.take(0.0, ONE, PACE, RTT_S, repeats=False) is None
    assert take(second) == (1, outbound.count - 1, 1)


def test_what_can_be_in_time_is_repeated_before_what_waits_and_is_late() -> None:
    outbound, late = shared(), message(2, 12_000, deadline=1.0, expires=99.0)
    first, second = SendQueue(), SendQueue()
    first.add(outbound)
    take(first, MUCH, now=2.0)
    second.add(outbound)
    second.add(late)
    assert take(second, now=2.0) == (1, outbound.count - 1, 1)
    assert second.take(2.0, ONE, PACE, RTT_S, repeats=False) is not None, "the late one"
    outbound.over = True
    assert take(second, now=2.0) == (2, 1, 1)


def test_a_path_that_dies_tells_of_what_it_carried_with_others() -> None:
    first, _ = both(shared())
    assert [indices for _, indices in first.clear()] == [()]


def test_what_is_lost_while_a_path_has_nothing_left_is_looked_at_again() -> None:
    outbound = shared(repeats=0.0)
    first, second = both(outbound)
    assert take(first, MUCH) == (1, 0, outbound.count)
    assert second.take(0.0, ONE, PACE, RTT_S, repeats=False) is None
    assert outbound.sharing is not None
    outbound.sharing.give_back((3,))
    assert take(second) is None, "it has nothing to repeat"
    assert take(second, now=LOOK_AGAIN_S) == (1, 3, 1)
    assert take(second, now=LOOK_AGAIN_S) is None
    assert len(second) == 0


def test_a_path_of_unknown_pace_tries_unless_it_is_farther_away() -> None:
    outbound = shared(repeats=0.0, size=120_000)
    first, second = both(outbound)
    assert take(first) == (1, 0, 1)
    assert take(second, pace=0.0, rtt_s=9.0) is None
    assert take(second, now=LOOK_AGAIN_S, pace=0.0) == (1, 1, 1)


def test_messages_that_are_over_stay_in_memory_for_a_moment_only() -> None:
    messages = [shared(number=number) for number in range(1, 5)]
    first, second = both(*messages)
    while take(first, MUCH, repeats=False) is not None:
        pass
    assert take(second, repeats=False) is None
    assert len(second) == len(messages), "what may be repeated"
    assert take(second, now=LOOK_AGAIN_S, repeats=False) is None
    assert second.rests_until == LOOK_AGAIN_S + LOOK_AT_LEAST_EVERY_S
    second.add(message(9, 12_000, deadline=1.0, expires=99.0))
    for each in messages:
        each.over = True
    assert take(second, now=LOOK_AGAIN_S, repeats=False) == (9, 0, 1)
    assert len(second) == 1, "although the other one goes on"


@pytest.mark.parametrize("deadline", [5.0, 0.05, -1.0])
def test_a_path_busy_with_a_higher_priority_offers_nothing_for_a_lower_one(deadline: float) -> None:
    low = message(1, 12_000, deadline=deadline, expires=20.0, repeats=0.0, priority=Priority.LOW)
    first, second = both(low)
    first.add(message(2, 120_000, deadline=5.0, priority=Priority.HIGH))
    for _ in range(3):
        assert take(first) in {(2, 0, 1), (2, 1, 1), (2, 2, 1)}
    slow_pace, slow_rtt_s = PACE / 100, 10 * RTT_S
    assert take(second, pace=slow_pace, rtt_s=slow_rtt_s) == (1, 0, 1)


def test_its_offer_stands_while_nothing_else_waits() -> None:
    first, second = both(message(1, 12_000, deadline=5.0, repeats=0.0, priority=Priority.LOW))
    assert take(first) == (1, 0, 1)
    assert take(second, pace=PACE / 100, rtt_s=10 * RTT_S) is None


class EndsWhileLookedAt(MessageSymbols):
    """A message that the engine ends between two looks of the link's thread."""

    looks = 1_000_000

    @property
    def over(self) -> bool:
        """Whether it has been looked at too often."""
        self.looks -= 1
        return self.looks < 0

    @over.setter
    def over(self, _to: bool) -> None: ...


@pytest.mark.parametrize("looks", range(6))
@pytest.mark.parametrize("repeats", [None, 1.0])
def test_a_message_that_ends_during_a_purge_stays_whole_or_goes(looks: int, repeats: float | None) -> None:
    queue = SendQueue()
    ending = EndsWhileLookedAt(0, Encoded(b"", bytes(12_000)), deadline=5.0, expires=9.0, repeats=repeats)
    queue.add(ending)
    ending.looks = looks
    for number in range(1, PURGE_AT + 1):
        queue.add(message(number, 12_000, deadline=5.0))
    while take(queue, MUCH) is not None:
        pass
    assert len(queue) == 0


def test_a_queue_that_gives_nothing_rests() -> None:
    queue = SendQueue()
    queue.add(shared())
    assert queue.take(1.0, MUCH, PACE, RTT_S, pulls=False, repeats=False) is None
    assert len(queue) == 1
    assert queue.rests_until > 1.0
