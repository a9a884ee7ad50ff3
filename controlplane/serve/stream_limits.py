"""How much one sidecar may ask of the control plane over its stream."""

from __future__ import annotations

from collections import Counter

from protos.base.token_bucket import TokenBucket

TOO_MANY_STREAMS = "too_many_streams"
TOO_FAST = "too_fast"

MAX_MESSAGE_BYTES = 4 << 20
"""Longest message either way: 4096 peers with their credentials, or a report on as many paths, stay below."""

MAX_FIRST_BYTES = 64 << 10
"""Longest first message of a stream, before anything is known of who speaks: a registration takes 4 KiB at most."""

MAX_STREAMS_PER_NAME = 3
"""The one in use, the one that replaces it, and one that has just been replaced."""

MAX_STREAMS_PER_CONNECTION = 8
"""A sidecar opens one; a health check or reflection a few."""

MESSAGES_PER_S = 50.0
"""Beside its reports a sidecar sends heartbeats, acks and now and then its addresses: 20 a second at the very most."""

MESSAGES_BURST = 500.0
"""One message of the largest size is half of it."""

BYTES_PER_TOKEN = 16 << 10
"""A message costs one token, and one more for each so many bytes."""


class StreamRate:
    """How fast one stream may speak: its messages, weighted by size, and what its reports need at their interval."""

    def __init__(self, *, report_interval_s: float, now: float) -> None:
        # Twice what is asked for: a clock may be fast, and after a stall reports come together.
        self._bucket = TokenBucket(rate=MESSAGES_PER_S + 2.0 / report_interval_s, burst=MESSAGES_BURST, now=now)

    def take(self, size: int, now: float) -> bool:
        """A message of `size` bytes came; False if that is too fast."""
        return self._bucket.take(now, 1.0 + size // BYTES_PER_TOKEN)


class StreamCount:
    """Open streams by name."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()

    def enter(self, name: str) -> bool:
        """One more stream; False if that is too many, and then it does not count."""
        if self._counts[name] >= MAX_STREAMS_PER_NAME:
            return False
        self._counts[name] += 1
        return True

    def leave(self, name: str) -> None:
        """One stream fewer."""
        self._counts[name] -= 1
        if self._counts[name] <= 0:
            del self._counts[name]
