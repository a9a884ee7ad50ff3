"""Counts what a path lost recently, for people.

Its link notes the counts a few times a second while datagrams leave. Two of the notes are kept, so that each path costs
a few numbers however much it carries.
"""

from __future__ import annotations

from typing import NamedTuple

HALF_WINDOW_S = 30.0
"""The window is between one and two of these long: an older note ends as the next one is this old. On a path at rest
it is longer by the time between two probes."""


class Recent(NamedTuple):
    """What left in a window, and how much of that got lost."""

    window_s: float
    sent: int
    """Datagrams."""
    lost: int
    """Those that were acknowledged after all do not count."""


class _Note(NamedTuple):
    at: float
    sent: int
    lost: int


class RecentLoss:
    """The counts of one path at two earlier moments. One thread writes, any may read."""

    __slots__ = ("_newer", "_older")

    def __init__(self, now: float) -> None:
        """Begin the window at `now` (monotonic, s), when nothing has left yet."""
        self._older = self._newer = _Note(now, 0, 0)

    def note(self, sent: int, lost: int, now: float) -> None:
        """Note how many datagrams were sent and lost since the path is known, losses less spurious ones."""
        age = now - self._newer.at
        if age < HALF_WINDOW_S:
            return
        newer = _Note(now, sent, lost)
        # After a long pause the earlier note is too old: what it began is over.
        self._older = newer if age > 2 * HALF_WINDOW_S else self._newer
        self._newer = newer

    def until(self, sent: int, lost: int, now: float) -> Recent:
        """Return what was sent and lost since the older note, from the counts of `now`."""
        begin = self._older
        return Recent(max(0.0, now - begin.at), max(0, sent - begin.sent), max(0, lost - begin.lost))
