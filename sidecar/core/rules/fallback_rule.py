"""What stands in for the network on the robot itself: which local service, and when it is asked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from protos.model.ids import ServiceName


@dataclass(frozen=True, slots=True)
class FallbackRule:
    """The fallback of one service."""

    service: ServiceName
    """A service of the same type that a node on this robot serves; never carried itself."""
    in_time: bool = True
    """Ask it so early that it answers by the deadline; else when the network has missed."""
    takes_s: float | None = None
    """How long it takes, at most; None: as measured."""
