"""Requests to one local server, no more at once than its queue holds.

A ROS server made with the default profile keeps the last 10 requests it has not taken yet; the 11th pushes the first
one out without a trace. How many lie there cannot be asked, but follows from the answers: the requests of one client
are taken in order, so an answer tells that its request and all earlier ones have left the queue. At most `size` later
ones are let through; the rest wait here.

A server that works on many requests at once would be slowed down by that. It shows by answering out of order, or by
answering nothing for a while although the window is full: then the window doubles, and stays so.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterator

FIRST_SIZE = 8
"""Below rmw's default depth of 10: the server may have other clients."""
MAX_SIZE = 1024
"""As many as the bridge's own queue of answers holds."""
STALL_S = 1.0
"""A server that takes its requests one by one and needs longer than this for one is late for any deadline."""

T = TypeVar("T")


class RequestWindow(Generic[T]):
    """Which requests may go to the server now. The caller sends what `release` yields and reports `sent`."""

    __slots__ = ("_highest_answered", "_progress_at", "_unseen", "size", "waiting")

    def __init__(self, size: int = FIRST_SIZE) -> None:
        self.size = size
        self.waiting: deque[T] = deque()
        self._unseen: deque[int] = deque()
        """Numbers of the sent requests that may still lie in the server's queue, ascending."""
        self._highest_answered = -1
        self._progress_at = 0.0

    def release(self, now: float) -> Iterator[T]:
        """Yield waiting requests while the window is open; report each with `sent` before the next."""
        if self.waiting and self._is_stalled(now):
            self._grow(now)
        while self.waiting and len(self._unseen) < self.size:
            yield self.waiting.popleft()

    def sent(self, number: int, now: float) -> None:
        """rmw gave `number` to the request just sent; numbers ascend."""
        if not self._unseen:
            self._progress_at = now
        self._unseen.append(number)

    def answered(self, number: int, now: float) -> None:
        """The server answered request `number`."""
        self._progress_at = now
        if number < self._highest_answered:
            self._grow(now)
            return
        self._highest_answered = number
        while self._unseen and self._unseen[0] <= number:
            self._unseen.popleft()

    def next_due(self) -> float | None:
        """Return when `release` may yield although no answer came, or None."""
        return self._progress_at + STALL_S if self.waiting else None

    def _is_stalled(self, now: float) -> bool:
        return len(self._unseen) >= self.size and now - self._progress_at >= STALL_S

    def _grow(self, now: float) -> None:
        self._progress_at = now
        if self.size >= MAX_SIZE and len(self._unseen) >= self.size:
            self._unseen.clear()  # nothing is known of them; rather lose some than stop for good
        self.size = min(self.size * 2, MAX_SIZE)
