"""Cloud side: remembers copies that were refused and whose requests have not run.

The robot that sent such a copy may take the request to another server, as it certainly did not run. If the same copy
comes once more, as another message, when the server would take it, it is refused again. Another copy of the request may
run: the robot sends one only if it knows what became of all the others.
"""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING, NamedTuple

from plr.sidecar.core.base.fair_share import FORGOTTEN_AT_ONCE, Shares

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName
    from plr.sidecar.core.base.values import RejectReason, RequestId
    from plr.sidecar.core.seam.stats import EngineStats

MAX_REFUSED_COPIES = 65_536
"""Copies remembered; one robot may fill half: 500 refused copies a second for a minute. A copy that is not remembered
may run if it comes once more, besides running on another server."""


class RefusedCopy(NamedTuple):
    """A copy by its robot, its request and its number."""

    robot: NodeName
    request_id: RequestId
    copy: int


class RefusedCopies:
    """Refused copies, with the reasons."""

    __slots__ = ("_forget_at", "_reasons", "_shares", "_stats")

    def __init__(self, stats: EngineStats) -> None:
        self._stats = stats
        self._shares = Shares(MAX_REFUSED_COPIES)
        self._reasons: dict[RefusedCopy, tuple[RejectReason, str]] = {}
        self._forget_at: list[tuple[float, RefusedCopy]] = []
        """Heap of when each copy is forgotten."""

    def __len__(self) -> int:
        return len(self._reasons)

    def add(self, copy: RefusedCopy, reason: RejectReason, text: str, forget_at: float, now: float) -> None:
        """Remember a refused copy, which cannot come any more from `forget_at` on."""
        self._forget_old(now)
        if copy in self._reasons:
            return
        if not self._shares.fits(copy.robot):
            self._stats.dropped["refused_copies_full"] += 1
            return
        self._shares.take(copy.robot)
        self._reasons[copy] = reason, text
        heapq.heappush(self._forget_at, (forget_at, copy))

    def why(self, copy: RefusedCopy, now: float) -> tuple[RejectReason, str] | None:
        """Return why this copy was refused; None when it was not."""
        self._forget_old(now)
        return self._reasons.get(copy)

    def _forget_old(self, now: float) -> None:
        """Drop one burst of old copies, the rest in later calls: a copy that stays is refused, but it cannot come."""
        for _ in range(FORGOTTEN_AT_ONCE):
            if not self._forget_at or self._forget_at[0][0] > now:
                return
            copy = heapq.heappop(self._forget_at)[1]
            del self._reasons[copy]
            self._shares.give_back(copy.robot)
