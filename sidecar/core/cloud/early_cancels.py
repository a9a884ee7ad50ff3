"""Cloud side: remembers requests called off before any copy of them came. Such a copy is not run when it comes."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

from plr.sidecar.core.base.fair_share import FORGOTTEN_AT_ONCE, Shares

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName
    from plr.sidecar.core.base.values import RequestId
    from plr.sidecar.core.seam.stats import EngineStats

MAX_EARLY_CANCELS = 16_384
"""Ids kept; one robot may fill half: 130 requests a second, all overtaken by their cancels, for REMEMBER_CANCEL_S. A
request whose id is not kept may run once, as if it had not been called off."""
REMEMBER_CANCEL_S = 60.0
"""Longest time that a datagram may spend in the queues of the network."""


class EarlyCancels:
    """Ids of requests that were called off before they came, with the robot that called them off."""

    __slots__ = ("_ids", "_shares", "_stats")

    def __init__(self, stats: EngineStats) -> None:
        self._stats = stats
        self._shares = Shares(MAX_EARLY_CANCELS)
        # Ordered by when they are forgotten: all are kept equally long.
        self._ids: OrderedDict[tuple[NodeName, RequestId], float] = OrderedDict()
        """(robot, request) -> when it is forgotten."""

    def __len__(self) -> int:
        return len(self._ids)

    def add(self, robot: NodeName, request_id: RequestId, now: float) -> None:
        """Remember that `robot` does not want this request any more."""
        self._forget_old(now)
        if (robot, request_id) in self._ids:
            return
        if not self._shares.fits(robot):
            self._stats.dropped["early_cancels_full"] += 1
            return
        self._shares.take(robot)
        self._ids[robot, request_id] = now + REMEMBER_CANCEL_S

    def holds(self, robot: NodeName, request_id: RequestId, now: float) -> bool:
        """Return whether this robot called the request off."""
        self._forget_old(now)
        return self._ids.get((robot, request_id), now) > now

    def _forget_old(self, now: float) -> None:
        for _ in range(min(FORGOTTEN_AT_ONCE, len(self._ids))):
            key, forget_at = next(iter(self._ids.items()))
            if forget_at > now:
                return
            del self._ids[key]
            self._shares.give_back(key[0])
