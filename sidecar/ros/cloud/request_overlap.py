"""Counts how many requests a server works on at once, as proved by answers out of order.

A server takes the requests of one client in order. So when a later one is answered first, the earlier was in work by
then: at least from when it is overtaken until it is answered. However much service times vary, a server that takes one
request after the other is never seen to work on two.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

REMEMBERED = 256
"""Answers considered: eight times what one server has at once ..."""
IN_ORDER = 64
"""... unless this many were in order since: then threads have ended."""
LOST_AFTER = 512
"""A request overtaken by this many answers counts as lost. One thread of 16 may be busy with one request for long."""


class RequestOverlap:
    """The overlap that the last answers of one server prove. Request numbers ascend."""

    __slots__ = ("_events", "_highest", "_in_order", "_in_work", "_overtaken", "most")

    def __init__(self) -> None:
        self.most = 1
        """The most requests that were in work at once."""
        self._highest = -1
        self._events = 0
        self._in_order = 0
        """Answers since the last answer to an overtaken request."""
        self._in_work: deque[int] = deque(maxlen=REMEMBERED)
        """Requests known to have been in work just before each of the last answers."""
        self._overtaken: dict[int, int] = {}
        """Unanswered requests with a lower number than an answered one; for each, the first answer that overtook it."""

    @property
    def overtaken(self) -> int:
        """Requests in work although later ones are answered; at a server that works on one at a time they are lost."""
        return min(len(self._overtaken), self.most - 1)

    def given_up(self, number: int) -> None:
        """Note that this request is no longer awaited."""
        self._overtaken.pop(number, None)

    def answered(self, number: int, unanswered: Iterable[int]) -> None:
        """Note that the server answered request `number`, while these are still unanswered."""
        event = self._events
        self._events += 1
        self._in_work.append(1)
        since = self._overtaken.pop(number, None)
        self._in_order += 1
        if since is not None:
            self._in_order = 0
            oldest = self._events - len(self._in_work)
            for index in range(max(since - oldest, 0), len(self._in_work) - 1):
                self._in_work[index] += 1
        elif number > self._highest:
            self._highest = number
            for earlier in unanswered:
                if earlier < number:
                    self._overtaken.setdefault(earlier, event)
        if self._in_order == IN_ORDER:
            self._in_work.clear()
            self._in_work.append(1)
        self.most = max(self._in_work)
        while self._overtaken and next(iter(self._overtaken.values())) < self._events - LOST_AFTER:
            del self._overtaken[next(iter(self._overtaken))]
