"""Robot side: now and then, one more copy of a request over a path that the mapping does not use.

The control plane says which pair of an interface and a server would teach it most (`ServiceMapping.explore`); what it
learns there is of real requests, which probes are no match for. The copy is never in place of a mapped one, and goes
only beside requests whose copies are all measured anyway (`copies.OBSERVED_ONE_IN`), so that what is measured stays
unbiased: which request that is depends on its id, nothing else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sidecar.core.copies import OBSERVED_ONE_IN
from sidecar.core.path_id import PathState

if TYPE_CHECKING:
    from collections.abc import Collection

    from protos.model import NodeName, ServiceName
    from sidecar.core.copies import Request
    from sidecar.core.mapping import MappingTable
    from sidecar.core.outbox import Outbox
    from sidecar.core.path_id import PathId
    from sidecar.core.routes import Routes

MIN_INTERVAL_S = 5.0
"""Between two such copies for one service: 12 a minute at most, however many requests there are."""

MAX_REQUEST_BYTES = 128 * 1024
"""Larger requests are not worth it. With the interval above, a service costs at most 1.6 MB a minute more."""

MAX_MAPPED_COPIES = 4
"""A request with more copies gets none besides: half of `requests.MAX_COPIES`, the rest is for trouble."""

MAX_WAITING_MESSAGES = 4
"""An interface with more undelivered messages is busy: a copy that need not be would hold others up."""


class Exploration:
    """Decides which requests explore."""

    def __init__(self, mapping: MappingTable, routes: Routes, outbox: Outbox) -> None:
        self._mapping = mapping
        self._routes = routes
        self._outbox = outbox
        self._next_at: dict[ServiceName, float] = {}
        """When a service may explore again; only those that have to wait."""

    def path(self, request: Request, servers: Collection[NodeName], now: float) -> PathId | None:
        """The path for one more copy of this request, whose mapped copies have just been sent; mostly None.

        `servers` are those that offer the service and have room for the request.
        """
        mapping = self._mapping.services.get(request.service)
        pair = mapping.explore if mapping is not None else None
        if pair is None or pair.server not in servers or not self._is_chosen(request):
            return None
        if self._next_at.get(request.service, now) > now:
            return None
        route = self._routes.best_over(pair.interface, pair.server)
        if route is None or route.state is not PathState.UP:
            return None
        if any((copy.path.interface, copy.path.peer) == (pair.interface, pair.server) for copy in request.copies):
            return None
        if self._outbox.waiting_over(pair.interface) > MAX_WAITING_MESSAGES:
            return None
        self._next_at = {service: at for service, at in self._next_at.items() if at > now}
        self._next_at[request.service] = now + MIN_INTERVAL_S
        return route.id

    def _is_chosen(self, request: Request) -> bool:
        rule = request.rule
        if not rule.idempotent or len(request.payload or b"") > MAX_REQUEST_BYTES:
            return False
        if not 0 < len(request.copies) <= MAX_MAPPED_COPIES or not request.is_race():
            return False
        return int.from_bytes(request.id[:4], "big") / 2**32 < rule.exploration * OBSERVED_ONE_IN
