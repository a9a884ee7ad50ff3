"""Shares one local server in the cloud among robots, so that none can keep it from the others.

Three turns of four follow priority and deadline, regardless of the robot (`request_queue.py`). Every fourth turn
belongs to one robot: the robots with requests in time take these by turns, each with its own most urgent request. So a
robot that sends faster than the server answers, all of it marked urgent, leaves the others their share of a quarter of
the server's time. A single robot notices nothing.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Generic, TypeVar

from plr.sidecar.ros.cloud.request_queue import RequestQueue

if TYPE_CHECKING:
    from collections.abc import Hashable

    from plr.sidecar.core.base.values import Priority

SHARED_ONE_IN = 4
"""One turn in this many goes by robots."""

T = TypeVar("T", bound="Hashable")


class SharedQueue(Generic[T]):
    """Like RequestQueue, for requests that belong to robots."""

    __slots__ = ("_all", "_of", "_owner", "_turn")

    def __init__(self) -> None:
        self._all: RequestQueue[T] = RequestQueue()
        self._of: OrderedDict[Hashable, RequestQueue[T]] = OrderedDict()
        """Queues by robot, in the order of their turns; only robots with waiting requests."""
        self._owner: dict[T, Hashable] = {}
        self._turn = 0

    def __len__(self) -> int:
        return len(self._all)

    def __contains__(self, request: T) -> bool:
        return request in self._all

    def add(self, request: T, robot: Hashable, priority: Priority, deadline: float, expires: float) -> None:
        """Queue a robot's request, until `remove` at the latest."""
        self._all.add(request, priority, deadline, expires)
        own = self._of.get(robot)
        if own is None:
            own = self._of[robot] = RequestQueue()
        own.add(request, priority, deadline, expires)
        self._owner[request] = robot

    def remove(self, request: T) -> None:
        """Remove a request that is no longer wanted."""
        self._all.remove(request)
        self._disown(request)

    def take(self, now: float, hopeless_by: float, *, late_too: bool) -> tuple[T, bool] | None:
        """Return the request whose turn it is and whether it is late, like `RequestQueue.take`."""
        if len(self._of) > 1:
            self._turn = (self._turn + 1) % SHARED_ONE_IN
            if not self._turn and (found := self._take_of_next(now, hopeless_by)) is not None:
                return found
        found = self._all.take(now, hopeless_by, late_too=late_too)
        if found is not None:
            self._disown(found[0])
        return found

    def _take_of_next(self, now: float, hopeless_by: float) -> tuple[T, bool] | None:
        robot, own = next(iter(self._of.items()))
        self._of.move_to_end(robot)
        found = own.take(now, hopeless_by, late_too=False)
        if found is not None:
            self._all.remove(found[0])
            del self._owner[found[0]]
            if not own:
                del self._of[robot]
        return found

    def _disown(self, request: T) -> None:
        robot = self._owner.pop(request)
        own = self._of[robot]
        own.remove(request)
        if not own:
            del self._of[robot]

    def take_all(self) -> list[T]:
        """Remove and return all requests, in order of arrival."""
        self._of.clear()
        self._owner.clear()
        return self._all.take_all()
