"""Sets how often sidecars report and how long their leases last, by their number and how busy the control plane is.

A report costs the same in a fleet of ten as in one of ten thousand. So its interval grows with about the square root of
the number: ten sidecars report at the configured interval, a thousand at 12.6 times it, and together they send eight
times as much instead of a hundred. Urgent news is reported at once whatever the interval (`ControlSession`). A control
plane that is busy all the same stretches the interval further.
"""

from __future__ import annotations

import math

FULL_PACE = 10
"""Up to this number, sidecars report at the configured interval."""

GROWTH = 0.55
"""Exponent of their number by which it grows: 1,000 sidecars, at 6.3 s instead of 0.5, take a quarter of a core."""

MAX_INTERVAL_S = 10.0
"""Maximum to which pacing lengthens a shorter interval: histograms fade with a minute's half-life."""

REPORTS_PER_LEASE = 3.0
"""A lease outlasts two lost reports; heartbeats, a third of a lease apart, then cost nothing beside reports."""

BUSY, IDLE = 0.6, 0.3
"""Shares of one core above which intervals are stretched, and below which that is undone."""

BUSY_WEIGHT = 0.2
"""Weight of the newest sample, each second, in the average: load that is over in a second or two stretches nothing."""

STRETCH_STEP = 1.25
MAX_STRETCH = 8.0

ADMITTED_PER_S = 150.0
"""Registrations that one core handles in a second."""

LEAST_RECONNECT_S = 1.0
"""Interval allowed between the attempts of a small fleet."""

WORTH_TELLING = 1.25
"""The interval changes at least by this factor: not with each sidecar that comes."""

FAR_OFF = 2.0
"""A sidecar is told at once when its interval is off by this factor ..."""

SETTLED_S = 10.0
"""... and otherwise when the interval has stood for this long: while a fleet comes, it changes each second, and every
sidecar would be told four times."""


class Pacing:
    """The interval and the lease in force, from the configured ones in seconds."""

    def __init__(self, *, interval_s: float, lease_s: float) -> None:
        self._least_interval_s = interval_s
        self._least_lease_s = lease_s
        self._stretch = 1.0
        self._sidecars = 0
        self._busy = 0.0
        self._since = -math.inf
        """When the interval last changed."""
        self.interval_s = interval_s

    @property
    def lease_s(self) -> float:
        """How long a sidecar may be silent."""
        return max(self._least_lease_s, REPORTS_PER_LEASE * self.interval_s)

    @property
    def reconnect_max_s(self) -> float:
        """How far apart a sidecar's attempts to connect may be: in this time as many come back as are let in."""
        return min(max(self._sidecars / ADMITTED_PER_S, LEAST_RECONNECT_S), MAX_INTERVAL_S)

    def follow(self, sidecars: int, now: float, busy: float | None = None) -> None:
        """Note how many there are, or are about to be; `busy` is the share of one core used recently, if that is
        news."""
        self._sidecars = sidecars
        if busy is not None:
            self._busy += BUSY_WEIGHT * (busy - self._busy)
            if self._busy > BUSY:
                self._stretch = min(self._stretch * STRETCH_STEP, MAX_STRETCH)
            elif self._busy < IDLE:
                self._stretch = max(self._stretch / STRETCH_STEP, 1.0)
        most = max(MAX_INTERVAL_S, self._least_interval_s)
        paced = self._least_interval_s * (max(sidecars, FULL_PACE) / FULL_PACE) ** GROWTH
        wanted = min(paced * self._stretch, most)
        if wanted == self.interval_s:
            return
        if _is_far(wanted, self.interval_s, WORTH_TELLING) or wanted in (self._least_interval_s, most):
            self.interval_s = wanted
            self._since = now

    def worth_telling(self, told_s: float, now: float) -> bool:
        """Return whether a sidecar that was told this interval should be told the one in force."""
        if told_s == self.interval_s:
            return False
        return _is_far(told_s, self.interval_s, FAR_OFF) or now - self._since >= SETTLED_S


def _is_far(one_s: float, other_s: float, factor: float) -> bool:
    return not 1.0 / factor < one_s / other_s < factor
