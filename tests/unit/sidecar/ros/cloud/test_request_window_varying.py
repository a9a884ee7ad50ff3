"""Servers whose service times vary are used, and those that take one request after the other keep order."""

from __future__ import annotations

import heapq
from statistics import median
from typing import TYPE_CHECKING

import pytest

from plr.sidecar.ros.cloud.overlap_gain import FIRST_TRIAL_AFTER, OverlapGain
from plr.sidecar.ros.cloud.request_overlap import IN_ORDER, LOST_AFTER, RequestOverlap
from plr.sidecar.ros.cloud.request_window import RequestWindow
from plr.sidecar.ros.cloud.server_capacity import MOST_AT_ONCE, SAFE_SIZE
from tests.unit.sidecar.ros.server_model import QUEUE_DEPTH, ModelServer

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

    Times = Callable[[random.Random, float], float]

TIMES: dict[str, Times] = {
    "constant": lambda _rng, mean_s: mean_s,
    "uniform": lambda rng, mean_s: rng.uniform(0, 2 * mean_s),
    "exponential": lambda rng, mean_s: rng.expovariate(1 / mean_s),
    "lognormal": lambda rng, mean_s: mean_s * rng.lognormvariate(-0.5, 1),
    "half take 20 times": lambda rng, mean_s: mean_s / 10.5 * rng.choice((1, 20)),
    "some take 20 times": lambda rng, mean_s: mean_s / 2.9 * (1 if rng.random() < 0.9 else 20),
}
ANSWERS, FIRST_ANSWERS = 2000, 200
SEEDS = 2


class All(RequestWindow[int]):
    """Lets so many through that they are never too few."""

    __slots__ = ()

    @property
    def size(self) -> int:
        return 64


class EndlessQueue(ModelServer):
    """A server that nothing is lost at."""

    def _arrive(self, number: int, request: int) -> None:
        self._queue.append((number, request))
        self._work()


class OneProcessor(ModelServer):
    """Its threads share a processor: of `n` in work each gets on at `1 / n` of its speed."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._jobs: list[tuple[float, int, int]] = []
        self._work_s = self._work_at = 0.0
        self._version = 0

    def _work(self) -> None:
        self._get_on()
        while self._working < self.threads and self._queue:
            self._working += 1
            number, request = self._queue.popleft()
            heapq.heappush(self._jobs, (self._work_s + self.service_s(self._rng), number, request))
        self._version += 1
        if self._jobs:
            left_s = max((self._jobs[0][0] - self._work_s) * len(self._jobs), 0.0)
            self._at(left_s, lambda version=self._version: self._finish(version))  # type: ignore[misc]

    def _get_on(self) -> None:
        if self._jobs:
            self._work_s += (self.now - self._work_at) / len(self._jobs)
        self._work_at = self.now

    def _finish(self, version: int) -> None:
        if version == self._version:
            self._get_on()
            _, number, request = heapq.heappop(self._jobs)
            self._done(number, request)


def at_server(server: ModelServer) -> int:
    return len(server._queue) + server._working


def serve(server: ModelServer, answers: int, step_s: float) -> list[int]:
    """Return how many were at the server at a time, until so many more are answered."""
    done, there = len(server.answered) + answers, []
    while len(server.answered) < done:
        server.run(step_s)
        there.append(at_server(server))
    return there


def rate(server: ModelServer, step_s: float) -> float:
    """Answers a second of a server that has always more to do, but for the first."""
    server.ask(ANSWERS + 2 * FIRST_ANSWERS)
    serve(server, ANSWERS, step_s)
    times = sorted(server.answered.values())
    return (ANSWERS - FIRST_ANSWERS) / (times[ANSWERS - 1] - times[FIRST_ANSWERS - 1])


@pytest.mark.audit("dp-3")
@pytest.mark.parametrize("times", TIMES)
@pytest.mark.parametrize("threads", [1, 2, 3, 4, 8, 16])
def test_a_server_is_used_however_its_times_vary(times: str, threads: int) -> None:
    """Against one that gets all at once."""
    shares = []
    for seed in range(SEEDS):
        direct = rate(EndlessQueue(lambda rng: TIMES[times](rng, 1.0), threads, seed=seed, window=All()), 1.0)
        for mean_s in (0.0005, 0.005, 0.05, 0.5):
            if mean_s < 0.001 and threads > 4:
                continue  # 16,000 answers a second take more on the way than a queue surely holds
            server = ModelServer(lambda rng, mean_s=mean_s: TIMES[times](rng, mean_s), threads, seed=seed)  # type: ignore[misc]
            shares.append(rate(server, mean_s) * mean_s / direct)
            assert server.lost == 0
    if times == "constant":
        held = min(SAFE_SIZE / threads, 1.0)  # all is in order: nothing proves that its queue has room for more
        assert min(shares) > 0.8 * held
    else:
        assert median(shares) > 0.8
        assert min(shares) > 0.6


@pytest.mark.audit("dp-3")
@pytest.mark.parametrize("times", TIMES)
@pytest.mark.parametrize(("mean_s", "most"), [(0.05, 2), (0.5, 2)])
def test_a_serial_server_has_two_at_most_however_its_times_vary(times: str, mean_s: float, most: int) -> None:
    for seed in range(SEEDS):
        server = ModelServer(lambda rng: TIMES[times](rng, mean_s), seed=seed)
        server.ask(2 * ANSWERS)
        serve(server, FIRST_ANSWERS, mean_s)
        there = serve(server, ANSWERS, mean_s)
        assert sum(count > most for count in there) <= 0.2 * len(there)


@pytest.mark.audit("dp-3")
@pytest.mark.parametrize("times", ["constant", "uniform", "exponential", "lognormal", "half take 20 times"])
@pytest.mark.parametrize("threads", [2, 4, 16])
def test_threads_that_share_a_processor_count_as_one(times: str, threads: int) -> None:
    server = OneProcessor(lambda rng: TIMES[times](rng, 0.05), threads)
    server.ask(5000)
    serve(server, 1000, 0.05)
    there = serve(server, 2000, 0.05)
    assert median(there) <= 2
    assert sum(count > 3 for count in there) <= 0.3 * len(there), "now and then it is tried again"


@pytest.mark.audit("dp-3")
@pytest.mark.parametrize("times", ["constant", "exponential", "lognormal"])
@pytest.mark.parametrize("threads", [1, 3, 8])
@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_service_times_change_by_ten_times(times: str, threads: int, factor: float) -> None:
    mean_s = 0.05
    server = ModelServer(lambda rng: TIMES[times](rng, mean_s), threads)
    server.ask(10_000)
    serve(server, 1000, mean_s)
    mean_s *= factor
    serve(server, 300, mean_s)
    began = server.now
    serve(server, 1500, mean_s)
    assert 1500 / (server.now - began) > 0.75 * threads / mean_s


@pytest.mark.audit("dp-3")
@pytest.mark.parametrize("times", TIMES)
@pytest.mark.parametrize(("before", "after"), [(16, 1), (16, 4), (8, 3), (8, 1), (1, 8)])
def test_threads_come_and_go(times: str, before: int, after: int) -> None:
    """Nothing is pushed out of the queue when what was in work comes back and all the rest stands before one thread."""
    mean_s = 0.05
    server = ModelServer(lambda rng: TIMES[times](rng, mean_s), before)
    server.ask(10_000)
    serve(server, 1000, mean_s)
    server.threads = after
    serve(server, 300, mean_s)
    began = server.now
    there = serve(server, 1000, mean_s)
    assert 1000 / (server.now - began) > 0.7 * after / mean_s
    assert server.most_queued <= QUEUE_DEPTH
    assert server.lost == 0
    if after == 1:
        assert median(there) <= 2


def test_overlaps_of_long_ago_do_not_count() -> None:
    overlap = RequestOverlap()
    overlap.answered(1, [0])
    assert overlap.most == 1, "the other may be lost"
    overlap.answered(0, [])
    assert overlap.most == 2
    for number in range(2, 2 + IN_ORDER):
        assert overlap.most == 2
        overlap.answered(number, [])
    assert overlap.most == 1


def test_what_is_overtaken_by_many_counts_as_lost() -> None:
    overlap = RequestOverlap()
    for number in range(1, LOST_AFTER + 3):
        overlap.answered(number, [0] if number == 1 else [])
    overlap.answered(0, [])
    assert overlap.most == 1


@pytest.mark.parametrize("shared", [False, True])
def test_two_trials_show_whether_overlaps_gain_anything(shared: bool) -> None:
    gain = OverlapGain()
    now = 0.0
    for _ in range(4 * FIRST_TRIAL_AFTER):
        out = gain.at_once or min(gain.of_use(8), 8)
        gain.sent(out, now)
        took_s = 0.1 * out if shared else 0.1
        now += took_s / out
        gain.answered(took_s, out, 8, now)
        if gain.of_use(8) == 1:
            break
    assert gain.of_use(8) == (1 if shared else 8)
    assert gain.at_once <= MOST_AT_ONCE
