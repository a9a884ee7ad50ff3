"""Connections that are not let in yet: of more than there is room for the oldest end."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import asyncio


class HalfOpen:
    """In one state of being opened; each is a task that lets it in or ends it.

    Who opens many from one address pushes out his own: an address may be a NAT, with a fleet and its operator behind
    it, so a new one is never refused for the others that came from there. All calls take as long whatever their number.
    """

    __slots__ = ("_most", "_most_of_source", "_sources", "_tasks")

    def __init__(self, most: int, most_of_source: int) -> None:
        self._most = most
        self._most_of_source = most_of_source
        self._tasks: OrderedDict[asyncio.Task[None], str] = OrderedDict()
        """All, with their sources, oldest first."""
        self._sources: dict[str, OrderedDict[asyncio.Task[None], None]] = {}

    def __len__(self) -> int:
        return len(self._tasks)

    def tasks(self) -> list[asyncio.Task[None]]:
        """All of them."""
        return list(self._tasks)

    def add(self, task: asyncio.Task[None], source: str) -> bool:
        """One more from this source; returns whether there was no room: then the oldest of the source, or of all, is
        cancelled."""
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
        """It is let in or over, or in another state; or it was pushed out before."""
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
