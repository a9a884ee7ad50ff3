"""Robot side: limits what extra copies of requests may cost on each interface.

Each limit is a token bucket as in gRFC A6 (gRPC's retry throttling), in bytes. Requests answered in time fill it, extra
copies empty it, and without tokens none is sent. When nothing is answered, nothing is earned, so copies never make an
overload worse. Each copy counts with the bytes of its message; headers, repair symbols, retransmissions and answers do
not count.
"""

from __future__ import annotations

import fnmatch
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from plr.protos.model.ids import InterfaceName, ServiceName
    from plr.sidecar.core.rules.budget import Budget
    from plr.sidecar.core.seam.stats import EngineStats

MAX_SAVED_BYTES = 32 * 1024 * 1024
"""Capacity of a bucket: twice the largest request."""
DAY_S = 86_400.0


@dataclass(slots=True)
class _Purse:
    budget: Budget | None
    saved: float = 0.0
    day_began_at: float = -math.inf
    spent_today: int = 0

    def refusal(self, size: int, now: float) -> str | None:
        """Return the limit that forbids spending `size` bytes; None if none does."""
        budget = self.budget
        if budget is None:
            return None
        if budget.extra_load is not None and self.saved < size:
            return "load"
        if budget.extra_bytes_a_day is not None:
            if now >= self.day_began_at + DAY_S:
                self.day_began_at, self.spent_today = now, 0
            if self.spent_today + size > budget.extra_bytes_a_day:
                return "day"
        return None


class Budgets:
    """One purse for each interface."""

    def __init__(self, budgets: Iterable[Budget], stats: EngineStats) -> None:
        self._budgets = tuple(budgets)
        self._stats = stats
        self._purses: dict[InterfaceName, _Purse] = {}
        self.limit = any(one.limits for one in self._budgets)
        """Whether any of them limits anything."""

    def earn(self, size: int, interfaces: Iterable[InterfaceName]) -> None:
        """Credit every purse with a request of `size` bytes answered in time; its mapping names `interfaces`."""
        for interface in interfaces:
            self._purse(interface)
        for purse in self._purses.values():
            if purse.budget is not None and purse.budget.extra_load is not None:
                purse.saved = min(purse.saved + purse.budget.extra_load * size, MAX_SAVED_BYTES)

    def allows(self, interface: InterfaceName, service: ServiceName, size: int, now: float) -> bool:
        """Return whether an extra copy of `size` bytes may be sent now; if not, count it as refused."""
        refusal = self._purse(interface).refusal(size, now)
        if refusal is not None:
            self._stats.copies_refused[interface, service, refusal] += 1
        return refusal is None

    def spend(self, interface: InterfaceName, size: int) -> None:
        """Charge an extra copy of `size` bytes that was allowed and sent."""
        purse = self._purse(interface)
        purse.saved -= size
        purse.spent_today += size

    def _purse(self, interface: InterfaceName) -> _Purse:
        purse = self._purses.get(interface)
        if purse is None:
            budget = next((one for one in self._budgets if fnmatch.fnmatchcase(interface, one.pattern)), None)
            purse = self._purses[interface] = _Purse(budget)
        return purse
