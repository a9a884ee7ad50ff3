"""A ROS server behind a window, in simulated time: threads, a queue that keeps the last ten, and the way there."""

from __future__ import annotations

import heapq
import random
from collections import deque
from dataclasses import dataclass, field
from itertools import count
from typing import TYPE_CHECKING

from plr.sidecar.core.base.values import Priority
from plr.sidecar.ros.cloud.request_window import RequestWindow

if TYPE_CHECKING:
    from collections.abc import Callable

QUEUE_DEPTH = 10
"""rmw's default."""
HOP_S = 0.0004
"""There and back."""


@dataclass
class ModelServer:
    """Serves what its window lets through."""

    service_s: Callable[[random.Random], float]
    threads: int = 1
    hop_s: float = HOP_S
    seed: int = 1
    window: RequestWindow[int] = field(default_factory=RequestWindow)
    now: float = 0.0
    lost: int = 0
    """Pushed out of the queue."""
    most_queued: int = 0
    answered: dict[int, float] = field(default_factory=dict)
    """When each request's answer was back."""
    expired: set[int] = field(default_factory=set)
    """Requests that nobody waited for any more before their answer was back."""
    answers: bool = True
    """Whether what it has done is answered."""

    def __post_init__(self) -> None:
        self._rng = random.Random(self.seed)
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self._numbers = count(1)
        self._requests = count()
        self._queue: deque[tuple[int, int]] = deque()
        self._working = 0
        self._number_of: dict[int, int] = {}

    def ask(
        self, requests: int, *, deadline_s: float = 1e9, lifetime_s: float = 1e9, priority: Priority = Priority.NORMAL
    ) -> list[int]:
        """Let so many requests come at once; return them."""
        new = [next(self._requests) for _ in range(requests)]
        for request in new:
            self.window.add(request, priority, self.now + deadline_s, self.now + lifetime_s, self.now)
            if lifetime_s < 1e9:
                self._at(lifetime_s, lambda request=request: self._expire(request))  # type: ignore[misc]
        self._release()
        return new

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while True:
            due = self.window.next_due()
            at = min(self._due[0][0] if self._due else end, end if due is None else max(due, self.now))
            if at >= end:
                self.now = end
                return
            self.now = at
            if self._due and self._due[0][0] <= at:
                heapq.heappop(self._due)[2]()
            else:
                self._release()

    def throughput(self, requests: int) -> float:
        """Answers a second for so many requests that come at once."""
        began = self.now
        new = set(self.ask(requests))
        while self.window.waiting or self._due:
            self.run(0.1)
        return len(new & self.answered.keys()) / (max(self.answered.values()) - began)

    def _at(self, delay_s: float, act: Callable[[], None]) -> None:
        heapq.heappush(self._due, (self.now + delay_s, next(self._order), act))

    def _release(self) -> None:
        for request in self.window.release(self.now):
            number = next(self._numbers)
            self.window.sent(number, self.now)
            self._number_of[request] = number
            self._at(self.hop_s / 2, lambda number=number, request=request: self._arrive(number, request))  # type: ignore[misc]

    def _arrive(self, number: int, request: int) -> None:
        self._queue.append((number, request))
        self._work()
        self.most_queued = max(self.most_queued, len(self._queue))
        if len(self._queue) > QUEUE_DEPTH:
            self._queue.popleft()
            self.lost += 1

    def _work(self) -> None:
        while self._working < self.threads and self._queue:
            self._working += 1
            number, request = self._queue.popleft()
            self._at(self.service_s(self._rng), lambda number=number, request=request: self._done(number, request))  # type: ignore[misc]

    def _done(self, number: int, request: int) -> None:
        self._working -= 1
        if self.answers:
            self._at(self.hop_s / 2, lambda: self._answer(number, request))
        self._work()

    def _expire(self, request: int) -> None:
        if request in self.answered:
            return
        self.expired.add(request)
        if self.window.holds(request):
            self.window.remove(request)
        else:
            self.window.given_up(self._number_of[request])
        self._release()

    def _answer(self, number: int, request: int) -> None:
        self.answered[request] = self.now
        self.window.answered(number, self.now)
        self._release()


def always(seconds: float) -> Callable[[random.Random], float]:
    """Every request takes as long."""
    return lambda _rng: seconds


def varying(mean_s: float) -> Callable[[random.Random], float]:
    """Service times that vary by half of their mean."""
    return lambda rng: rng.gammavariate(4, mean_s / 4)
