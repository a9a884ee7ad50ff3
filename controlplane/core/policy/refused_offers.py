"""Which refused offers are known already: each is counted and told once while its cloud is registered."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from protos.model.ids import NodeName, ServiceName

MAX_TOLD = 1024
"""Services of one cloud that are told of: as many as it may offer at once. Further ones are counted only."""


class RefusedOffers:
    """Bounded by the registry: an entry for each registered cloud that offers what it may not."""

    def __init__(self) -> None:
        self._told: dict[NodeName, set[ServiceName]] = {}

    def update(self, cloud: NodeName, refused: tuple[ServiceName, ...]) -> tuple[int, tuple[ServiceName, ...]]:
        """What a cloud offers and may not, all of it; returns how many are new, and those to tell of."""
        told = self._told.get(cloud, set())
        new = [service for service in refused if service not in told]
        untold = tuple(new[: MAX_TOLD - len(told)])
        if untold:
            self._told[cloud] = told | set(untold)
        return len(new), untold

    def forget(self, cloud: NodeName) -> None:
        """The cloud is not registered any more."""
        self._told.pop(cloud, None)

    def clear(self) -> None:
        """The policy changed: all is told anew."""
        self._told.clear()
