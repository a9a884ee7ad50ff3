"""Robot side: requests that no server's share of the outbox had room for when they might have been sent.

Those wait for a path as well, and there may be more of them than the outbox takes at once when it comes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from protos.model import ServiceName
    from sidecar.core.copies import Request
    from sidecar.core.events import RequestId


class NoRoom:
    """Service -> its requests without a copy, in order of arrival; as many as the request table holds."""

    def __init__(self) -> None:
        self._waiting: dict[ServiceName, dict[RequestId, Request]] = {}

    def __contains__(self, request: Request) -> bool:
        return request.id in self._waiting.get(request.service, ())

    def add(self, request: Request) -> None:
        """It found no room."""
        self._waiting.setdefault(request.service, {})[request.id] = request

    def remove(self, request: Request) -> None:
        """It is tried again, or over."""
        waiting = self._waiting.get(request.service)
        if waiting is not None and waiting.pop(request.id, None) is not None and not waiting:
            del self._waiting[request.service]

    def services(self) -> list[ServiceName]:
        """Those with requests that wait for room."""
        return list(self._waiting)

    def first(self, service: ServiceName) -> Request | None:
        """Return the one that waits longest."""
        return next(iter(self._waiting.get(service, {}).values()), None)
