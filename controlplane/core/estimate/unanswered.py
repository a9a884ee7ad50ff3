"""Finds servers that take requests and answer none: their sidecar is there, but the ROS node behind it hangs.

For each copy that a robot measures, it reports whether the server had the whole request and yet gave no answer. One
answer ends what that robot said before; answers to two robots end what all of them said before.

One robot may be hacked, or merely odd. So a robot's word counts for no more than those of all others who say the same,
and two who got no answer outweigh one who says that it got one. A lone robot is believed if nobody else got an answer
recently. Times are monotonic seconds.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from plr.protos.base.histogram import MAX_COUNT

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from plr.protos.model.ids import NodeName, ServiceName
    from plr.protos.model.report import LatencyReport

    Pair = tuple[NodeName, ServiceName]

MAX_WORDS_OF_ROBOT = 64
"""Pairs of server and service for which one robot's word is kept; the one it mentioned longest ago is evicted."""

MAX_ANSWERED = 4
"""Robots kept that got an answer last, for each pair: two are needed, and nobody can take the places of all."""

LATELY_S = 120.0
"""For this long an answer to another robot contradicts one that alone gets none: one request in eight is measured."""

REMEMBERED_S = 600.0
"""After this long a robot's word that it gets no answer no longer counts."""


@dataclass(slots=True)
class _Lost:
    """A robot's requests without an answer since its last answer."""

    count: int
    since: float
    heard_at: float


@dataclass(slots=True)
class _Row:
    """What robots said last of one pair; each robot is in one of the two tables."""

    lost: dict[NodeName, _Lost] = field(default_factory=dict)
    answered: dict[NodeName, float] = field(default_factory=dict)
    """When each robot said that it got an answer, the earliest first."""


class Unanswered:
    """How many requests each server left unanswered, by service. Bounded by the number of robots present."""

    def __init__(self) -> None:
        self._rows: dict[Pair, _Row] = {}
        self._words: dict[NodeName, OrderedDict[Pair, None]] = {}
        """The rows that each robot is in."""
        self.forgotten = 0
        """Words dropped because a robot spoke of more pairs than are kept."""

    def __len__(self) -> int:
        return len(self._rows)

    def note(self, robot: NodeName, latencies: Collection[LatencyReport], now: float) -> None:
        """Count what a robot reports of the servers' shares of its requests: lost are those without an answer. Their
        order is not reported, so an answer counts for the whole report."""
        answered = {(one.server, one.service) for one in latencies if one.processing.answered}
        for pair in answered:
            self._note_answer(robot, pair, now)
        lost: Counter[Pair] = Counter()
        for one in latencies:
            if one.processing.lost and (one.server, one.service) not in answered:
                lost[one.server, one.service] += one.processing.lost
        for pair, count in lost.items():
            row = self._row_with(robot, pair)
            row.answered.pop(robot, None)
            before = row.lost.get(robot) or _Lost(0, now, now)
            row.lost[robot] = _Lost(min(before.count + count, MAX_COUNT), before.since, now)

    def _note_answer(self, robot: NodeName, pair: Pair, now: float) -> None:
        row = self._row_with(robot, pair)
        row.lost.pop(robot, None)
        row.answered.pop(robot, None)
        if row.lost and row.answered:
            # An answer from before the server hung tells nothing.
            last = max(row.answered.values())
            for other in [name for name, lost in row.lost.items() if lost.since <= last]:
                self._take_back(other, pair)
        row.answered[robot] = now
        if len(row.answered) > MAX_ANSWERED:
            self._take_back(next(iter(row.answered)), pair)

    def _row_with(self, robot: NodeName, pair: Pair) -> _Row:
        """Return the row of a pair that the robot is about to enter."""
        words = self._words.setdefault(robot, OrderedDict())
        words[pair] = None
        words.move_to_end(pair)
        if len(words) > MAX_WORDS_OF_ROBOT:
            self._take_back(robot, next(iter(words)))
            self.forgotten += 1
        return self._rows.setdefault(pair, _Row())

    def _take_back(self, robot: NodeName, pair: Pair) -> None:
        """Discard the robot's word on a pair."""
        words = self._words[robot]
        del words[pair]
        if not words:
            del self._words[robot]
        row = self._rows[pair]
        row.lost.pop(robot, None)
        row.answered.pop(robot, None)
        if not (row.lost or row.answered):
            del self._rows[pair]

    def begin(self, server: NodeName, services: Iterable[ServiceName]) -> None:
        """Forget what is known of these services there: another process serves them now, or none."""
        for service in services:
            pair = (server, service)
            row = self._rows.get(pair)
            if row is not None:
                for robot in (*row.lost, *row.answered):
                    self._take_back(robot, pair)

    def forget(self, robot: NodeName) -> None:
        """Discard all words of the robot: it is gone or has restarted."""
        for pair in list(self._words.get(robot, ())):
            self._take_back(robot, pair)

    def row(self, server: NodeName, service: ServiceName, now: float) -> int:
        """Return how many requests the server has left unanswered since its last answer, as far as that is believed."""
        row = self._rows.get((server, service))
        if row is None or not row.lost:
            return 0
        counts = [lost.count for lost in row.lost.values() if now - lost.heard_at <= REMEMBERED_S]
        if len(counts) > 1:
            total = sum(counts)
            return min(total, 2 * (total - max(counts)), MAX_COUNT)
        contradicted = any(now - at <= LATELY_S for at in row.answered.values())
        return 0 if contradicted else sum(counts)
