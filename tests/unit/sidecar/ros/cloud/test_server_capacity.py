"""How many requests a local server gets at once: enough to be busy, no more than that, and none is pushed out."""

from __future__ import annotations

from statistics import median
from typing import TYPE_CHECKING

import pytest

from plr.sidecar.core.base.values import Priority
from plr.sidecar.ros.cloud.request_overlap import LOST_AFTER, REMEMBERED
from plr.sidecar.ros.cloud.request_window import RequestWindow
from plr.sidecar.ros.cloud.server_capacity import MOST_AT_ONCE, SAFE_SIZE, ServerCapacity
from tests.unit.sidecar.ros.server_model import ModelServer, always, varying

if TYPE_CHECKING:
    import random
    from collections.abc import Callable


class Eight(RequestWindow[int]):
    """Lets as many through as the queue holds, whatever the server takes."""

    __slots__ = ()

    @property
    def size(self) -> int:
        return SAFE_SIZE


@pytest.mark.audit("dp-3")
@pytest.mark.parametrize("busy_s", [0.95, 1.1, 1.5, 4.0, 30.0])
@pytest.mark.parametrize("requests", [9, 12, 20, 60])
def test_a_slow_server_loses_none(busy_s: float, requests: int) -> None:
    server = ModelServer(always(busy_s))
    server.throughput(requests)
    assert server.lost == 0
    assert len(server.answered) == requests


@pytest.mark.audit("dp-3")
@pytest.mark.parametrize("threads", [2, 4, 8, 16])
@pytest.mark.parametrize("seed", range(3))
def test_a_server_of_many_threads_loses_none(threads: int, seed: int) -> None:
    """Answers out of order tell that it works on several, not that its queue holds more."""
    for service_s in (varying(0.02), varying(1.5)):
        server = ModelServer(service_s, threads=threads, seed=seed)
        server.throughput(400)
        assert server.lost == 0


@pytest.mark.audit("dp-3")
def test_a_server_that_stops_answering_has_no_more_than_its_queue_holds() -> None:
    server = ModelServer(always(0.0001))
    server.throughput(500)
    server.service_s = always(1e6)
    server.ask(100)
    server.run(3600.0)
    assert server.most_queued <= SAFE_SIZE
    assert server.lost == 0


@pytest.mark.audit("dp-4")
@pytest.mark.parametrize(("busy_s", "most"), [(0.02, 2), (0.09, 2), (0.3, 2), (1.5, 2)])
def test_a_server_that_takes_one_after_the_other_has_one_or_two(busy_s: float, most: int) -> None:
    server = ModelServer(always(busy_s))
    server.ask(200)
    for _ in range(100):
        server.run(busy_s)
        assert server.window.size <= most


@pytest.mark.audit("dp-4")
@pytest.mark.parametrize("busy_s", [0.1, 1.5])
def test_where_requests_take_long_one_is_there_mostly(busy_s: float) -> None:
    server = ModelServer(always(1.1 * busy_s))
    server.ask(200)
    server.run(30 * busy_s)
    sizes = []
    for _ in range(100):
        server.run(busy_s)
        sizes.append(server.window.size)
    assert sizes.count(1) > 50


@pytest.mark.audit("dp-4")
@pytest.mark.parametrize("service_s", [always, varying])
@pytest.mark.parametrize("busy_s", [0.00005, 0.0002, 0.0005, 0.001, 0.003, 0.01, 0.09, 0.3])
def test_a_serial_server_is_kept_busy(
    service_s: Callable[[float], Callable[[random.Random], float]], busy_s: float
) -> None:
    """As by eight at once."""
    requests = max(100, min(int(2 / busy_s), 5000))
    eight, server = ModelServer(service_s(busy_s), window=Eight()), ModelServer(service_s(busy_s))
    server.throughput(500)
    assert server.throughput(requests) > 0.95 * eight.throughput(requests)


@pytest.mark.audit("dp-4")
@pytest.mark.parametrize("threads", [2, 4, 8])
@pytest.mark.parametrize("busy_s", [0.005, 0.05, 0.3])
def test_a_server_of_many_threads_is_used(threads: int, busy_s: float) -> None:
    shares = []
    for seed in range(5):
        server = ModelServer(varying(busy_s), threads=threads, seed=seed)
        shares.append(server.throughput(250 * threads) * busy_s / threads)
    assert median(shares) > 0.8
    fixed = ModelServer(always(busy_s), threads=threads)
    assert fixed.throughput(250 * threads) > 0.85 * threads / busy_s


@pytest.mark.audit("dp-4")
def test_work_that_shares_a_processor_gains_nothing_from_several_at_once() -> None:
    server = ModelServer(always(0.0), threads=8)
    server.service_s = lambda _rng: 0.05 * max(1, server._working)
    server.ask(300)
    sizes = []
    for _ in range(60):
        server.run(0.2)
        sizes.append(server.window.size)
    assert median(sizes[10:]) <= 3


@pytest.mark.audit("dp-4")
def test_a_server_that_changes_is_noticed() -> None:
    server = ModelServer(varying(0.05), threads=8)
    server.ask(20_000)
    server.run(20.0)
    before = len(server.answered)
    server.run(10.0)
    assert len(server.answered) - before > 0.8 * 8 * 10 / 0.05
    server.threads = 1
    server.run(60.0)
    assert server.window.size <= 3
    before = len(server.answered)
    server.run(10.0)
    assert len(server.answered) - before > 0.9 * 10 / 0.05
    server.threads = 8
    server.run(60.0)
    before = len(server.answered)
    server.run(10.0)
    assert len(server.answered) - before > 0.7 * 8 * 10 / 0.05
    assert server.lost == 0


@pytest.mark.audit("dp-4")
def test_what_is_short_and_gets_long_stands_no_longer_before_what_is_urgent() -> None:
    """Eight at once of 0.1 ms are right, of 90 ms they are not, also when the server keeps up with the load."""
    server = ModelServer(always(0.0001))
    server.throughput(2000)
    server.service_s = always(0.09)
    for _ in range(150):
        server.ask(1, deadline_s=0.4, priority=Priority.LOW)
        server.run(0.0905)
        server.ask(1 if server.now % 1 < 0.1 else 0, deadline_s=0.4)
    server.ask(20, priority=Priority.LOW)
    asked = server.now
    (urgent,) = server.ask(1, deadline_s=0.4, priority=Priority.HIGH)
    server.run(2.0)
    assert server.answered[urgent] - asked < 0.3


def test_a_long_request_at_a_server_of_many_threads_holds_nothing_up() -> None:
    """One thread is busy for long, the others take what comes, and the time alone can be measured again."""
    server = ModelServer(varying(0.02), threads=4)
    server.throughput(500)
    times = iter([60.0])
    server.service_s = lambda rng: next(times, None) or rng.gammavariate(4, 0.005)
    server.ask(5000)
    server.run(20.0)
    before = len(server.answered)
    server.run(10.0)
    assert len(server.answered) - before > 0.7 * 3 * 10 / 0.02


def test_overlap_is_what_answers_out_of_order_prove() -> None:
    capacity = ServerCapacity()
    for number in range(6):
        capacity.sent(number, number + 1, 0.0)
    capacity.answered(0, 1.0)
    capacity.answered(1, 1.0)
    assert capacity.overlap == 1, "in order: nothing is proved"
    capacity.answered(4, 1.0)
    assert capacity.overlap == 1, "2 and 3 may be lost"
    capacity.answered(3, 1.0)
    assert capacity.overlap == 2, "3 and 4 were in work together"
    capacity.answered(2, 1.0)
    assert capacity.overlap == 3
    capacity.answered(2, 1.0)
    assert capacity.overlap == 3, "what is answered twice proves nothing"
    for number in range(10, 10 + REMEMBERED):
        capacity.sent(number, 1, 2.0)
        capacity.answered(number, 2.1)
    assert capacity.overlap == 1, "that was long ago"


def test_what_is_never_answered_is_not_held() -> None:
    capacity = ServerCapacity()
    for number in range(0, 1000, 2):
        capacity.sent(number, 1, float(number))
        capacity.sent(number + 1, 2, float(number))
        capacity.answered(number + 1, number + 0.5)
    assert len(capacity._sent) <= 2 * MOST_AT_ONCE
    assert len(capacity._overlap._overtaken) <= LOST_AFTER + 1
    assert capacity.overlap == 1


def test_never_more_than_dds_keeps() -> None:
    window: RequestWindow[int] = RequestWindow()
    server = ModelServer(varying(0.05), threads=64, window=window)
    server.ask(5000)
    for _ in range(100):
        server.run(0.1)
        assert window.size <= MOST_AT_ONCE
    assert server.lost == 0
