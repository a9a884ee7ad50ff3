from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from sidecar.core.pacing import MAX_WINDOW_BYTES, MIN_WINDOW_BYTES, RATE_MEMORY_S, SendQueue, Window
from sidecar.core.recovery import Sent
from sidecar.core.rtt import RttEstimator
from tests.unit.sidecar.core.builders import message

if TYPE_CHECKING:
    from sidecar.core.outbound import OutboundMessage


def rtt(seconds: float) -> RttEstimator:
    estimator = RttEstimator()
    estimator.sample(seconds, 0.0)
    return estimator


def acked(window: Window, rate: float, now: float, rtt_s: float = 0.1) -> None:
    """`rate` bytes a second are acknowledged over one round trip."""
    window.on_acked([Sent(now - rtt_s, 1200, 0, None, None)], int(rate * rtt_s), rtt(rtt_s), now)


def test_the_window_is_two_bandwidth_delay_products_within_its_bounds() -> None:
    window = Window()
    assert window.bytes == MIN_WINDOW_BYTES
    acked(window, 5e6, 1.0)
    assert window.bytes == pytest.approx(2 * 5e6 * 0.1)
    acked(window, 1e9, 1.1)
    assert window.bytes == MAX_WINDOW_BYTES
    small = Window()
    acked(small, 1e4, 1.0)
    assert small.bytes == MIN_WINDOW_BYTES


def test_one_slow_moment_does_not_shrink_it_but_a_slower_link_is_believed_in_time() -> None:
    window = Window()
    acked(window, 5e6, 1.0)
    acked(window, 1e6, 1.5)
    assert window.bytes == pytest.approx(1e6)
    acked(window, 1e6, 1.0 + RATE_MEMORY_S + 0.01)
    assert window.bytes == pytest.approx(2 * 1e6 * 0.1)


def test_the_rate_memory_does_not_grow() -> None:
    window = Window()
    for step in range(10_000):
        acked(window, 5e6 - step, 1.0 + step * 0.01)
    assert len(window._best) <= RATE_MEMORY_S / 0.01 + 2


def drain(queue: SendQueue, now: float = 0.0) -> list[tuple[int, int]]:
    out = []
    while (item := queue.pop(now)) is not None:
        out.append((item[0].number, item[1]))
    return out


def test_earliest_deadline_first_and_in_order_of_coming_among_equals() -> None:
    queue = SendQueue()
    for number, deadline in ((1, 5.0), (2, 3.0), (3, 3.0)):
        queue.add(message(number, deadline=deadline))
    assert drain(queue) == [(number, index) for number in (2, 3, 1) for index in range(3)]
    assert len(queue) == 0


def test_an_urgent_message_overtakes_one_half_sent() -> None:
    queue = SendQueue()
    queue.add(message(1, deadline=5.0))
    assert drain_one(queue) == (1, 0)
    queue.add(message(2, 10, deadline=1.0))
    assert drain(queue) == [(2, 0), (1, 1), (1, 2)]


def drain_one(queue: SendQueue) -> tuple[int, int]:
    item = queue.pop(0.0)
    assert item is not None
    return item[0].number, item[1]


def test_a_resend_goes_first_within_its_message_and_alone_when_the_message_left() -> None:
    queue, outbound = SendQueue(), message()
    queue.add(outbound)
    assert drain_one(queue) == (1, 0)
    queue.resend(outbound, (0,))
    assert drain(queue) == [(1, 0), (1, 1), (1, 2)]
    queue.resend(outbound, (1,))
    assert drain(queue) == [(1, 1)]


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


def test_clearing_hands_back_what_did_not_leave_and_only_that() -> None:
    queue = SendQueue()
    flying, done, over = message(1), message(2, 10), message(3)
    for outbound in (flying, done, over):
        queue.add(outbound)
    assert drain_one(queue) == (1, 0)
    done.acked[0] = 1
    over.over = True
    assert left(queue) == [(1, (1, 2))]
    assert len(queue) == 0
    assert queue.pop(0.0) is None


def left(queue: SendQueue) -> list[tuple[int, tuple[int, ...]]]:
    cleared: list[tuple[OutboundMessage, tuple[int, ...]]] = queue.clear()
    return [(outbound.number, indices) for outbound, indices in cleared]
