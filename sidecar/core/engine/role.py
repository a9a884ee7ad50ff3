"""Defines what the engine asks of the role that it plays: a robot's requests, or a cloud's executions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Collection

    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName, SessionId
    from plr.protos.model.mapping import MappingSet, ServiceMapping
    from plr.protos.model.members import ServiceOffer, ServiceUse
    from plr.protos.model.report import Report
    from plr.sidecar.core.base.report_scope import ReportScope
    from plr.sidecar.core.base.values import PathId, PathState
    from plr.sidecar.core.message.outbound import OutboundMessage
    from plr.sidecar.core.seam.links import PathMeasured
    from plr.sidecar.core.wire.messages import ServiceMessage


class EngineRole(Protocol):
    """One of the two roles. It sends through the engine's outbox and emits events for the application."""

    # -- the program ----------------------------------------------------------------------------------------------

    def drain(self) -> None:
        """Take no new requests from peers; those in flight go on."""

    def awaited(self, peers: Collection[NodeName]) -> int:
        """Return the number of requests here whose end the application or one of these peers waits for."""

    # -- the control plane ----------------------------------------------------------------------------------------

    def offers(self) -> tuple[ServiceOffer, ...]:
        """Return the services that can be run here."""

    def uses(self) -> tuple[ServiceUse, ...]:
        """Return the services that the robot carries."""

    def take_services_changed(self) -> bool:
        """Return whether `offers` or `uses` may have changed since the last call."""

    @property
    def offer_conflicts(self) -> frozenset[tuple[ServiceName, NodeName, str]]:
        """Return the servers left out as (service, server, type): the configuration or the others differ."""

    def apply_mapping(self, mapping: MappingSet, interfaces: Collection[InterfaceName]) -> str | None:
        """Take a mapping; return why it is refused, or None."""

    @property
    def service_mappings(self) -> tuple[ServiceMapping, ...]:
        """Return the mapping in force."""

    def take_urgency(self) -> ReportScope | None:
        """Return what to report before the next report is due."""

    def take_report(self, now: float, scope: ReportScope) -> Report:
        """Return what was measured since the last report."""

    # -- the peers ------------------------------------------------------------------------------------------------

    def on_message(
        self, path: PathId, message: ServiceMessage, ends_at: float, now: float, *, beside: tuple[PathId, ...] = ()
    ) -> None:
        """Take a peer's message, which is of use until `ends_at` (s); some of it came by the paths `beside`."""

    def on_room(self, now: float) -> None:
        """Send what waits for room, since less is under way than before."""

    def on_peers_changed(self, now: float) -> None:
        """Follow the peers, which or whose services may have changed."""

    def on_reach_changed(self, now: float) -> None:
        """Follow which peers are within reach."""

    def on_view(self, gone: Collection[NodeName], now: float) -> None:
        """Follow a new view of the peers, after all else about it is done; those in `gone` do not come back."""

    def on_closed(self, peer: NodeName, session: SessionId, now: float) -> None:
        """Send nothing more to a peer that said goodbye."""

    def on_session_over(self, peer: NodeName, now: float, may_return: SessionId | None) -> None:
        """End a peer's session; with `may_return` nobody said that it is over, and the peer may come back with it.

        It does so by itself if it is dormant; otherwise if a view lists it again. If a dormant peer is forgotten later,
        this is called again.
        """

    def on_peer_back(self, peer: NodeName, now: float) -> None:
        """Follow that a peer which fell silent is one again, since a path to it lives."""

    def on_peer_gone(self, peer: NodeName, now: float) -> None:
        """Expect nothing more from a peer whose session ended."""

    # -- the paths ------------------------------------------------------------------------------------------------

    def on_path_changed(self, path: PathId, state: PathState, now: float) -> None:
        """Follow a path's liveness."""

    def on_path_gone(self, path: PathId, now: float) -> None:
        """Follow the end of a path whose interface is gone."""

    def on_path_measured(self, event: PathMeasured) -> None:
        """Note a link's measurement of a path."""

    def on_copy_lost(self, message: OutboundMessage, now: float) -> None:
        """Act on a message of which nothing is heard."""

    # -- time -----------------------------------------------------------------------------------------------------

    def next_timer(self) -> float | None:
        """Return when to call `handle_timer`."""

    def on_woken(self, slept_s: float, now: float) -> None:
        """Follow that the host was suspended for so long (s), in which the clock stood still."""

    def handle_timer(self, now: float) -> None:
        """Do what is due now, as much of it as one turn has room for."""
