"""Cloud side: reports robots that ask for services they may not call, seldom enough for a log."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.sidecar.core.seam.application import CallsForbidden

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName, ServiceName

TELL_EVERY_S = 10.0
"""Least time between two notices about one robot."""
MAX_FORBIDDEN_ROBOTS = 1024
"""Robots noted; beyond that the one noted first is forgotten, and its next call is reported at once."""


@dataclass(slots=True)
class _Noted:
    told_at: float
    untold: int = 0


class ForbiddenCalls:
    """Counts the calls of each robot between notices."""

    def __init__(self) -> None:
        self._robots: dict[NodeName, _Noted] = {}

    def note(self, robot: NodeName, service: ServiceName, now: float) -> CallsForbidden | None:
        """Count one more refused call; return the notice to give now, if any."""
        noted = self._robots.get(robot)
        if noted is None:
            if len(self._robots) >= MAX_FORBIDDEN_ROBOTS:
                del self._robots[next(iter(self._robots))]
            self._robots[robot] = _Noted(now)
            return CallsForbidden(robot, service, 1)
        noted.untold += 1
        if now < noted.told_at + TELL_EVERY_S:
            return None
        notice = CallsForbidden(robot, service, noted.untold)
        self._robots[robot] = _Noted(now)
        return notice
