"""Keeps the connections that are not admitted yet: when there is no room, the oldest ends."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import asyncio


class HalfOpen:
    """The connections in one state of being opened; each is a task that admits it or ends it.

    A client that opens many from one address pushes out its own. The address may be a NAT with a fleet and its operator
    behind it, so a new connection is never refused because of the others from there. All calls take constant time.
    """

    __slots__ = ("_most", "_most_of_source", "_sources", "_tasks")

    def __init__(self, most: int, most_of_source: int) -> None:
        self._most = most
        self._most_of_source = most_of_source
        self._tasks: OrderedDict[asyncio.Task[None], str] = OrderedDict()
        """All connections with their sources, oldest first."""
        self._sources: dict[str, OrderedDict[asyncio.Task[None], None]] = {}

    def __len__(self) -> int:
        return len(self._tasks)

    def tasks(self) -> list[asyncio.Task[None]]:
        """Return all connections."""
        return list(self._tasks)

    def add(self, task: asyncio.Task[None], source: str) -> bool:
        """Add a connection from this source; return whether that cancelled the oldest, of the source or of all, for
        want of room."""
        before = len(self._tasks)
        of_source = self._sources.get(source)
        if of_source is not None and len(of_source) >= self._most_of_source:
            self._push_out(next(iter(of_source)))
        elif len(self._tasks) >= self._most:
            self._push_out(next(iter(self._tasks)))
        self._tasks[task] = source
        self._sources.setdefault(source, OrderedDict())[task] = None
        return len(self._tasks) == before

    def remove(self, task: asyncio.Task[None]) -> None:
        """Remove a connection that is admitted, over or in another state; does nothing if it was pushed out before."""
        source = self._tasks.pop(task, None)
        if source is None:
            return
        of_source = self._sources[source]
        del of_source[task]
        if not of_source:
            del self._sources[source]

    def _push_out(self, task: asyncio.Task[None]) -> None:
        self.remove(task)
        task.cancel()
