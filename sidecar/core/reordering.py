"""How much a path reorders, seen from losses that were none: what was declared lost and acknowledged all the same.

Radio links retransmit below us, so that some datagrams are overtaken by many. As long as that is not seen, three later
acknowledgements prove a loss (RFC 9002 section 6.1.1). Once it is, only time does, and the time threshold grows by how
much too early it was, to one round trip more at most (after RACK, RFC 8985 section 6.2, steps 2 and 4).
"""

from __future__ import annotations

from collections import deque
from itertools import takewhile
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sidecar.core.rtt import RttEstimator
    from sidecar.core.sent import Sent

PACKET_THRESHOLD = 3
"""A datagram is lost when one sent this many later is acknowledged (RFC 9002 section 6.1.1)."""
PERSISTS = 16
"""What is known of reordering is forgotten after so many losses that stayed losses (RACK's reo_wnd_persist)."""
MAX_REMEMBERED = 64
"""Lost runs whose late acknowledgement is still noticed; beyond that the oldest are forgotten."""
MEMORY_FACTOR = 4.0
"""They are forgotten after this many probe timeouts: a later acknowledgement is not reordering."""


class Reordering:
    """Lost datagrams of one path that may still turn up, and what follows for the thresholds."""

    __slots__ = ("_extra_s", "_lost", "_persists", "spurious")

    def __init__(self) -> None:
        self._lost: deque[tuple[Sent, bool]] = deque(maxlen=MAX_REMEMBERED)
        """With whether a threshold said so (and not a probe timeout)."""
        self._extra_s = 0.0
        self._persists = 0
        self.spurious = 0
        """Datagrams declared lost that had arrived."""

    @property
    def packet_threshold(self) -> int | None:
        """Datagrams; None where order means nothing."""
        return None if self._persists else PACKET_THRESHOLD

    def loss_delay(self, rtt: RttEstimator) -> float:
        """Seconds after which a datagram older than an acknowledged one is lost (RFC 9002 section 6.1.2)."""
        return rtt.loss_delay() + min(self._extra_s, rtt.smoothed)

    def note_lost(self, lost: Sequence[Sent], *, by_threshold: bool) -> None:
        """These were declared lost."""
        self._lost.extend((run, by_threshold) for run in lost)
        if by_threshold and self._persists:
            self._persists -= 1
            if not self._persists:
                self._extra_s = 0.0

    def late(self, ranges: Sequence[tuple[int, int]], rtt: RttEstimator, now: float) -> list[Sent]:
        """Take an acknowledgement's ranges (inclusive); returns what of the lost it acknowledges."""
        if not self._lost:
            return []
        limit = now - MEMORY_FACTOR * rtt.probe_timeout(0.0)
        arrived: list[Sent] = []
        kept: list[tuple[Sent, bool]] = []
        for run, by_threshold in self._lost:
            if run.at < limit:
                continue
            parts = _covered(run, ranges)
            if not parts:
                kept.append((run, by_threshold))
                continue
            arrived += parts
            kept += [(part, by_threshold) for part in _gaps(run, parts)]
            if by_threshold:
                self._persists = PERSISTS
                self._extra_s = max(self._extra_s, now - run.at - rtt.loss_delay())
        self._lost = deque(kept, MAX_REMEMBERED)
        self.spurious += sum(run.datagrams for run in arrived)
        return arrived

    def forget_old(self, rtt: RttEstimator, now: float) -> None:
        """Let go of what can not turn up any more: it holds its message in memory."""
        limit = now - MEMORY_FACTOR * rtt.probe_timeout(0.0)
        lost = self._lost
        for _ in list(takewhile(lambda item: item[0].at < limit, lost)):
            lost.popleft()


def _covered(run: Sent, ranges: Sequence[tuple[int, int]]) -> list[Sent]:
    """The parts of a run that inclusive ranges, highest first, cover; lowest first."""
    parts = []
    for low, high in reversed(ranges):
        first, end = max(low, run.first), min(high + 1, run.end)
        if first < end:
            parts.append(run.cut(first, end))
    return parts


def _gaps(run: Sent, parts: Sequence[Sent]) -> list[Sent]:
    """What of a run is left without these parts of it, lowest first."""
    left = []
    first = run.first
    for part in parts:
        if first < part.first:
            left.append(run.cut(first, part.first))
        first = part.end
    if first < run.end:
        left.append(run.cut(first, run.end))
    return left
