"""Requests to one local server, no more at once than its queue holds.

A ROS server made with the default profile keeps the last 10 requests it has not taken yet; the 11th pushes the first
one out without a trace. How many lie there cannot be asked, but follows from the answers: the requests of one client
are taken in order, so an answer tells that its request and all earlier ones have left the queue. At most `size` later
ones are let through; the rest wait here.

A server that works on many requests at once would be slowed down by that. It shows by answering out of order, or by
answering nothing for a while although the window is full: then the window doubles, and stays so. At its largest, a
silent server gets one request in STALL_S.

What is late already when its turn comes must not keep the server from what is not: after an outage a backlog comes
first and what the robot asks now right behind it, and no request can be called back from a server's queue. So only one
late request at a time is let through, as long as others may come.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Generic, TypeVar

from sidecar.ros.request_queue import RequestQueue

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterator

    from sidecar.core.priority import Priority

FIRST_SIZE = 8
"""Below rmw's default depth of 10: the server may have other clients."""
MAX_SIZE = 32
"""Also what DDS keeps of requests and of answers, and so what a killed server costs: until its lease ends, about 20 s,
no request counts as delivered to all, and for good DDS keeps as many buffers as it held requests, each as long as the
longest of them."""
STALL_S = 1.0
"""A server that takes its requests one by one and needs longer than this for one is late for any deadline."""
LATE_ONLY_S = 2.0
"""When nothing but late requests came for so long, they may fill the window: then the deadline is shorter than the
way here, and one at a time would only make it worse."""

T = TypeVar("T", bound="Hashable")


class RequestWindow(Generic[T]):
    """Which requests may go to the server now. The caller sends what `release` yields and reports `sent`."""

    __slots__ = (
        "_highest_answered",
        "_late_number",
        "_late_released",
        "_next_late_at",
        "_only_late_since",
        "_progress_at",
        "_unseen",
        "_waiting",
        "size",
    )

    def __init__(self, size: int = FIRST_SIZE) -> None:
        self.size = size
        self._waiting: RequestQueue[T] = RequestQueue()
        self._unseen: deque[int] = deque()
        """Numbers of the sent requests that may still lie in the server's queue, ascending."""
        self._highest_answered = -1
        self._progress_at = 0.0
        self._late_released = False
        """Whether what `release` yielded last was late."""
        self._late_number: int | None = None
        """The late request at the server that was sent last."""
        self._next_late_at = 0.0
        """When the next one may go although that one was not answered."""
        self._only_late_since: float | None = None

    @property
    def waiting(self) -> int:
        """How many requests wait."""
        return len(self._waiting)

    def add(self, request: T, priority: Priority, deadline: float, now: float) -> None:
        """Let a request wait for its turn."""
        self._waiting.add(request, priority, deadline)
        if deadline > now:
            self._only_late_since = None
        elif self._only_late_since is None:
            self._only_late_since = now

    def holds(self, request: T) -> bool:
        """Whether the request still waits."""
        return request in self._waiting

    def remove(self, request: T) -> None:
        """A waiting request is not wanted any more."""
        self._waiting.remove(request)

    def take_all(self) -> list[T]:
        """Return all that wait, in order of arrival, and let none wait any more."""
        return self._waiting.take_all()

    def release(self, now: float) -> Iterator[T]:
        """Yield waiting requests while the window is open; report each with `sent` before the next."""
        if self._waiting and len(self._unseen) >= self.size and now - self._progress_at >= STALL_S:
            self._progress_at = now
            if self.size < MAX_SIZE:
                self._grow()
            else:
                self._unseen.popleft()  # most likely lost; an answer to whatever is sent next opens the window
        while len(self._unseen) < self.size:
            found = self._waiting.take(now, late_too=self._late_may_go(now))
            if found is None:
                return
            request, self._late_released = found
            yield request

    def sent(self, number: int, now: float) -> None:
        """rmw gave `number` to the request just sent; numbers ascend."""
        if not self._unseen:
            self._progress_at = now
        self._unseen.append(number)
        if self._late_released:
            self._late_number = number
            self._next_late_at = now + STALL_S

    def answered(self, number: int, now: float) -> None:
        """The server answered request `number`."""
        self._progress_at = now
        self.given_up(number)
        if number < self._highest_answered:
            self._grow()
            return
        self._highest_answered = number
        while self._unseen and self._unseen[0] <= number:
            self._unseen.popleft()

    def given_up(self, number: int) -> None:
        """Nobody waits for the answer to request `number` any more."""
        if number == self._late_number:
            self._late_number = None

    def next_due(self) -> float | None:
        """Return when `release` may yield although no answer came, or None."""
        if not self._waiting:
            return None
        if len(self._unseen) >= self.size or self._late_number is None:
            return self._progress_at + STALL_S
        if self._only_late_since is None:
            return self._next_late_at
        return min(self._next_late_at, self._only_late_since + LATE_ONLY_S)

    def _late_may_go(self, now: float) -> bool:
        only_late = self._only_late_since is not None and now - self._only_late_since >= LATE_ONLY_S
        return self._late_number is None or now >= self._next_late_at or only_late

    def _grow(self) -> None:
        self.size = min(self.size * 2, MAX_SIZE)
