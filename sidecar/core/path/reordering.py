"""Learns from late acknowledgements of lost datagrams: they prove that the path lives, and how much it reorders.

Radio links retransmit below us, so that many datagrams overtake some. Until that is seen, three later acknowledgements
prove a loss (RFC 9002 section 6.1.1). After that only time does. The time threshold grows by how much it was too early,
to at most one more round trip (after RACK, RFC 8985 section 6.2, steps 2 and 4).

Where round trips grow by seconds at once, everything is declared lost before its acknowledgement comes. Packet numbers
are never reused, so each such acknowledgement tells how long the path takes now.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from enum import Enum, auto
from itertools import takewhile
from typing import TYPE_CHECKING, NamedTuple

from plr.sidecar.core.path.congestion.rtt import LONGEST_ANSWER_S

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from plr.sidecar.core.path.congestion.rtt import RttEstimator
    from plr.sidecar.core.path.in_flight import Sent

PACKET_THRESHOLD = 3
"""A datagram is lost when one sent this many later is acknowledged (RFC 9002 section 6.1.1)."""
PERSISTS = 16
"""Losses that stayed losses after which learned reordering is forgotten (RACK's reo_wnd_persist)."""
MAX_LOST_RUNS = 64
"""Lost runs whose late acknowledgement is still noticed; beyond that the oldest are forgotten."""
MEMORY_FACTOR = 4.0
"""A datagram acknowledged after this many probe timeouts was not overtaken: the path was slow, or away."""


class _Why(Enum):
    THRESHOLD = auto()
    """Later datagrams arrived: it is missing."""
    TIMEOUT = auto()
    """Nothing arrived: it may or may not be missing."""
    OVERTAKEN = auto()
    """Nothing arrived at first, then a later datagram."""
    OUTAGE = auto()
    """The path went down."""


_MISSING = frozenset({_Why.THRESHOLD, _Why.OVERTAKEN})


class _Lost(NamedTuple):
    run: Sent
    why: _Why


class Reordering:
    """Lost datagrams of one path that may still turn up, and their effect on the thresholds."""

    __slots__ = ("_extra_s", "_lost", "_persists", "missed", "spurious")

    def __init__(self) -> None:
        self._lost: deque[_Lost] = deque(maxlen=MAX_LOST_RUNS)
        self._extra_s = 0.0
        self._persists = 0
        self.spurious = 0
        """Datagrams declared lost that had arrived."""
        self.missed = 0
        """Datagrams known to be missing while others arrived, less those that turned up."""

    @property
    def remembers(self) -> bool:
        """Whether `forget_old` may have something to do."""
        return bool(self._lost)

    @property
    def packet_threshold(self) -> int | None:
        """In datagrams; None where order means nothing."""
        return None if self._persists else PACKET_THRESHOLD

    def loss_delay(self, rtt: RttEstimator) -> float:
        """Return the seconds after which a datagram older than an acknowledged one is lost (RFC 9002 section 6.1.2)."""
        return rtt.loss_delay() + min(self._extra_s, rtt.smoothed)

    def note_lost(self, lost: Sequence[Sent], *, by_threshold: bool) -> None:
        """Note datagrams that were declared lost."""
        why = _Why.THRESHOLD if by_threshold else _Why.TIMEOUT
        self._remember(lost, why)
        if by_threshold:
            self.missed += sum(run.datagrams for run in lost)
        if by_threshold and self._persists:
            self._persists -= 1
            if not self._persists:
                self._extra_s = 0.0

    def note_given_up(self, lost: Sequence[Sent]) -> None:
        """Note datagrams in flight when the path went down."""
        self._remember(lost, _Why.OUTAGE)

    def _remember(self, lost: Iterable[Sent], why: _Why) -> None:
        # What it reported FINISHED is sent again by then, and there may be many.
        self._lost.extend(_Lost(run._replace(finished=()) if run.finished else run, why) for run in lost)

    def late(self, ranges: Sequence[tuple[int, int]], rtt: RttEstimator, now: float) -> list[Sent]:
        """Take an acknowledgement's ranges (inclusive); return the lost runs it acknowledges."""
        if not self._lost:
            return []
        rising = ranges[::-1]
        highs = [high for _, high in rising]
        overtaken_since = now - MEMORY_FACTOR * rtt.probe_timeout(0.0)
        arrived: list[Sent] = []
        kept: list[_Lost] = []
        for lost in self._lost:
            run, why = lost
            if run.at < now - LONGEST_ANSWER_S:
                continue
            parts = _covered(run, rising, highs)
            if not parts:
                kept.append(lost)
                continue
            arrived += parts
            kept += [_Lost(part, why) for part in _gaps(run, parts)]
            count = sum(part.datagrams for part in parts)
            self.spurious += count
            if why in _MISSING:
                self.missed -= count
            if why is _Why.THRESHOLD and run.at >= overtaken_since:
                self._persists = PERSISTS
                self._extra_s = max(self._extra_s, now - run.at - rtt.loss_delay())
        self._lost = deque(kept, MAX_LOST_RUNS)
        return arrived

    def overtaken(self, largest_acked: int) -> None:
        """Note that this packet number arrived: whatever timed out without news and left before it is missing."""
        lost = self._lost
        for position, (run, why) in enumerate(lost):
            if why is _Why.TIMEOUT and run.end <= largest_acked:
                lost[position] = _Lost(run, _Why.OVERTAKEN)
                self.missed += run.datagrams

    def forget_old(self, now: float) -> None:
        """Release what cannot turn up any more, and messages that are over, from memory."""
        lost = self._lost
        for _ in list(takewhile(lambda item: item.run.at < now - LONGEST_ANSWER_S, lost)):
            lost.popleft()
        for position, (run, why) in enumerate(lost):
            if run.message is not None and run.message.over:
                lost[position] = _Lost(run._replace(message=None), why)

    def forget(self) -> None:
        """Forget the lost: a later acknowledgement of them proves nothing."""
        self._lost.clear()


def _covered(run: Sent, ranges: Sequence[tuple[int, int]], highs: Sequence[int]) -> list[Sent]:
    """Return the parts of a run that inclusive ranges cover; `highs` are their ends. All lowest first."""
    parts = []
    position = bisect_left(highs, run.first)
    while position < len(ranges):
        low, high = ranges[position]
        if low >= run.end:
            break
        position += 1
        parts.append(run.cut(max(low, run.first), min(high + 1, run.end)))
    return parts


def _gaps(run: Sent, parts: Sequence[Sent]) -> list[Sent]:
    """Return what remains of a run without these parts of it, lowest first."""
    left = []
    first = run.first
    for part in parts:
        if first < part.first:
            left.append(run.cut(first, part.first))
        first = part.end
    if first < run.end:
        left.append(run.cut(first, run.end))
    return left
