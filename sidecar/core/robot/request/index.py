"""Robot side: finds the requests in flight by whatever an event names, without a search through thousands."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName, ServiceName
    from plr.sidecar.core.base.values import PathId, RequestId
    from plr.sidecar.core.robot.request.request import Copy, Request

_Key = TypeVar("_Key")
_Entry = TypeVar("_Entry")
_Value = TypeVar("_Value")


class RequestIndex:
    """Requests by id, service, path and server."""

    __slots__ = ("_by_id", "_by_path", "_by_server", "_by_service", "_stranded")

    def __init__(self) -> None:
        self._by_id: dict[RequestId, Request] = {}
        self._by_service: dict[ServiceName, dict[RequestId, Request]] = {}
        self._stranded: dict[RequestId, Request] = {}
        self._by_path: dict[PathId, dict[RequestId, Request]] = {}
        self._by_server: dict[NodeName, dict[tuple[RequestId, int], tuple[Request, Copy]]] = {}

    def __contains__(self, request_id: object) -> bool:
        return request_id in self._by_id

    def __len__(self) -> int:
        return len(self._by_id)

    def get(self, request_id: RequestId) -> Request | None:
        """Return the request with this id."""
        return self._by_id.get(request_id)

    def add(self, request: Request) -> None:
        """Add a request; it is stranded until its first copy."""
        self._by_id[request.id] = request
        self._by_service.setdefault(request.service, {})[request.id] = request
        self._stranded[request.id] = request

    def add_copy(self, request: Request, copy: Copy) -> None:
        """Add a copy that was sent; it is the last one of `request.copies`."""
        self._stranded.pop(request.id, None)
        for path in copy.paths:
            self._by_path.setdefault(path, {})[request.id] = request
        numbered = request.id, len(request.copies) - 1
        self._by_server.setdefault(copy.path.peer, {})[numbered] = request, copy

    def strand(self, request: Request) -> None:
        """Note that none of the request's copies may be answered any more."""
        self._stranded[request.id] = request

    def remove(self, request: Request) -> bool:
        """Remove a request whose copies have all ended; return whether it was there."""
        if self._by_id.pop(request.id, None) is None:
            return False
        self._stranded.pop(request.id, None)
        _take_out(self._by_service, request.service, request.id)
        for number, copy in enumerate(request.copies):
            for path in copy.paths:
                _take_out(self._by_path, path, request.id)
            _take_out(self._by_server, copy.path.peer, (request.id, number))
        return True

    def all(self) -> list[Request]:
        """Return all requests."""
        return list(self._by_id.values())

    def services(self) -> list[ServiceName]:
        """Return the services that have requests in flight."""
        return list(self._by_service)

    def of(self, service: ServiceName) -> list[Request]:
        """Return the requests for a service, in order of arrival."""
        return list(self._by_service.get(service, {}).values())

    def stranded(self) -> list[Request]:
        """Return the requests that have no copy under way, the longest stranded first."""
        return list(self._stranded.values())

    def paths(self) -> list[PathId]:
        """Return the paths over which copies were sent."""
        return list(self._by_path)

    def uses(self, path: PathId) -> bool:
        """Return whether a copy of a request in flight was sent over this path."""
        return path in self._by_path

    def over(self, path: PathId) -> list[Request]:
        """Return the requests that had a copy sent over this path."""
        return list(self._by_path.get(path, {}).values())

    def copies_at(self, server: NodeName) -> list[tuple[Request, Copy]]:
        """Return all copies sent to a server."""
        return list(self._by_server.get(server, {}).values())

    def take_copies_at(self, server: NodeName) -> list[tuple[Request, Copy]]:
        """Return all copies sent to a server whose session is over, and forget that they were sent there."""
        return list(self._by_server.pop(server, {}).values())


def _take_out(index: dict[_Key, dict[_Entry, _Value]], key: _Key, entry: _Entry) -> None:
    entries = index.get(key)
    if entries is not None:
        entries.pop(entry, None)
        if not entries:
            del index[key]
