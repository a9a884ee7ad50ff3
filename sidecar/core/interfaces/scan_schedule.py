"""Decides when to scan the interfaces: soon after a change, yet rarely enough that a flood of changes costs little.

A scan waits for DEBOUNCE_S after a change, since the kernel reports one event (an interface that comes up) in many
messages. The gap between two scans keeps their share of one core below 1 in BUSY_FACTOR.
"""

from __future__ import annotations

SAFETY_NET_S = 10.0
"""Interval of the scans that happen without any news."""
WITHOUT_NEWS_S = 2.0
"""The same while the kernel reports no news (a sandbox without netlink groups)."""
DEBOUNCE_S = 0.05
"""Time between a change's first message and the scan: the other messages of the same event come within it."""
MIN_GAP_S = 0.2
"""Least gap between scans: containers that start on the same host change interfaces of their own all the time."""
BUSY_FACTOR = 10.0
"""Least gap as a multiple of a scan's duration: slow scans (thousands of interfaces or routes) are made rarer."""
MAX_GAP_S = 2.0
"""Longest gap: a change never waits for longer than this."""
RETRY_S = 1.0
"""Time after a failed scan until the next one."""


class ScanSchedule:
    """Decides when to scan. All times are the caller's monotonic seconds."""

    def __init__(self, now: float, *, has_news: bool) -> None:
        self._every_s = SAFETY_NET_S if has_news else WITHOUT_NEWS_S
        self._earliest = now
        self._due = now

    @property
    def due(self) -> float:
        """Return when to scan next."""
        return self._due

    def changed(self, now: float) -> None:
        """Note that something changed, or may have (the kernel lost news for us)."""
        self._due = min(self._due, max(now + DEBOUNCE_S, self._earliest))

    def scanned(self, started: float, ended: float) -> None:
        """Note a finished scan."""
        self._earliest = ended + min(max(MIN_GAP_S, BUSY_FACTOR * (ended - started)), MAX_GAP_S)
        self._due = ended + self._every_s

    def failed(self, now: float) -> None:
        """Note a failed scan, to be repeated soon."""
        self._earliest = self._due = now + RETRY_S
