"""How many requests a server works on at one moment, as answers out of order prove it.

The requests of one client are taken in order. So when a later one is answered first, the earlier was in work by then:
from when it is overtaken until it is answered. However much service times vary, a server that takes one request after
the other is never seen to work on two.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

REMEMBERED = 256
"""Answers that are looked at: eight times what one server has at once ..."""
IN_ORDER = 64
"""... unless so many were in order since: then threads have ended."""
LOST_AFTER = 512
"""What was overtaken by so many answers counts as lost. One thread of 16 may be busy for long with one request."""


class RequestOverlap:
    """What the last answers of one server prove. Request numbers ascend."""

    __slots__ = ("_events", "_highest", "_in_order", "_in_work", "_overtaken", "most")

    def __init__(self) -> None:
        self.most = 1
        """The most requests that were in work at one moment."""
        self._highest = -1
        self._events = 0
        self._in_order = 0
        """Answers since one that was overtaken was answered."""
        self._in_work: deque[int] = deque(maxlen=REMEMBERED)
        """For each of the last answers, how many requests are known to have been in work just before it."""
        self._overtaken: dict[int, int] = {}
        """Unanswered requests with a lower number than one that is answered, by the answer that first told."""

    @property
    def overtaken(self) -> int:
        """Requests that are in work although later ones are answered; of a server that works on one at once, lost."""
        return min(len(self._overtaken), self.most - 1)

    def given_up(self, number: int) -> None:
        """Nobody waits for this request any more."""
        self._overtaken.pop(number, None)

    def answered(self, number: int, unanswered: Iterable[int]) -> None:
        """The server answered one of its requests, and not yet these."""
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
