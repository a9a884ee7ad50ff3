"""When the interfaces are looked at: soon after a change, yet rarely enough that a flood of changes costs little.

A change is waited out for DEBOUNCE_S, since the kernel tells of one event (an interface that comes up) in many
messages. Between two looks lies as much time as keeps their share of one core below 1 in BUSY_FACTOR.
"""

from __future__ import annotations

SAFETY_NET_S = 10.0
"""Without any news the interfaces are looked at this often all the same."""
WITHOUT_NEWS_S = 2.0
"""The same while the kernel tells no news (a sandbox without netlink groups)."""
DEBOUNCE_S = 0.05
"""A change is acted on this long after its first message: the others of the same event come within it."""
MIN_GAP_S = 0.2
"""Containers that start on the same host change interfaces all the time; none of that is ours."""
BUSY_FACTOR = 10.0
"""A look that takes long (a host with thousands of interfaces or routes) happens more rarely."""
MAX_GAP_S = 2.0
"""But a change is never left waiting for longer than this."""
RETRY_S = 1.0
"""After a look that failed."""


class ScanSchedule:
    """Decides when to scan. All times are the caller's monotonic seconds."""

    def __init__(self, now: float, *, has_news: bool) -> None:
        self._every_s = SAFETY_NET_S if has_news else WITHOUT_NEWS_S
        self._earliest = now
        self._due = now

    @property
    def due(self) -> float:
        """When to scan next."""
        return self._due

    def changed(self, now: float) -> None:
        """Something changed, or may have (the kernel lost news for us)."""
        self._due = min(self._due, max(now + DEBOUNCE_S, self._earliest))

    def scanned(self, started: float, ended: float) -> None:
        """A scan is done."""
        self._earliest = ended + min(max(MIN_GAP_S, BUSY_FACTOR * (ended - started)), MAX_GAP_S)
        self._due = ended + self._every_s

    def failed(self, now: float) -> None:
        """A scan failed: try again soon."""
        self._earliest = self._due = now + RETRY_S
