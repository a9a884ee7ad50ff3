"""How much of what goes next on one path: a delivery-rate window and a queue ordered by deadline.

First version: the window follows the measured delivery rate (after BBR, draft-cardwell-iccrg-bbr) and does not
shrink for single losses, so random loss on radio links costs no throughput. Pacing comes with the next issue.
"""

from __future__ import annotations

import heapq
from collections import deque
from itertools import count
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sidecar.core.outbound import OutboundMessage
    from sidecar.core.recovery import Sent
    from sidecar.core.rtt import RttEstimator

MIN_WINDOW_BYTES = 64 * 1024
"""About one small camera frame: a lone request never waits for the estimate."""
MAX_WINDOW_BYTES = 4 * 1024 * 1024
"""As much as a socket buffer takes."""
WINDOW_GAIN = 2.0
"""Bandwidth-delay products in flight; above 1 so that the estimate can grow."""
RATE_MEMORY_S = 3.0
"""The best delivery rate of this long counts; then a slower link must be believed."""


class Window:
    """Bytes that may be in flight on one path."""

    __slots__ = ("_best", "bytes")

    def __init__(self) -> None:
        self.bytes = float(MIN_WINDOW_BYTES)
        self._best: deque[tuple[float, float]] = deque()

    def on_acked(self, newly: Iterable[Sent], acked_bytes: int, rtt: RttEstimator, now: float) -> None:
        """Learn from acknowledged datagrams; `acked_bytes` is the path's total by now."""
        rate = 0.0
        for datagram in newly:
            elapsed = max(now - datagram.at, rtt.minimum, 1e-4)
            rate = max(rate, (acked_bytes - datagram.delivered) / elapsed)
        best = self._best
        while best and best[0][0] < now - RATE_MEMORY_S:
            best.popleft()
        while best and best[-1][1] <= rate:
            best.pop()
        best.append((now, rate))
        target = WINDOW_GAIN * best[0][1] * max(rtt.minimum, 0.001)
        self.bytes = min(max(target, MIN_WINDOW_BYTES), MAX_WINDOW_BYTES)


class _Entry:
    """One message's turn on one path."""

    __slots__ = ("message", "next", "resend")

    def __init__(self, message: OutboundMessage) -> None:
        self.message = message
        self.next = 0
        self.resend: deque[int] = deque()

    def pop(self) -> int | None:
        message = self.message
        while self.resend:
            index = self.resend.popleft()
            if message.needs(index):
                return index
        while self.next < message.symbols:
            index = self.next
            self.next += 1
            if message.needs(index):
                return index
        return None

    def remaining(self) -> tuple[int, ...]:
        message = self.message
        return tuple(filter(message.needs, (*self.resend, *range(self.next, message.symbols))))


class SendQueue:
    """Symbols that wait for one path, earliest deadline first."""

    __slots__ = ("_entries", "_heap", "_order", "expired")

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, _Entry]] = []
        self._entries: dict[int, _Entry] = {}
        self._order = count()
        self.expired = 0

    def __len__(self) -> int:
        return len(self._entries)

    def add(self, message: OutboundMessage) -> None:
        """Queue all symbols of a message."""
        if message.number not in self._entries:
            self._insert(_Entry(message))

    def resend(self, message: OutboundMessage, indices: Iterable[int]) -> None:
        """Queue these symbols of a message again, before its others."""
        entry = self._entries.get(message.number)
        if entry is None:
            entry = _Entry(message)
            entry.next = message.symbols
            self._insert(entry)
        entry.resend.extend(indices)

    def _insert(self, entry: _Entry) -> None:
        self._entries[entry.message.number] = entry
        heapq.heappush(self._heap, (entry.message.deadline, next(self._order), entry))

    def pop(self, now: float) -> tuple[OutboundMessage, int] | None:
        """Return the next symbol to send; messages that are over or expired are dropped on the way."""
        heap = self._heap
        while heap:
            entry = heap[0][2]
            message = entry.message
            if message.expires <= now and not message.over:
                self.expired += 1
            elif (index := entry.pop()) is not None:
                return message, index
            heapq.heappop(heap)
            del self._entries[message.number]
        return None

    def clear(self) -> list[tuple[OutboundMessage, tuple[int, ...]]]:
        """Empty the queue and return each message with its symbols that did not leave."""
        left = [(entry.message, entry.remaining()) for entry in self._entries.values()]
        self._heap.clear()
        self._entries.clear()
        return [(message, indices) for message, indices in left if indices]
