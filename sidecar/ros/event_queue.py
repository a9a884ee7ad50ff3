"""What the data plane tells the ROS thread, taken in turns: one event of each robot, then the next one of each.

So a robot that asks a thousand things at once delays another's request by one event, not by a thousand. A robot's own
events stay in their order. What belongs to no robot has its turn as if it were one.

There is no cap of its own: a request is here only while the engine counts it as running, where each robot has its share
of MAX_RUNNING and MAX_RUNNING_BYTES (`executions.py`), and is followed by two events at most.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from typing import TYPE_CHECKING

from sidecar.core.seam.application import AbandonExecution, CallsForbidden, CancelExecution, ExecuteRequest

if TYPE_CHECKING:
    from protos.model.ids import NodeName
    from sidecar.core.seam.application import ApplicationEvent


class EventQueue:
    """Events by robot. `put` is for any thread, the rest for the one that takes."""

    __slots__ = ("_arrived", "_of")

    def __init__(self) -> None:
        self._arrived: deque[ApplicationEvent] = deque()
        """Not sorted by robot yet. A deque's ends need no lock."""
        self._of: OrderedDict[NodeName | None, deque[ApplicationEvent]] = OrderedDict()
        """The one whose turn comes next first; only those of which something waits."""

    def __bool__(self) -> bool:
        return bool(self._of or self._arrived)

    def put(self, event: ApplicationEvent) -> None:
        """Let an event wait for its turn."""
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
