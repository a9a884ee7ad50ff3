"""Requests to a server with a queue of 10: none is pushed out, and none waits for ever."""

from __future__ import annotations

import math
import random
from collections import deque
from itertools import count

import pytest

from plr.sidecar.core.base.values import Priority
from plr.sidecar.ros.cloud.request_window import LATE_ONLY_S, SHORT_STALL_S, STALL_S, STALL_TIMES, RequestWindow
from plr.sidecar.ros.cloud.server_capacity import SAFE_SIZE

_items = count()


def fill(window: RequestWindow[int], requests: int, *, deadline: float = 1e9, now: float = 0.0) -> list[int]:
    """Let so many requests wait; return them."""
    new = [next(_items) for _ in range(requests)]
    for request in new:
        window.add(request, Priority.NORMAL, deadline, math.inf, now)
    return new


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


def of_size(size: int) -> RequestWindow[int]:
    """A window that knows how long a request takes alone, 20 ms, and lets so many through."""
    window: RequestWindow[int] = RequestWindow(size)
    fill(window, 1)
    for _ in window.release(-1.0):
        window.sent(0, -1.0)
    window.answered(0, -0.98)
    assert window.size == size
    return window


def test_nothing_is_sent_beside_the_first_until_it_is_answered(numbers: deque[int]) -> None:
    window: RequestWindow[int] = RequestWindow()
    fill(window, 20)
    assert release(window, 0.0, numbers) == [1]
    window.answered(1, 0.1)
    assert release(window, 0.1, numbers) == [2, 3]


def test_an_answer_lets_the_next_through(numbers: deque[int]) -> None:
    window = of_size(8)
    fill(window, 20)
    assert release(window, 0.0, numbers) == [1, 2, 3, 4, 5, 6, 7, 8]
    assert release(window, 0.01, numbers) == []
    window.answered(1, 0.02)
    assert release(window, 0.02, numbers) == [9]
    window.answered(4, 0.04)  # 2 and 3 left the server's queue too, whatever becomes of them
    assert release(window, 0.04, numbers) == [10, 11, 12]


@pytest.mark.audit("dp-3")
def test_a_silent_server_gets_one_more_after_ever_longer_silences_but_no_more_than_its_queue_holds(
    numbers: deque[int],
) -> None:
    window: RequestWindow[int] = RequestWindow()
    fill(window, 200)
    assert release(window, 5.0, numbers) == [1]
    now, times = 5.0, []
    while (due := window.next_due()) is not None:
        assert release(window, due - 0.01, numbers) == []
        assert len(release(window, due, numbers)) == 1
        times.append(due - now)
        now = due
    assert times == [
        pytest.approx(STALL_S * 2**silence if silence else SHORT_STALL_S) for silence in range(SAFE_SIZE - 1)
    ]
    assert release(window, now + 1e6, numbers) == []


def test_a_server_that_is_quick_as_a_rule_is_not_waited_for_so_long(numbers: deque[int]) -> None:
    window: RequestWindow[int] = RequestWindow()
    fill(window, 200)
    release(window, 0.0, numbers)
    window.answered(1, 0.002)
    release(window, 0.002, numbers)
    assert window.next_due() == pytest.approx(0.002 + SHORT_STALL_S)


def test_a_silence_is_longer_than_what_requests_take(numbers: deque[int]) -> None:
    window: RequestWindow[int] = RequestWindow()
    fill(window, 200)
    release(window, 0.0, numbers)
    window.answered(1, 10.0)
    assert release(window, 10.0, numbers) == [2, 3]
    assert window.next_due() == 10.0 + STALL_TIMES * 10.0


@pytest.mark.audit("dp-3")
def test_what_nobody_waits_for_makes_room_once_it_is_the_oldest(numbers: deque[int]) -> None:
    """The server hangs with a full queue: the next one pushes the oldest out, which nobody misses."""
    window = of_size(8)
    fill(window, 100)
    sent = release(window, 0.0, numbers)
    window.given_up(sent[1])
    assert release(window, 1e3, numbers) == [], "the second is pushed out after the first only"
    assert window.next_due() is None
    window.given_up(sent[0])
    assert window.next_due() is not None
    assert len(release(window, 1e3, numbers)) == 2
    for number in sent[2:]:
        window.given_up(number)
    assert len(release(window, 2e3, numbers)) == 6


def test_a_server_that_comes_back_opens_the_window_by_its_first_answer(numbers: deque[int]) -> None:
    window = of_size(2)
    fill(window, 1000)
    release(window, 0.0, numbers)
    now = 0.0
    while (due := window.next_due()) is not None:
        now, sent = due, release(window, due, numbers)
    window.answered(sent[-1], now)
    assert len(release(window, now, numbers)) == window.size == 2


def test_a_window_that_is_not_full_does_not_grow(numbers: deque[int]) -> None:
    window = of_size(2)
    fill(window, 1)
    release(window, 0.0, numbers)
    fill(window, 1)
    release(window, 10 * STALL_S, numbers)
    assert window.size == 2
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
            fill(window, 1)
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


def test_one_late_request_at_a_time_and_whatever_is_fresh_beside_it(numbers: deque[int]) -> None:
    window = of_size(8)
    fill(window, 50, deadline=5.0, now=10.0)
    assert release(window, 10.0, numbers) == [1]
    fill(window, 3, deadline=20.0, now=10.1)
    assert release(window, 10.1, numbers) == [2, 3, 4], "fresh ones do not wait for the late one"
    window.answered(2, 10.2)
    assert release(window, 10.2, numbers) == []
    window.answered(1, 10.3)
    assert release(window, 10.3, numbers) == [5]
    window.given_up(5)
    assert release(window, 10.3, numbers) == [6]
    assert window.next_due() == pytest.approx(10.3 + STALL_S)
    assert release(window, 10.29 + STALL_S, numbers) == []
    assert release(window, 10.31 + STALL_S, numbers) == [7], "the server may never answer"


def test_late_requests_fill_the_window_when_nothing_else_comes(numbers: deque[int]) -> None:
    window = of_size(8)
    now = 10.0
    fill(window, 50, deadline=5.0, now=now)
    released = 0
    while now < 10.0 + LATE_ONLY_S:
        for number in release(window, now, numbers):
            released += 1
            window.answered(number, now)
            break
        due = window.next_due()
        assert due is not None
        now += 0.5
    assert released <= 5
    assert len(release(window, now, numbers)) == 8
    fill(window, 1, deadline=20.0, now=now)
    window.answered(numbers[0] - 1, now)
    assert len(release(window, now, numbers)) == 2, "the fresh one, and one late"


def test_a_request_that_becomes_late_while_it_waits_goes_behind_the_fresh_ones(numbers: deque[int]) -> None:
    window = of_size(2)
    first = fill(window, 6, deadline=1.0)
    assert release(window, 0.0, numbers) == [1, 2]
    (fresh,) = fill(window, 1, deadline=9.0, now=2.0)
    window.answered(1, 2.0)
    assert next(window.release(2.0)) == fresh
    window.sent(3, 2.0)
    window.answered(2, 2.1)
    assert next(window.release(2.1)) == first[2]
    assert window.take_all() == first[3:]


@pytest.mark.parametrize("seed", range(10))
def test_after_an_outage_what_is_asked_now_does_not_wait_for_the_backlog(seed: int) -> None:
    """A serial server, 20 ms a request; 100 late requests come at once, and then ten a second with a deadline."""
    rng = random.Random(seed)
    window: RequestWindow[int] = RequestWindow()
    numbers = deque(range(1, 100_000))
    stale = set(fill(window, 100, deadline=0.0, now=100.0))
    arrivals = deque(100.0 + 0.1 * turn + rng.uniform(0.0, 0.01) for turn in range(50))
    asked: dict[int, float] = {}
    queue: deque[int] = deque()
    request_of: dict[int, int] = {}
    ends, working = float("inf"), -1
    done: list[int] = []
    while len(done) < 150:
        now = min(ends, arrivals[0] if arrivals else float("inf"), window.next_due() or float("inf"))
        if arrivals and arrivals[0] <= now:
            arrivals.popleft()
            asked[fill(window, 1, deadline=now + 0.1, now=now)[0]] = now
        if ends <= now:
            window.answered(working, now)
            request = request_of[working]
            done.append(request)
            if request in asked:
                assert now - asked[request] <= 0.0401, "at most one late request was before it"
            ends = float("inf")
        for request in window.release(now):
            number = numbers.popleft()
            request_of[number] = request
            window.sent(number, now)
            queue.append(number)
        if ends == float("inf") and queue:
            working = queue.popleft()
            ends = now + 0.02
    assert stale <= set(done)


@pytest.mark.audit("dp-15")
def test_a_server_that_may_be_dead_gets_no_more_than_it_has(numbers: deque[int]) -> None:
    """What goes to a dead server may have run: if that may happen only once, it is lost."""
    heard_at = -1.0
    window: RequestWindow[int] = RequestWindow(alive_since=lambda since: heard_at >= since)
    fill(window, 20)
    assert release(window, 0.0, numbers) == [1]
    assert window.next_due() is None
    assert release(window, 100 * STALL_S, numbers) == []
    heard_at = 200 * STALL_S
    assert window.next_due() is not None
    assert release(window, heard_at + 0.1, numbers) == [2]
    assert window.next_due() is None, "it must be heard once more for each"
    assert release(window, 300 * STALL_S, numbers) == []


@pytest.mark.audit("dp-4")
def test_late_requests_use_the_threads_that_the_server_is_seen_to_have(numbers: deque[int]) -> None:
    """However often something fresh comes: else a server of many threads works on one late request at a time."""
    window = of_size(8)
    fill(window, 5, now=0.0)
    assert release(window, 0.0, numbers) == [1, 2, 3, 4, 5]
    for number in (5, 4, 3, 2, 1):  # overtaken by the fifth: all were in work at once
        window.answered(number, 0.1)
    fill(window, 50, deadline=0.2, now=1.0)
    fill(window, 1, now=1.0)
    assert len(release(window, 1.0, numbers)) >= 5


def test_an_answer_to_what_was_never_sent_tells_nothing(numbers: deque[int]) -> None:
    window = of_size(2)
    fill(window, 10)
    assert release(window, 0.0, numbers) == [1, 2]
    window.answered(99, 0.01)
    assert release(window, 0.01, numbers) == []
    window.answered(1, 0.02)
    window.answered(2, 0.02)
    assert release(window, 0.02, numbers) == [3, 4]
    window.answered(3, 0.03)
    assert release(window, 0.03, numbers) == [5]
