"""Holds a sidecar's role, peers, routes and messages, which all links share. Sans-IO; the caller serialises the calls.

Inputs are method calls with `now`; outputs are `take_commands` (for the links) and `take_events` (for the
application). Nothing here builds, seals or parses a datagram. What only one of the roles does is in its object.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from plr.protos.base.errors import DecodeError, UnknownKindError
from plr.protos.model.ids import Role
from plr.protos.model.members import RemovalReason
from plr.sidecar.core.base.report_scope import ReportScope
from plr.sidecar.core.base.slices import SLICE, Backlog
from plr.sidecar.core.base.values import PathId, PathState
from plr.sidecar.core.cloud.cloud_role import CloudRole
from plr.sidecar.core.engine.peers import Peers
from plr.sidecar.core.engine.removals import MAX_REMOVALS, WHY_REMOVED, Removals
from plr.sidecar.core.engine.revocation_exchange import RevocationExchange
from plr.sidecar.core.robot.robot_role import RobotRole
from plr.sidecar.core.rules.service_rule import Rules, ServiceRule
from plr.sidecar.core.seam.links import (
    FinishedLost,
    FragmentsLost,
    FragmentsReceived,
    LinkCommand,
    LinkEvent,
    MessageAbandoned,
    MessageFinished,
    MessageForgotten,
    PathChanged,
    PathCommand,
    PathMeasured,
    PathMtuChanged,
    PeerClosed,
    PeerLied,
    PeerRenewed,
    PeerRestarted,
    SetPeers,
)
from plr.sidecar.core.seam.stats import EngineStats
from plr.sidecar.core.transfer.engine_parts import EngineParts
from plr.sidecar.core.transfer.inbound import Arrived, Inbound
from plr.sidecar.core.transfer.outbox import Outbox
from plr.sidecar.core.transfer.routes import Routes
from plr.sidecar.core.wire.messages import RevocationMessage, decode_message

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName, SessionId
    from plr.protos.model.mapping import MappingSet, ServiceMapping
    from plr.protos.model.members import Peer, PeerSet, RemovedPeer, ServiceOffer, ServiceUse
    from plr.protos.model.report import Report
    from plr.sidecar.core.crypto.session import OwnSession
    from plr.sidecar.core.engine.removals import Removal
    from plr.sidecar.core.engine.role import EngineRole
    from plr.sidecar.core.message.decoding import Decoding
    from plr.sidecar.core.rules.budget import Budget
    from plr.sidecar.core.seam.application import ApplicationEvent

SWEEP_EVERY_S = 1.0
"""Interval of the search for old messages and partial messages."""


@dataclass(frozen=True, slots=True)
class EngineConfig:
    """The part of the configuration that the engine needs."""

    role: Role
    rules: tuple[ServiceRule, ...]
    budgets: tuple[Budget, ...] = ()
    """Robot: budgets, of which the first that matches an interface's name decides."""


class RemovedPeerView(NamedTuple):
    """A peer that the control plane removed, for people."""

    name: NodeName
    removal: Removal
    kept: str | None
    """`path`: it is a peer still, as a path to it lives; `dormant`; None: it is forgotten."""


class RemovedCounts(NamedTuple):
    """How many peers the control plane removed."""

    path: int
    """Those that are peers still, as a path to them lives."""
    dormant: int
    forgotten: int
    """Those removed within the time asked for and not kept, as far as they are remembered."""
    at_least: bool
    """Whether more of those may have been forgotten than are counted: `MAX_REMOVALS` are remembered."""


class WrongRoleError(RuntimeError):
    """The caller took this sidecar for one of the other role."""


class Engine:
    """One sidecar without its sockets, its clock and ROS."""

    def __init__(self, config: EngineConfig, own: OwnSession, now: float) -> None:
        self._backlog = Backlog()
        self.stats = EngineStats()
        self._commands: list[LinkCommand] = []
        self._events: list[ApplicationEvent] = []
        self._interfaces: set[InterfaceName] = set()
        self._sweep_at = now + SWEEP_EVERY_S
        self._inbound = Inbound(self._commands.append, self.stats, answers=config.role is Role.CLOUD)
        self.peers = Peers(own, self.stats.dropped)
        self.removals = Removals(self.stats.dropped)
        self._links_lag = False
        """Whether links are yet to be told which peers are dormant. That waits for the next sweep: a peer that comes
        and goes all the time makes no more work than that."""
        self.routes = Routes()
        self._outbox = Outbox(self.routes, self._commands.append, self.stats)
        self.revocations = RevocationExchange(self.routes, self._outbox, self.stats)
        parts = EngineParts(
            Rules(config.rules),
            self.peers,
            self.routes,
            self._outbox,
            self.stats,
            self._events.append,
            self._commands.append,
            self._backlog,
        )
        self._role: EngineRole = RobotRole(parts, config.budgets) if config.role is Role.ROBOT else CloudRole(parts)

    @property
    def robot(self) -> RobotRole:
        """Return the robot's part; raise WrongRoleError in a cloud's sidecar."""
        if not isinstance(self._role, RobotRole):
            raise WrongRoleError("a cloud sends no requests")
        return self._role

    @property
    def cloud(self) -> CloudRole:
        """Return the cloud's part; raise WrongRoleError in a robot's sidecar."""
        if not isinstance(self._role, CloudRole):
            raise WrongRoleError("a robot runs no requests")
        return self._role

    # -- outputs --------------------------------------------------------------------------------------------------

    def take_commands(self) -> list[tuple[InterfaceName | None, LinkCommand]]:
        """Return the commands for the links; None as interface means all of them."""
        commands = self._commands[:]
        self._commands.clear()
        return [(command.path.interface if isinstance(command, PathCommand) else None, command) for command in commands]

    def take_events(self) -> list[ApplicationEvent]:
        """Return the events for the application."""
        events = self._events[:]
        self._events.clear()
        return events

    def next_decoding(self) -> Decoding | None:
        """Return the message whose next slice is to be computed, outside any lock."""
        return self._inbound.next_decoding()

    @property
    def decodings(self) -> int:
        """Return the number of messages to decode."""
        return self._inbound.decodings

    def _tell_links_of_peers(self, removed: Iterable[RemovedPeer] = ()) -> None:
        self._links_lag = False
        why = {one.name: f"removed by the control plane: {WHY_REMOVED[one.reason]}" for one in removed}
        self._commands.append(SetPeers(self.peers.for_links(), why))

    # -- the program ----------------------------------------------------------------------------------------------

    def drain(self) -> None:
        """Take no new requests from peers; those in flight go on."""
        self._role.drain()

    @property
    def busy(self) -> int:
        """Return the number of requests and messages in flight that somebody still waits for: reasons not to exit."""
        peers = frozenset(peer.name for peer in self.peers.all_held())
        return self._role.awaited(peers) + sum(self._outbox.messages_to(peer) for peer in peers)

    # -- the control plane ----------------------------------------------------------------------------------------

    def offers(self) -> tuple[ServiceOffer, ...]:
        """Return the services that this sidecar can run."""
        return self._role.offers()

    def uses(self) -> tuple[ServiceUse, ...]:
        """Return the services that this sidecar carries."""
        return self._role.uses()

    def take_services_changed(self) -> bool:
        """Return whether `offers` or `uses` may have changed since the last call."""
        return self._role.take_services_changed()

    def set_interfaces(self, interfaces: Iterable[InterfaceName], now: float) -> None:
        """Replace the interfaces that have a link now."""
        new = set(interfaces)
        gone = self._interfaces - new
        self._interfaces = new
        for interface in gone:
            paths = self.routes.forget_interface(interface)
            self._backlog.add_steps(self._outbox.on_interface_gone(interface), now)
            for path in paths:
                self._role.on_path_gone(path, now)
            dark = dict.fromkeys(path.peer for path in paths if not self.routes.reaches(path.peer))
            self._lay_down(dark, now)
        self._role.on_reach_changed(now)
        self._tell_links_of_peers()

    def apply_peers(self, peer_set: PeerSet, now: float) -> str | None:
        """Take a view of the peers; return why it is refused, or None."""
        before = {peer.name: peer.session for peer in self.peers.all()}
        held = [name for name in before if not self.peers.is_unlisted(name)]
        held += [peer.name for peer in self.peers.all_refused()]
        left = {removed.name for removed in peer_set.removed if removed.reason is not RemovalReason.LEASE_EXPIRED}
        error = self.peers.apply(peer_set, self.routes.reaches)
        if error:
            self.stats.nacks += 1
            return error
        self.stats.peers_version = self.peers.version
        kept, ended_by_policy = self.peers.all_kept(), self.peers.ended_by_policy
        self.removals.follow(peer_set, held, now, kept=kept, ended_by_policy=ended_by_policy)
        self.removals.note_dormant(filter(self.peers.is_dormant, before), now)
        self._tell_links_of_peers(peer_set.removed)
        self._role.on_peers_changed(now)
        for name, session in before.items():
            if self.peers.is_dormant(name):
                self._fall_silent(name, session, now)
        before.update(self.peers.take_forgotten())
        ended = [name for name, session in before.items() if self.peers.held_session(name) != session]
        for name in ended:
            over = name in self.peers or name in left or name in self.peers.refused
            self._forget_session(name, now, may_return=None if over else before[name])
        self._follow_gone(ended, now)
        self._role.on_view(left | self.peers.refused.keys(), now)
        return None

    def removed_peers(self, since: float, at_most: int) -> list[RemovedPeerView]:
        """Return the peers that the control plane removed after `since` (s), the last one first; kept ones always."""
        found: list[RemovedPeerView] = []
        for name, removal in self.removals.latest():
            kept = "path" if name in self.peers else "dormant" if self.peers.is_dormant(name) else None
            if kept or removal.at > since:
                found.append(RemovedPeerView(name, removal, kept))
        return found[:at_most]

    def removed_counts(self, since: float) -> RemovedCounts:
        """Return how many peers the control plane removed after `since` (s); kept ones always."""
        names = self.peers.names()
        path = sum(map(self.peers.is_unlisted, names))
        dormant = len(self.peers.all_held()) - len(names)
        gone = [
            removal.at
            for name, removal in self.removals.latest()
            if name not in self.peers and not self.peers.is_dormant(name)
        ]
        return RemovedCounts(path, dormant, sum(at > since for at in gone), at_least=len(gone) >= MAX_REMOVALS)

    def services_of_peers(self) -> set[ServiceName]:
        """Return the services that the peers offer, whatever their names."""
        peers = map(self.peers.get, self.peers.names())
        return {offer.name for peer in peers if peer is not None for offer in peer.offers}

    def recheck_peers(self, judged: Iterable[Peer], now: float) -> list[NodeName]:
        """End the sessions of peers that are bad now; return the refused ones taken, as they are `judged` good."""
        gone, taken = self.peers.recheck(), self.peers.readmit(judged)
        self._tell_links_of_peers()
        self._role.on_peers_changed(now)
        gone += self.peers.take_forgotten()
        for name in gone:
            self._forget_session(name, now)
        self._follow_gone(gone, now)
        return taken

    def apply_mapping(self, mapping: MappingSet) -> str | None:
        """Take a mapping; return why it is refused, or None."""
        error = self._role.apply_mapping(mapping, self._interfaces)
        if error:
            self.stats.nacks += 1
        return error

    @property
    def service_mappings(self) -> tuple[ServiceMapping, ...]:
        """Return the mapping in force."""
        return self._role.service_mappings

    @property
    def offer_conflicts(self) -> frozenset[tuple[ServiceName, NodeName, str]]:
        """Return the servers left out as (service, server, type): the configuration or the others differ."""
        return self._role.offer_conflicts

    def take_urgency(self) -> ReportScope | None:
        """Return what to report before the next report is due."""
        return self._role.take_urgency()

    def take_report(self, now: float, scope: ReportScope = ReportScope.ALL) -> Report:
        """Return what was measured since the last report."""
        return self._role.take_report(now, scope)

    # -- the links' events ----------------------------------------------------------------------------------------

    def on_link_event(self, event: LinkEvent, now: float) -> None:
        """Take an event of a link."""
        match event:
            case FragmentsReceived(path, session, fragments):
                # The link has acknowledged them. A dormant peer may send before we know that a path to it lives.
                if self.peers.session(path.peer) != session and self.peers.held_session(path.peer) != session:
                    self.stats.dropped["fragment_of_old_session"] += 1
                else:
                    for arrived in self._inbound.add(path, session, fragments, now):
                        self._on_message(path, arrived, now)
            case MessageAbandoned(peer, session, number):
                if self.peers.held_session(peer) == session:
                    self._inbound.abandon(peer, number)
            case MessageForgotten(peer, number):
                self._outbox.on_forgotten(peer, number)
            case MessageFinished(peer, number):
                self._outbox.on_finished(peer, number)
            case FinishedLost(path, numbers) if self.peers.held_session(path.peer) is not None:
                self._inbound.on_finished_lost(path.peer, numbers, self.routes.best_to(path.peer))
            case FragmentsLost():
                if event.timed_out and (message := self._outbox.under_way(event.message)) is not None:
                    self._role.on_copy_lost(message, now)
                self._outbox.on_lost(event, now)
            case PathMeasured() if self._knows(event.path):
                self.routes.set_rtt(event.path, event.smoothed_rtt_s)
                self.routes.note_fates(event.path, event.arrived, event.missed, policed=event.policed)
                self._role.on_path_measured(event)
            case PathChanged():
                self._on_path_changed(event, now)
            case PathMtuChanged(path, max_datagram) if self._knows(path):
                self.routes.set_max_datagram(path, max_datagram)
            case FinishedLost() | PathMeasured() | PathMtuChanged():
                pass  # of a peer that has just left, or an interface that has just gone
            case PeerRestarted():
                if self.peers.restarted(event, now):
                    self._forget_session(event.peer, now)
                    self._follow_gone((event.peer,), now)
                    self._tell_links_of_peers()
            case PeerRenewed():
                if self.peers.renewed(event, now):
                    self._tell_links_of_peers()
            case PeerClosed(peer, session):
                if self.peers.session(peer) == session:
                    self._on_peer_closed(peer, session, now)
            case PeerLied(peer, session):
                if self.peers.held_session(peer) == session:
                    self.peers.condemn(session)
                    self.recheck_peers((), now)
        self._after_news(now)

    def on_decoded(self, decoding: Decoding, now: float) -> None:
        """Take a message whose decoding is complete (`decoding.run_slice` says when)."""
        arrived = self._inbound.take_decoded(decoding)
        if arrived is not None:
            self._on_message(decoding.path, arrived, now)
            self._after_news(now)

    def on_decoding_failed(self, decoding: Decoding) -> None:
        """Give up a message that cannot be decoded."""
        self._inbound.forgo_decoding(decoding)

    def _after_news(self, now: float) -> None:
        """Send what waits for room if less is under way than before."""
        if self._outbox.take_made_room():
            self._role.on_room(now)
            self.revocations.on_room(now)

    def _on_message(self, path: PathId, arrived: Arrived, now: float) -> None:
        try:
            message = decode_message(arrived.content)
        except UnknownKindError:
            self.stats.dropped["unknown_message"] += 1
            return
        except DecodeError:
            self.stats.dropped["malformed_message"] += 1
            return
        if isinstance(message, RevocationMessage):
            self.revocations.on_message(path.peer, message, now)
        else:
            self._role.on_message(path, message, arrived.ends_at, now, beside=arrived.beside)

    def _on_path_changed(self, event: PathChanged, now: float) -> None:
        path, state = event.path, event.state
        if state is PathState.UP and path.interface in self._interfaces and self.peers.wake(path.peer):
            self._role.on_peer_back(path.peer, now)
            self._links_lag = True
        if not self._knows(path) or self.routes.state(path) is state:
            return
        reached = self.routes.reaches(path.peer)
        self.routes.set_state(path, state)
        if state is PathState.UP:
            self._backlog.add_steps(self._outbox.on_path_up(path), now)
            self._inbound.on_path_up(path)
        elif state is PathState.DOWN and not self.routes.reaches(path.peer):
            self._lay_down((path.peer,), now)
        if self.routes.reaches(path.peer) is not reached:
            self._role.on_reach_changed(now)
            if not reached:
                self.revocations.on_reached(path.peer, now)
        self._role.on_path_changed(path, state, now)

    def _knows(self, path: PathId) -> bool:
        return path.peer in self.peers and path.interface in self._interfaces

    def _lay_down(self, dark: Iterable[NodeName], now: float) -> None:
        """Make those of these peers, whose last path died, dormant that were kept for their paths only."""
        silent: dict[NodeName, SessionId] = {}
        for name in dark:
            session = self.peers.session(name)
            if session is not None and self.peers.lay_down(name):
                silent[name] = session
        if not silent:
            return
        self.removals.note_dormant(silent, now)
        self._role.on_peers_changed(now)
        for name, session in silent.items():
            self._fall_silent(name, session, now)
        self._role.on_reach_changed(now)
        forgotten = self.peers.take_forgotten()
        for name, session in forgotten.items():
            self._forget_session(name, now, may_return=session)
        self._follow_gone(forgotten, now)
        self._links_lag = True

    def _on_peer_closed(self, name: NodeName, session: SessionId, now: float) -> None:
        """Send nothing new to a peer that said goodbye; the control plane will remove it as well."""
        for route in self.routes.all_to(name):
            self.routes.set_state(route.id, PathState.DOWN)
        self._role.on_closed(name, session, now)
        self._follow_gone((name,), now)
        self._lay_down((name,), now)

    def _fall_silent(self, name: NodeName, session: SessionId, now: float) -> None:
        """Follow that a peer is dormant. What is under way waits for its return, as if the view still listed it."""
        self._role.on_session_over(name, now, session)
        self.revocations.forget_peer(name)
        self.routes.forget_peer(name)

    def _forget_session(self, name: NodeName, now: float, *, may_return: SessionId | None = None) -> None:
        """End a peer's session; with `may_return` nobody said that it is over, and a view may list it again."""
        self._role.on_session_over(name, now, may_return)
        self._inbound.forget_peer(name)
        self.revocations.forget_peer(name)
        self.routes.forget_peer(name)

    def _follow_gone(self, names: Collection[NodeName], now: float) -> None:
        if names:
            self._role.on_reach_changed(now)
        for name in names:
            self._role.on_peer_gone(name, now)

    # -- time -----------------------------------------------------------------------------------------------------

    def next_timer(self) -> float:
        """Return when to call `handle_timer` next."""
        timers = (self._backlog.next_timer(), self._role.next_timer())
        return min((self._sweep_at, self.revocations.next_timer(), *(timer for timer in timers if timer is not None)))

    def on_woken(self, slept_s: float, now: float) -> None:
        """Note that the host was suspended for so long (s) since the last call; `now` does not count it."""
        self._role.on_woken(slept_s, now)
        self._after_news(now)

    def handle_timer(self, now: float) -> None:
        """Do what is due now, as much of it as one turn has room for."""
        self._backlog.begin_turn(now)
        self._backlog.run(now, leave=SLICE // 2)  # deadlines must not wait until all is done
        self._role.handle_timer(now)
        self.revocations.handle_timer(now)
        self._backlog.run(now)
        if now >= self._sweep_at:
            self._sweep_at = now + SWEEP_EVERY_S
            self._backlog.add_steps(self._outbox.expired(now), now)
            self._outbox.ask_again()
            self._inbound.expire(now)
            if self._links_lag:
                self._tell_links_of_peers()
        self._after_news(now)
