"""Queues the data plane's events for the ROS thread and gives them out round robin, one event per robot.

So a robot that sends a thousand requests at once delays another's by one event, not by a thousand. The events of one
robot stay in order. Events that belong to no robot take turns as if they were one robot's.

The queue has no cap of its own. A request is here only while the engine counts it as running, where each robot has its
share of MAX_RUNNING and MAX_RUNNING_BYTES (`executions.py`), and at most two events follow it.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from typing import TYPE_CHECKING

from plr.sidecar.core.seam.application import AbandonExecution, CallsForbidden, CancelExecution, ExecuteRequest

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName
    from plr.sidecar.core.seam.application import ApplicationEvent


class EventQueue:
    """Events by robot. Any thread may call `put`; the rest belongs to the thread that takes."""

    __slots__ = ("_arrived", "_of")

    def __init__(self) -> None:
        self._arrived: deque[ApplicationEvent] = deque()
        """Events not yet sorted by robot. The ends of a deque need no lock."""
        self._of: OrderedDict[NodeName | None, deque[ApplicationEvent]] = OrderedDict()
        """Waiting events by robot, in the order of their turns; only robots with waiting events."""

    def __bool__(self) -> bool:
        return bool(self._of or self._arrived)

    def put(self, event: ApplicationEvent) -> None:
        """Queue an event."""
        self._arrived.append(event)

    def take(self) -> ApplicationEvent | None:
        """Return the event whose turn it is, or None."""
        self._sort()
        if not self._of:
            return None
        robot, events = next(iter(self._of.items()))
        event = events.popleft()
        if events:
            self._of.move_to_end(robot)
        else:
            del self._of[robot]
        return event

    def _sort(self) -> None:
        while self._arrived:
            event = self._arrived.popleft()
            robot = _robot_of(event)
            events = self._of.get(robot)
            if events is None:
                events = self._of[robot] = deque()
            events.append(event)


def _robot_of(event: ApplicationEvent) -> NodeName | None:
    match event:
        case ExecuteRequest() | CancelExecution() | AbandonExecution() | CallsForbidden():
            return event.robot
        case _:
            return None
