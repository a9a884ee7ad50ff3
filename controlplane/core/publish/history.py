"""Remembers the last changes of every mapping, for the operator. Times are monotonic seconds."""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from plr.controlplane.core.problem.problem import BlockKey

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName, Version
    from plr.protos.model.mapping import MappingSet, ServiceMapping

MAX_REMEMBERED_CHANGES = 8
"""Changes remembered of one robot's service: two minutes of the maximum rate of changes for the better."""

MAX_HISTORIES = 8192
"""Services of robots with remembered changes: 4096 robots with two each. The least recently changed one is evicted."""


@dataclass(frozen=True, slots=True)
class SentMapping:
    """A mapping that was sent, and told something new."""

    at: float
    version: Version
    mapping: ServiceMapping


@dataclass(slots=True)
class History:
    """What one robot was sent for one service."""

    since: float
    """When its requests last changed their destinations."""
    changes: deque[SentMapping] = field(default_factory=lambda: deque(maxlen=MAX_REMEMBERED_CHANGES))


class MappingHistory:
    """The histories of all robots and services, including robots that are away, for when they are back."""

    def __init__(self) -> None:
        self._histories: OrderedDict[BlockKey, History] = OrderedDict()
        self.dropped = 0
        """Histories forgotten because there were too many."""

    def note(self, robot: NodeName, sent: MappingSet, now: float) -> None:
        """Remember what a robot is sent, unless only the prediction is new."""
        for mapping in sent.services:
            key = BlockKey(robot, mapping.service)
            history = self._histories.get(key)
            if history is None:
                history = self._histories[key] = History(now)
                if len(self._histories) > MAX_HISTORIES:
                    self._histories.popitem(last=False)
                    self.dropped += 1
            else:
                before = history.changes[0].mapping
                if (before.assignments, before.reason) == (mapping.assignments, mapping.reason):
                    continue
                if before.assignments != mapping.assignments:
                    history.since = now
                self._histories.move_to_end(key)
            history.changes.appendleft(SentMapping(now, sent.version, mapping))

    def of(self, key: BlockKey) -> History | None:
        """Return what a robot was sent for a service, the newest first; None if that is forgotten."""
        return self._histories.get(key)
