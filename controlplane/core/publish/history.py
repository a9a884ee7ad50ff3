"""Remembers the last changes of every mapping, for the operator. Times are monotonic seconds."""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from plr.controlplane.core.base.holders import Holders

if TYPE_CHECKING:
    from plr.controlplane.core.problem.problem import BlockKey
    from plr.protos.model.ids import NodeName, ServiceName, Version
    from plr.protos.model.mapping import MappingSet, ServiceMapping

MAX_REMEMBERED_CHANGES = 8
"""Changes remembered of one robot's service: two minutes of the maximum rate of changes for the better."""

MAX_HISTORIES = 8192
"""Services of robots with remembered changes: 4096 robots with two each. When they are too many, the robot with most of
them loses the one that changed least recently."""


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
        self._of: dict[NodeName, OrderedDict[ServiceName, History]] = {}
        """Histories of each robot, the one that changed last at the end."""
        self._count = 0
        self._holders: Holders[NodeName] = Holders()
        self.dropped = 0
        """Histories forgotten because there were too many."""

    def note(self, robot: NodeName, sent: MappingSet, now: float) -> None:
        """Remember what a robot is sent, unless only the prediction is new."""
        for mapping in sent.services:
            own = self._of.setdefault(robot, OrderedDict())
            history = own.get(mapping.service)
            if history is None:
                history = own[mapping.service] = History(now)
                self._holders.add(robot)
                self._count += 1
                if self._count > MAX_HISTORIES:
                    self._evict()
            else:
                before = history.changes[0].mapping
                if (before.assignments, before.reason) == (mapping.assignments, mapping.reason):
                    continue
                if before.assignments != mapping.assignments:
                    history.since = now
                own.move_to_end(mapping.service)
            history.changes.appendleft(SentMapping(now, sent.version, mapping))

    def _evict(self) -> None:
        robot = self._holders.greediest()
        own = self._of[robot]
        own.popitem(last=False)
        if not own:
            del self._of[robot]
        self._holders.remove(robot)
        self._count -= 1
        self.dropped += 1

    def of(self, key: BlockKey) -> History | None:
        """Return what a robot was sent for a service, the newest first; None if that is forgotten."""
        own = self._of.get(key.robot)
        return own.get(key.service) if own is not None else None
