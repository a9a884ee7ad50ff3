"""Requests to a server with a queue of 10: none is pushed out, and none waits for ever."""

from __future__ import annotations

import random
from collections import deque

import pytest

from sidecar.ros.request_window import FIRST_SIZE, MAX_SIZE, STALL_S, RequestWindow


def release(window: RequestWindow[int], now: float, numbers: deque[int]) -> list[int]:
    """Send what the window lets through; return rmw's numbers for them."""
    sent = []
    for _ in window.release(now):
        number = numbers.popleft()
        window.sent(number, now)
        sent.append(number)
    return sent


@pytest.fixture
def numbers() -> deque[int]:
    return deque(range(1, 100_000))


def test_an_answer_lets_the_next_through(numbers: deque[int]) -> None:
    window: RequestWindow[int] = RequestWindow()
    window.waiting.extend(range(20))
    assert release(window, 0.0, numbers) == [1, 2, 3, 4, 5, 6, 7, 8]
    assert release(window, 0.1, numbers) == []
    window.answered(1, 0.1)
    assert release(window, 0.1, numbers) == [9]
    window.answered(4, 0.2)  # 2 and 3 left the server's queue too, whatever becomes of them
    assert release(window, 0.2, numbers) == [10, 11, 12]
    assert window.size == FIRST_SIZE


def test_answers_out_of_order_widen_the_window(numbers: deque[int]) -> None:
    window: RequestWindow[int] = RequestWindow()
    window.waiting.extend(range(20))
    release(window, 0.0, numbers)
    window.answered(5, 0.1)
    assert window.size == FIRST_SIZE
    window.answered(2, 0.2)
    assert window.size == 2 * FIRST_SIZE


def test_a_silent_server_gets_more_after_a_while(numbers: deque[int]) -> None:
    window: RequestWindow[int] = RequestWindow()
    window.waiting.extend(range(60))
    assert len(release(window, 5.0, numbers)) == 8
    assert window.next_due() == 5.0 + STALL_S
    assert release(window, 5.0 + STALL_S * 0.9, numbers) == []
    assert len(release(window, 5.0 + STALL_S, numbers)) == 8
    assert len(release(window, 5.0 + 2 * STALL_S, numbers)) == 16
    assert len(release(window, 5.0 + 3 * STALL_S, numbers)) == 28
    assert window.next_due() is None


def test_a_server_that_never_answers_does_not_stop_the_window_for_good(numbers: deque[int]) -> None:
    window: RequestWindow[int] = RequestWindow()
    window.waiting.extend(range(5 * MAX_SIZE))
    now = 0.0
    while window.waiting:
        release(window, now, numbers)
        due = window.next_due()
        now = now if due is None else due
        assert now < 100 * STALL_S


def test_a_window_that_is_not_full_does_not_grow(numbers: deque[int]) -> None:
    window: RequestWindow[int] = RequestWindow()
    window.waiting.append(0)
    release(window, 0.0, numbers)
    window.waiting.append(1)
    release(window, 10 * STALL_S, numbers)
    assert window.size == FIRST_SIZE
    assert window.next_due() is None


@pytest.mark.parametrize("seed", range(20))
def test_a_serial_server_with_a_queue_of_ten_loses_nothing(seed: int) -> None:
    """Bursts of any size, service times up to 0.1 s, some requests never answered."""
    rng = random.Random(seed)
    window: RequestWindow[int] = RequestWindow()
    numbers = deque(range(1, 100_000))
    arrivals = sorted(rng.uniform(0.0, 2.0) // 0.5 for _ in range(150))  # bursts at 0, 0.5, 1, 1.5 s
    never = {rng.randrange(1, 150) for _ in range(5)}
    queue: deque[int] = deque()
    now = 0.0
    taken: list[int] = []
    working: tuple[float, int] | None = None
    while len(taken) < 150:
        times = [arrivals[0]] if arrivals else []
        if working is not None:
            times.append(working[0])
        if (due := window.next_due()) is not None:
            times.append(due)
        now = max(now, min(times))
        while arrivals and arrivals[0] <= now:
            window.waiting.append(0)
            arrivals.pop(0)
        if working is not None and working[0] <= now:
            if working[1] not in never:
                window.answered(working[1], now)
            working = None
        queue.extend(release(window, now, numbers))
        assert len(queue) <= 10, "the server's queue overflowed"
        if working is None and queue:
            number = queue.popleft()
            taken.append(number)
            working = (now + rng.uniform(0.001, 0.1), number)
            queue.extend(release(window, now, numbers))
            assert len(queue) <= 10, "the server's queue overflowed"
    assert taken == list(range(1, 151))
