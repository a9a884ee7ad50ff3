"""Robot side: holds requests that no server's share of the outbox had room for when they could have been sent.

Requests for the same servers wait in one line for each lane (`room.py`), whatever their services. A later request
overtakes them only if it is more urgent: a server that somebody waits for is full for later requests, too.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from plr.sidecar.core.transfer.room import Lane
from plr.sidecar.core.transfer.waiting_line import WaitingLine

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from plr.protos.model.ids import NodeName
    from plr.sidecar.core.base.values import RequestId
    from plr.sidecar.core.robot.dispatch.dispatcher import Dispatching
    from plr.sidecar.core.robot.request.request import Request
    from plr.sidecar.core.transfer.routes import Routes

    _Group = tuple[Lane, tuple[NodeName, ...]]


class NoRoom:
    """Waiting requests, which have no copy that may be answered; as many as the request table holds."""

    def __init__(self, dispatching: Dispatching, routes: Routes) -> None:
        self._dispatching = dispatching
        self._routes = routes
        self._lines: dict[_Group, WaitingLine[RequestId]] = {}
        self._waiting: dict[RequestId, tuple[Request, _Group]] = {}
        self._awaited: Counter[tuple[Lane, NodeName]] = Counter()

    def __len__(self) -> int:
        return len(self._waiting)

    def __contains__(self, request: Request) -> bool:
        return request.id in self._waiting

    def open_to(self, request: Request, servers: Iterable[NodeName]) -> list[NodeName]:
        """Return those of the servers that have room for the request and that no other request waits for."""
        if self._awaited:
            lane = Lane.of(request.size)
            servers = [each for each in servers if (lane, each) not in self._awaited]
        return self._dispatching.with_room(servers, request)

    def consider(self, request: Request, *, rejected: bool = False) -> bool:
        """Let a request wait if it could be sent now (or again) and lacks nothing but room; return whether it waits."""
        if request.id in self._waiting:
            return True
        if request.answered_locally or not request.may_be_sent():
            return False
        reached = self._reached(self._dispatching.candidates(request, rejected=rejected))
        lane = Lane.of(request.size)
        if reached and all((lane, each) in self._awaited for each in self._dispatching.with_room(reached, request)):
            self._add(request, (lane, reached))
            return True
        return False

    def _reached(self, servers: Iterable[NodeName]) -> tuple[NodeName, ...]:
        return tuple(server for server in servers if self._routes.reaches(server))

    def _add(self, request: Request, group: _Group) -> None:
        self._waiting[request.id] = request, group
        self._awaited.update((group[0], server) for server in group[1])
        line = self._lines.setdefault(group, WaitingLine())
        line.add(request.id, request.rule.priority, request.deadline_at, request.size)

    def remove(self, request: Request, *, went: bool = False) -> None:
        """Remove a request that is over, or whose turn has come (`went`), if it waits."""
        _, group = self._waiting.pop(request.id, (request, None))
        if group is None:
            return
        line = self._lines[group]
        if went:
            line.went(request.id)
        else:
            line.remove(request.id)
        if not len(line):
            del self._lines[group]
        for server in group[1]:
            place = group[0], server
            self._awaited[place] -= 1
            if not self._awaited[place]:
                del self._awaited[place]

    def going(self, now: float) -> Iterator[tuple[Request, list[NodeName]]]:
        """Remove and yield the requests that there is room for, each in its turn, with the servers that have it.

        The caller sends each before it asks for the next one.
        """
        full: set[tuple[Lane, NodeName]] = set()
        before = len(self) + 1
        while 0 < len(self) < before:
            before = len(self)
            for request in self._heads(now):
                if request not in self:
                    continue  # it ended since the last one went
                lane, servers = Lane.of(request.size), self._dispatching.candidates(request)
                reached = self._reached(servers)
                room = self._dispatching.with_room((each for each in servers if (lane, each) not in full), request)
                if reached and not any(server in room for server in reached):
                    full.update((lane, server) for server in reached)
                    continue
                self.remove(request, went=True)
                yield request, room

    def _heads(self, now: float) -> list[Request]:
        """Return the request of each line whose turn it is, the most urgent first."""
        found = (line.first(now) for line in list(self._lines.values()))
        heads = [self._waiting[request_id][0] for request_id in found if request_id is not None]
        return sorted(heads, key=lambda request: (request.rule.priority, request.deadline_at))
