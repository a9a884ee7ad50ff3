"""Limits what one sidecar may demand of the control plane over its stream."""

from __future__ import annotations

from collections import Counter

from plr.protos.base.token_bucket import TokenBucket

TOO_MANY_STREAMS = "too_many_streams"
TOO_FAST = "too_fast"

MAX_STREAM_MESSAGE_BYTES = 4 << 20
"""Longest message either way: 4096 peers with their credentials stay below, as does a report on as many paths."""

MAX_FIRST_BYTES = 64 << 10
"""Longest first message of a stream, from an unknown sender: a registration takes 4 KiB at most."""

MAX_STREAMS_PER_NAME = 3
"""Open streams of one name: the one in use, the one that replaces it, and one that has just been replaced."""

MAX_STREAMS_PER_CONNECTION = 8
"""Open streams of one connection: a sidecar opens one, a health check or reflection a few."""

MESSAGES_PER_S = 50.0
"""Message rate: besides reports a sidecar sends heartbeats, acks and sometimes its addresses, 20 a second at most."""

MESSAGES_BURST = 500.0
"""Burst of messages: one message of the largest size takes half of it."""

BYTES_PER_TOKEN = 16 << 10
"""A message costs one token, and one more for each of these many bytes."""


class StreamRate:
    """Limits the rate of one stream: its messages, weighted by size, plus its reports at their interval."""

    def __init__(self, *, report_interval_s: float, now: float) -> None:
        # Twice the rate asked for: a clock may be fast, and after a stall reports arrive together.
        self._bucket = TokenBucket(rate=MESSAGES_PER_S + 2.0 / report_interval_s, burst=MESSAGES_BURST, now=now)

    def take(self, size: int, now: float) -> bool:
        """Take tokens for a message of `size` bytes; return False if it comes too fast."""
        return self._bucket.take(now, 1.0 + size // BYTES_PER_TOKEN)


class StreamCount:
    """Counts open streams by name."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()

    def enter(self, name: str) -> bool:
        """Count one more stream; return False, and do not count it, if that is too many."""
        if self._counts[name] >= MAX_STREAMS_PER_NAME:
            return False
        self._counts[name] += 1
        return True

    def leave(self, name: str) -> None:
        """Count one stream fewer."""
        self._counts[name] -= 1
        if self._counts[name] <= 0:
            del self._counts[name]
