"""Remembers which refused offers are known: each is counted and reported once while its cloud is registered."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName, ServiceName

MAX_REPORTED_OFFERS = 1024
"""Services of one cloud that are reported: as many as it may offer at once. Further ones are only counted."""


class RefusedOffers:
    """Bounded by the registry: an entry for each registered cloud that offers what it may not."""

    def __init__(self) -> None:
        self._told: dict[NodeName, set[ServiceName]] = {}

    def update(self, cloud: NodeName, refused: tuple[ServiceName, ...]) -> tuple[int, tuple[ServiceName, ...]]:
        """Take all that a cloud offers and may not; return how many are new, and those to report."""
        told = self._told.get(cloud, set())
        new = [service for service in refused if service not in told]
        untold = tuple(new[: MAX_REPORTED_OFFERS - len(told)])
        if untold:
            self._told[cloud] = told | set(untold)
        return len(new), untold

    def forget(self, cloud: NodeName) -> None:
        """Note that the cloud is no longer registered."""
        self._told.pop(cloud, None)

    def clear(self) -> None:
        """Forget everything, as the policy changed: all is reported again."""
        self._told.clear()
