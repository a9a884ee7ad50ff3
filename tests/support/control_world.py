"""A control plane core with simulated sidecars around it, in simulated time: no sockets, no threads, no clock."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from plr.controlplane.core.control.control import ControlCore
from plr.controlplane.core.control.events import DepartureNotice, NackNotice, Settings
from plr.controlplane.core.publish.messages import CloseReason, EndStream, SendMessage
from plr.controlplane.core.registry.registry import Refusal, StreamId
from plr.controlplane.solver.matcher import solve
from plr.protos.model.ids import NodeName, Role, Version
from plr.protos.model.mapping import MappingSet, ServiceMapping
from plr.protos.model.members import CandidateSet, Peer, PeerSet, Registration, RemovalReason, ServiceSet
from plr.protos.model.report import PathReport, Report
from plr.protos.model.stream import Ack, ControlMessage, Drain, Heartbeat, Nack, ResourceKind, SidecarMessage, Welcome
from tests.support.samples import interfaces, offer, path, registration, use

if TYPE_CHECKING:
    from collections.abc import Callable

SOLVER_LIMIT_S = 60.0

SETTLED_S = 2.0
"""Long enough for everything debounced to happen."""

NOTHING = Version(0)


@dataclass
class SimSidecar:
    """What a sidecar knows and holds; survives its streams, and its restarts where a disk would."""

    registration: Registration
    stream: StreamId | None = None
    peers: tuple[Peer, ...] = ()
    peers_version: Version = NOTHING
    services: tuple[ServiceMapping, ...] = ()
    mapping_version: Version = NOTHING
    received: list[ControlMessage] = field(default_factory=list)
    removed: dict[NodeName, RemovalReason] = field(default_factory=dict)
    refuse: Callable[[ControlMessage], bool] = lambda message: False
    silent: bool = False
    """Receives, and answers nothing."""
    closed: list[CloseReason] = field(default_factory=list)

    @property
    def name(self) -> NodeName:
        return self.registration.name

    @property
    def peer_names(self) -> set[str]:
        return {peer.name for peer in self.peers}

    @property
    def welcomes(self) -> list[Welcome]:
        return [message for message in self.received if isinstance(message, Welcome)]

    @property
    def peer_sets(self) -> list[PeerSet]:
        return [message for message in self.received if isinstance(message, PeerSet)]

    @property
    def mapping_sets(self) -> list[MappingSet]:
        return [message for message in self.received if isinstance(message, MappingSet)]

    def pairs(self, service: str = "/plan") -> dict[str, str]:
        """Interface to server, as mapped."""
        for mapping in self.services:
            if mapping.service == service:
                return {assignment.interface: assignment.server for assignment in mapping.assignments}
        return {}

    def reason(self, service: str = "/plan") -> str:
        return next(mapping.reason for mapping in self.services if mapping.service == service)


class World:
    """The core, its sidecars, and the time."""

    def __init__(self, settings: Settings | None = None, *, epoch: int = 1000, now: float = 100.0) -> None:
        self.settings = settings or Settings(warm_up_s=0.0)
        self.now = now
        self.core = ControlCore(self.settings, version_epoch=epoch, now=now)
        self.sidecars: dict[NodeName, SimSidecar] = {}
        self.nacks: list[NackNotice] = []
        self.departed: list[NodeName] = []
        self.closings: list[tuple[StreamId, CloseReason]] = []
        self.on_receive: Callable[[SimSidecar, PeerSet | MappingSet], None] = lambda sidecar, message: None
        self.solvings = 0

    # ── sidecars ──

    def robot(self, name: str = "robot", *nics: str, **changes: object) -> SimSidecar:
        """A robot that uses /plan over wlan0 and wwan0."""
        sidecar = self.join(registration(name, Role.ROBOT))
        self.say(sidecar, CandidateSet(interfaces(*(nics or ("wlan0", "wwan0")))))
        self.say(sidecar, ServiceSet((), (use(**changes),)))  # type: ignore[arg-type]  # passed through
        return sidecar

    def cloud(self, name: str, *, capacity: int = 0) -> SimSidecar:
        """A cloud that offers /plan."""
        sidecar = self.join(registration(name, Role.CLOUD))
        self.say(sidecar, CandidateSet(interfaces("eth0")))
        self.say(sidecar, ServiceSet((offer(capacity=capacity),)))
        return sidecar

    def join(self, said: Registration) -> SimSidecar:
        """Register; a known name keeps what it held."""
        sidecar = self.sidecars.setdefault(said.name, SimSidecar(said))
        sidecar.registration = said
        result = self.core.register(said, self.now)
        assert not isinstance(result, Refusal), result
        sidecar.stream = result
        self.dispatch()
        return sidecar

    def say(self, sidecar: SimSidecar, message: SidecarMessage) -> None:
        """One message on the sidecar's stream."""
        assert sidecar.stream is not None
        self.core.receive(sidecar.stream, message, self.now)
        self.dispatch()

    def report(self, robot: SimSidecar, *paths: PathReport) -> None:
        self.say(robot, Report(paths=paths))

    def all_up(self, robot: SimSidecar, servers: tuple[str, ...], *nics: str) -> None:
        """Every path of the robot to these servers is up."""
        self.report(robot, *(path(nic, server) for nic in nics or ("wlan0", "wwan0") for server in servers))

    def drop_stream(self, sidecar: SimSidecar) -> None:
        """The connection is lost."""
        if sidecar.stream is not None:
            stream, sidecar.stream = sidecar.stream, None
            self.core.disconnected(stream, self.now)
            self.dispatch()

    def leave(self, sidecar: SimSidecar) -> None:
        """Say goodbye."""
        self.say(sidecar, Drain())
        self.drop_stream(sidecar)

    # ── time ──

    def run(self, seconds: float, *, heartbeats: bool = True) -> None:
        """Let time pass, timer by timer; connected sidecars stay alive with `heartbeats`."""
        end = self.now + seconds
        beat = self.now
        while True:
            timer = self.core.next_timer()
            self.now = min(end, beat if heartbeats else end, timer if timer is not None else end)
            if heartbeats and self.now >= beat:
                beat = self.now + self.settings.lease_s / 3
                for sidecar in list(self.sidecars.values()):
                    if sidecar.stream is not None and not sidecar.silent:
                        self.say(sidecar, Heartbeat())
            self.step()
            if self.now >= end:
                return

    def step(self) -> None:
        """What the driver does when it wakes up."""
        self.core.handle_timer(self.now)
        self.dispatch()
        picture = self.core.start_solving(self.now)
        if picture is not None:
            self.solvings += 1
            plan = solve(picture.problem, time_limit_s=SOLVER_LIMIT_S, hint=self.core.plan)
            self.core.solved(self.core.settle(picture, plan, self.now), self.now)
            self.dispatch()

    def dispatch(self) -> None:
        """Carry out what the core asks for."""
        while (event := self.core.next_event()) is not None:
            match event:
                case SendMessage(stream=stream, message=message):
                    sidecar = self._owner(stream)
                    if sidecar is not None:
                        self._deliver(sidecar, message)
                case EndStream(stream=stream, reason=reason):
                    self.closings.append((stream, reason))
                    sidecar = self._owner(stream)
                    if sidecar is not None:
                        sidecar.closed.append(reason)
                        sidecar.stream = None
                        self.core.disconnected(stream, self.now)
                case NackNotice():
                    self.nacks.append(event)
                case DepartureNotice(sidecar=name):
                    self.departed.append(name)

    def _owner(self, stream: StreamId) -> SimSidecar | None:
        return next((sidecar for sidecar in self.sidecars.values() if sidecar.stream == stream), None)

    def _deliver(self, sidecar: SimSidecar, message: ControlMessage) -> None:
        sidecar.received.append(message)
        if isinstance(message, Welcome):
            return
        self.on_receive(sidecar, message)
        resource = ResourceKind.PEERS if isinstance(message, PeerSet) else ResourceKind.MAPPING
        in_force = sidecar.peers_version if isinstance(message, PeerSet) else sidecar.mapping_version
        refused = sidecar.refuse(message)
        if not refused:
            in_force = message.version
            if isinstance(message, PeerSet):
                sidecar.peers, sidecar.peers_version = tuple(message.peers), message.version
                sidecar.removed = {removed.name: removed.reason for removed in message.removed}
            else:
                sidecar.services, sidecar.mapping_version = message.services, message.version
        if sidecar.silent:
            return
        if refused:
            self.say(sidecar, Nack(resource, in_force, message.nonce, "not with me"))
        else:
            self.say(sidecar, Ack(resource, message.version, message.nonce))
