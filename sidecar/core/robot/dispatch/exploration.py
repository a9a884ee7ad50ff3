"""Robot side: occasionally sends one more copy of a request over a path that is not used otherwise.

The control plane names the pair of an interface and a server that would teach it most (`ServiceMapping.explore`). There
it learns from real requests, which probes cannot replace. Where a service's `RedundancyMode` or a budget leaves out
mapped pairs, these take turns with it. The copy never replaces a mapped one, and accompanies only requests whose copies
are all measured anyway (`OBSERVED_ONE_IN`), so that measurements stay unbiased: which requests these are depends on
their ids only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.base.values import PathState

if TYPE_CHECKING:
    from collections.abc import Collection

    from plr.protos.model.ids import NodeName, ServiceName
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.robot.request.mapping_table import MappingTable
    from plr.sidecar.core.robot.request.request import Request
    from plr.sidecar.core.transfer.outbox import Outbox
    from plr.sidecar.core.transfer.routes import Routes

MAX_PER_S = 0.2
"""Most such copies of one service per second: 12 a minute, however many requests there are."""

MAX_SAVED = 6.0
"""Copies that may be saved up for when much is to be learned at once, as when a mapping has become bad."""

MIN_INTERVAL_S = 0.5
"""Least time between two copies of one service, so that they do not all measure the same moment."""

MAX_EXPLORING_BYTES = 128 * 1024
"""Larger requests are not worth exploring with. A service costs at most 1.6 MB a minute more."""

MAX_COPIES_TO_EXPLORE = 4
"""A request with more copies does not explore: half of `dispatcher.MAX_COPIES_OF_REQUEST`, the rest is for trouble."""

MAX_WAITING_MESSAGES = 4
"""An interface with more undelivered messages is busy: an unnecessary copy would hold others up."""


class ExplorationBudget:
    """Budget of the copies that one service may send to explore."""

    __slots__ = ("_next_at", "_saved", "_seen_at")

    def __init__(self, now: float) -> None:
        self._saved = 1.0
        self._seen_at = now
        self._next_at = now

    def earn(self, share: float, now: float) -> None:
        """Credit a request of a service that may explore with this share of its requests."""
        self._saved = min(MAX_SAVED, self._saved + min(share, MAX_PER_S * (now - self._seen_at)))
        self._seen_at = now

    def suffices(self, now: float) -> bool:
        """Return whether a copy may be sent now."""
        return self._saved >= 1.0 and now >= self._next_at

    def spend(self, now: float) -> None:
        """Charge a copy that is sent."""
        self._saved -= 1.0
        self._next_at = now + MIN_INTERVAL_S


class Exploration:
    """Decides which requests explore."""

    def __init__(self, mapping: MappingTable, routes: Routes, outbox: Outbox) -> None:
        self._mapping = mapping
        self._routes = routes
        self._outbox = outbox
        self._budgets: dict[ServiceName, ExplorationBudget] = {}
        """Budgets of the mapped services."""
        self._turn = 0

    def path(self, request: Request, servers: Collection[NodeName], now: float) -> PathId | None:
        """Return the path for one more copy of this request, whose mapped copies were just sent; usually None.

        `servers` are those that offer the service and have room for the request.
        """
        if not request.rule.exploration or request.service not in self._mapping.services:
            return None
        budget = self._budget(request.service, now)
        budget.earn(request.rule.exploration, now)
        if not budget.suffices(now) or not _may_explore(request):
            return None
        paths = [path for path in self._candidates(request, servers) if self._is_idle(path)]
        if not paths:
            return None
        budget.spend(now)
        self._turn += 1
        return paths[self._turn % len(paths)]

    def _candidates(self, request: Request, servers: Collection[NodeName]) -> list[PathId]:
        """Return the path of the pair that the control plane names, and mapped paths without a copy of this request."""
        found = [path for path in request.withheld if path.peer in servers]
        mapping = self._mapping.services.get(request.service)
        pair = mapping.explore if mapping is not None else None
        if pair is None or pair.server not in servers or not request.rule.idempotent:
            return found
        route = self._routes.best_over(pair.interface, pair.server)
        used = {(copy.path.interface, copy.path.peer) for copy in request.copies}
        if route is not None and route.id not in found and (pair.interface, pair.server) not in used:
            found.append(route.id)
        return found

    def _is_idle(self, path: PathId) -> bool:
        if self._routes.state(path) is not PathState.UP:
            return False
        return self._outbox.waiting_over(path.interface) <= MAX_WAITING_MESSAGES

    def _budget(self, service: ServiceName, now: float) -> ExplorationBudget:
        found = self._budgets.get(service)
        if found is None:
            mapped = self._mapping.services
            self._budgets = {name: budget for name, budget in self._budgets.items() if name in mapped}
            found = self._budgets[service] = ExplorationBudget(now)
        return found


def _may_explore(request: Request) -> bool:
    small = len(request.payload or b"") <= MAX_EXPLORING_BYTES
    return small and 0 < len(request.copies) <= MAX_COPIES_TO_EXPLORE and request.races
