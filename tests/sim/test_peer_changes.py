"""Sidecars that are told changes of their peers hold what the control plane believes, whatever happens on the way.

The real cores of both ends, with the bytes between them: messages are superseded while a stream is slow, come in
several parts, are refused, and streams break at any moment.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.core.control.control import ControlCore
from plr.controlplane.core.control.events import Settings
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy
from plr.controlplane.core.publish.messages import EndStream, SendMessage
from plr.controlplane.core.publish.publisher import RESEND_S
from plr.controlplane.core.registry.registry import Refusal, StreamId
from plr.controlplane.serve import stream_encoder
from plr.controlplane.serve.stream_encoder import StreamEncoder
from plr.protos.convert import parse_control_message
from plr.protos.model.ids import NodeName, Role, ServiceName
from plr.protos.model.members import CandidateSet, PeerSet, Registration, ServiceSet
from plr.protos.model.peer_changes import put_together
from plr.protos.model.status import SyncState
from plr.protos.model.stream import Drain, ResourceKind, Welcome
from plr.sidecar.core.control.session import Apply, ControlSession, ControlState
from tests.support.samples import candidate, offer, registration, use

if TYPE_CHECKING:
    from plr.controlplane.core.control.events import Event
    from plr.protos.model.stream import ControlMessage

STEPS = 300
PLAN = ServiceName("/plan")
POLICIES = (
    None,
    Policy((CallRule(("robot-*",), (PLAN,), ("cloud-1", "cloud-2")),), (OfferRule(("*",), (PLAN,)),)),
    Policy((CallRule(("robot-3",), (PLAN,), ("*",)),), (OfferRule(("*",), (PLAN,)),)),
)


@dataclass
class Member:
    """A sidecar, and what is on its way to it."""

    said: Registration
    session: ControlSession
    stream: StreamId | None = None
    unsent: dict[type[ControlMessage], ControlMessage] = field(default_factory=dict)
    held: PeerSet | None = None
    refuses: bool = False
    wholes: int = 0
    changes: int = 0


class Fleet:
    """One control plane and its members."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.now = 100.0
        self.core = ControlCore(Settings(warm_up_s=0.0, lease_s=1000.0), version_epoch=1000, now=self.now)
        self.encoder = StreamEncoder()
        self.members: dict[NodeName, Member] = {}
        self.on_message = lambda member, message: None

    # ── what may happen ──

    def connect(self, name: str, role: Role) -> None:
        member = self.members.get(NodeName(name))
        if member is None:
            said = registration(name, role)
            member = self.members[NodeName(name)] = Member(said, ControlSession(said, self.rng))
            member.session.set_candidates(CandidateSet((candidate("eth0"),)))
            services = ServiceSet((offer(),)) if role is Role.CLOUD else ServiceSet((), (use(),))
            member.session.set_services(services)
        if member.stream is None:
            member.session.opened(self.now)
            (first,) = member.session.messages_to_send(self.now)
            assert isinstance(first, Registration)
            assert first.incremental
            result = self.core.register(first, self.now)
            assert not isinstance(result, Refusal), result
            member.stream = result
            self.dispatch()

    def lose_stream(self, member: Member) -> None:
        if member.stream is not None:
            stream, member.stream = member.stream, None
            member.unsent.clear()
            member.session.closed(self.now)
            self.core.disconnected(stream, self.now)

    def restart(self, member: Member) -> None:
        """As from its disk."""
        self.lose_stream(member)
        held = member.held
        member.said = replace(member.said, incarnation=member.said.incarnation + 1)
        said = replace(member.said, peers_version=held.version) if held is not None else member.said
        old, member.session = member.session, ControlSession(said, self.rng, held)
        member.session.set_candidates(old._candidates)
        member.session.set_services(old._services)

    def move(self, member: Member) -> None:
        member.session.set_candidates(CandidateSet((candidate("eth0", port=self.rng.randrange(1, 60_000)),)))

    def leave(self, member: Member) -> None:
        if member.stream is not None:
            self.core.receive(member.stream, Drain(), self.now)
            self.lose_stream(member)
            del self.members[member.said.name]

    # ── both ends ──

    def deliver(self, member: Member) -> None:
        """One message of those that wait, as the stream carries it."""
        for kind in (Welcome, PeerSet):
            message = member.unsent.pop(kind, None)
            if message is None:
                continue
            for data in self.encoder.encode(message, incremental=True):
                parsed = parse_control_message(data)
                if isinstance(parsed, PeerSet):
                    member.changes += bool(parsed.base)
                    member.wholes += not parsed.base
                event = member.session.receive(parsed, self.now)
                if isinstance(event, Apply):
                    assert isinstance(event.content, PeerSet)
                    if not member.refuses:
                        member.held = event.content
                    member.session.applied(event, "not now" if member.refuses else None)
            return

    def answer(self, member: Member) -> None:
        if member.stream is not None:
            for message in member.session.messages_to_send(self.now):
                self.core.receive(member.stream, message, self.now)

    def dispatch(self) -> None:
        while (event := self.core.next_event()) is not None:
            self._carry_out(event)

    def _carry_out(self, event: Event) -> None:
        if isinstance(event, EndStream):
            for member in self.members.values():
                if member.stream == event.stream:
                    self.lose_stream(member)
        if not isinstance(event, SendMessage):
            return
        for member in self.members.values():
            if member.stream == event.stream and isinstance(event.message, Welcome | PeerSet):
                message = event.message
                unsent = member.unsent.get(type(message))
                if isinstance(message, PeerSet) and isinstance(unsent, PeerSet):
                    message = put_together(unsent, message)
                member.unsent[type(message)] = message

    def pass_time(self, seconds: float) -> None:
        self.now += seconds
        self.core.handle_timer(self.now)
        self.core.start_solving(self.now)
        self.dispatch()

    def settle(self) -> None:
        for member in self.members.values():
            member.refuses = False
            self.connect(member.said.name, member.said.role)
        for _ in range(60):
            self.pass_time(RESEND_S / 10)
            for member in self.members.values():
                for _ in range(3):
                    self.deliver(member)
                self.answer(member)
            self.dispatch()


def step(fleet: Fleet) -> None:
    rng = fleet.rng
    member = rng.choice(list(fleet.members.values())) if fleet.members else None
    match rng.randrange(12):
        case 0 | 1:
            role = rng.choice((Role.ROBOT, Role.CLOUD))
            fleet.connect(f"{role.value}-{rng.randrange(6)}", role)
        case 2 if member:
            fleet.lose_stream(member)
        case 3 if member:
            fleet.move(member)
        case 4 if member and rng.random() < 0.5:
            fleet.leave(member)
        case 5 if member:
            member.refuses = not member.refuses
        case 6 if member:
            fleet.restart(member)
        case 7 if rng.random() < 0.2:
            fleet.core.set_policy(rng.choice(POLICIES), fleet.now)
        case 8:
            fleet.pass_time(rng.choice((0.001, 0.05, 0.3, 2.0)))
        case 9 if member:
            fleet.answer(member)
        case _ if member:
            fleet.deliver(member)
    fleet.dispatch()


@pytest.mark.audit("ops-17")
@pytest.mark.parametrize("seed", range(40))
def test_what_is_held_is_what_is_believed(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream_encoder, "PART_BYTES", random.Random(seed).choice((1, 150, 1 << 20)))
    fleet = Fleet(seed)
    for _ in range(STEPS):
        step(fleet)
    fleet.settle()
    _check(fleet)
    # Once more, while nothing else makes the control plane look at everybody.
    for member in fleet.rng.choices(list(fleet.members.values()), k=min(len(fleet.members), 5)):
        fleet.move(member)
        fleet.answer(member)
        fleet.pass_time(0.01)
    fleet.settle()
    _check(fleet)


def _check(fleet: Fleet) -> None:
    statuses = {status.peer.name: status for status in fleet.core.status(fleet.now)}
    assert statuses.keys() == fleet.members.keys()
    for name, member in fleet.members.items():
        assert member.session.state is ControlState.ONLINE
        assert statuses[name].peers.state is SyncState.SYNCED, name
        held = {} if member.held is None else {peer.name: peer for peer in member.held.peers}
        wanted = {
            other.said.name
            for other in fleet.members.values()
            if other.said.role is not member.said.role and _may(fleet, member, other)
        }
        assert held.keys() == wanted, name
        for peer in held.values():
            told = fleet.members[peer.name]
            assert peer.candidates == told.session._candidates.candidates
            assert peer.incarnation == told.said.incarnation


def _may(fleet: Fleet, one: Member, other: Member) -> bool:
    robot, cloud = (one, other) if one.said.role is Role.ROBOT else (other, one)
    sidecar = fleet.core.registry.get(cloud.said.name)
    assert sidecar is not None
    return bool(fleet.core.permits.of(fleet.core.permits.group(robot.said.name), sidecar))


@pytest.mark.audit("ops-17")
def test_a_change_of_one_robot_is_told_and_not_the_whole_set() -> None:
    fleet = Fleet(1)
    fleet.connect("cloud", Role.CLOUD)
    for number in range(50):
        fleet.connect(f"robot-{number}", Role.ROBOT)
    fleet.settle()
    cloud = fleet.members[NodeName("cloud")]
    robots = [member for member in fleet.members.values() if member.said.role is Role.ROBOT]
    before = [(member.wholes, member.changes) for member in robots]
    wholes = cloud.wholes
    fleet.move(robots[7])
    fleet.answer(robots[7])
    fleet.pass_time(1.0)
    message = cloud.unsent[PeerSet]
    assert isinstance(message, PeerSet)
    assert [peer.name for peer in message.peers] == [robots[7].said.name]
    fleet.settle()
    assert cloud.wholes == wholes
    assert cloud.held is not None
    assert len(cloud.held.peers) == 50
    # It is news to nobody else.
    assert before == [(member.wholes, member.changes) for member in robots]


@pytest.mark.audit("ops-17")
def test_who_refuses_changes_is_sent_the_whole_set_at_once_but_not_each_time() -> None:
    fleet = Fleet(1)
    fleet.connect("cloud", Role.CLOUD)
    fleet.connect("robot", Role.ROBOT)
    fleet.settle()
    cloud, robot = fleet.members[NodeName("cloud")], fleet.members[NodeName("robot")]
    cloud.refuses = True
    wholes = cloud.wholes
    for _ in range(10):
        fleet.move(robot)
        fleet.answer(robot)
        fleet.pass_time(0.1)
        fleet.deliver(cloud)
        fleet.answer(cloud)
        fleet.pass_time(0.1)
        fleet.deliver(cloud)
        fleet.answer(cloud)
    assert cloud.changes
    assert cloud.wholes > wholes
    assert fleet.core.counters.nacks[ResourceKind.PEERS] >= 10
    fleet.settle()
    assert cloud.held is not None
    assert cloud.held.peers[0].candidates == robot.session._candidates.candidates


def test_a_sidecar_of_before_gets_whole_sets_in_one_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream_encoder, "PART_BYTES", 1)
    core = ControlCore(Settings(warm_up_s=0.0), version_epoch=1, now=0.0)
    streams = {}
    for name, role in (("cloud", Role.CLOUD), ("robot-1", Role.ROBOT), ("robot-2", Role.ROBOT)):
        stream = core.register(registration(name, role), 0.0)
        assert not isinstance(stream, Refusal)
        streams[name] = stream
        core.receive(stream, CandidateSet((candidate("eth0"),)), 0.0)
        core.receive(stream, ServiceSet((offer(),)) if role is Role.CLOUD else ServiceSet((), (use(),)), 0.0)
        core.handle_timer(1.0)
    core.handle_timer(2.0)
    sent = []
    while (event := core.next_event()) is not None:
        if isinstance(event, SendMessage) and event.stream == streams["cloud"] and isinstance(event.message, PeerSet):
            sent.append(event.message)
    assert sent
    assert all(not message.base for message in sent)
    (data,) = StreamEncoder().encode(sent[-1], incremental=False)
    parsed = parse_control_message(data)
    assert isinstance(parsed, PeerSet)
    assert (len(parsed.peers), parsed.more) == (2, False)
