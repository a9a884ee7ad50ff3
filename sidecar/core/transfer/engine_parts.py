"""Bundles what the engine shares with the role that it plays, robot or cloud."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.model.ids import NodeName, ServiceName, SessionId
    from plr.protos.model.members import Peer
    from plr.sidecar.core.base.slices import Backlog
    from plr.sidecar.core.rules.service_rule import Rules
    from plr.sidecar.core.seam.application import ApplicationEvent
    from plr.sidecar.core.seam.links import LinkCommand
    from plr.sidecar.core.seam.stats import EngineStats
    from plr.sidecar.core.transfer.outbox import Outbox
    from plr.sidecar.core.transfer.routes import Routes


class KnownPeers(Protocol):
    """The peers that this sidecar may talk to, as a role reads them."""

    def __contains__(self, name: object) -> bool:
        """Return whether there is a peer of this name."""

    def names(self) -> list[NodeName]:
        """Return the names of all peers."""

    def get(self, name: NodeName) -> Peer | None:
        """Return a peer by name."""

    def session(self, name: NodeName) -> SessionId | None:
        """Return a peer's session."""

    def is_dormant(self, name: NodeName) -> bool:
        """Return whether the peer is none at present, and is one again when it talks."""

    def may_call(self, name: NodeName, service: ServiceName) -> bool:
        """Cloud: return whether the access policy lets a robot call a service here."""


@dataclass(frozen=True, slots=True)
class EngineParts:
    """What both the engine and its role work with."""

    rules: Rules
    peers: KnownPeers
    routes: Routes
    outbox: Outbox
    stats: EngineStats
    emit: Callable[[ApplicationEvent], None]
    command: Callable[[LinkCommand], None]
    """Takes a command for the link of the path that it names, or for all links if it names none."""
    backlog: Backlog
