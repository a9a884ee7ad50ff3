"""The control plane's core joined to a mesh of sidecar cores, in simulated time."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from plr.controlplane.core.control.control import ControlCore
from plr.controlplane.core.control.events import OffersRefusedNotice, Settings
from plr.controlplane.core.publish.messages import SendMessage
from plr.controlplane.core.registry.registry import Refusal
from plr.controlplane.solver.matcher import solve
from plr.protos.convert import control_message_to_proto, parse_control_message
from plr.protos.model.ids import PROTOCOL_VERSION, Role
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import CandidateSet, PeerSet, Registration, ServiceSet
from plr.protos.model.stream import Ack, Heartbeat, ResourceKind, Welcome

if TYPE_CHECKING:
    from lab.simulated.mesh import Mesh, Node
    from plr.controlplane.core.policy.policy import Policy
    from plr.controlplane.core.registry.registry import StreamId
    from plr.protos.model.ids import NodeName
    from plr.protos.model.stream import ControlMessage

STEP_S = 0.02
"""How often the two planes exchange what they have to say."""


class JoinedPlanes:
    """A control plane to which sidecars of a mesh are connected; some of them may be dishonest."""

    def __init__(self, mesh: Mesh, policy: Policy | None) -> None:
        self.mesh = mesh
        self.core = ControlCore(Settings(warm_up_s=0.0, policy=policy), version_epoch=1000, now=mesh.now)
        self.streams: dict[StreamId, Node] = {}
        self.told: dict[NodeName, ServiceSet] = {}
        self.peer_sets: dict[NodeName, PeerSet] = {}
        self.refused_offers: list[OffersRefusedNotice] = []
        self.rogues: set[NodeName] = set()
        """They take what they know of each other for what the control plane says, and heed no mapping."""

    def join(self, *nodes: Node) -> None:
        for node in nodes:
            peer = node.as_peer()
            registration = Registration(
                PROTOCOL_VERSION,
                node.name,
                node.role,
                peer.session,
                peer.token,
                peer.incarnation,
                "sim",
                credential=peer.credential,
            )
            stream = self.core.register(registration, self.mesh.now)
            assert not isinstance(stream, Refusal)
            self.streams[stream] = node
            self.core.receive(
                stream,
                CandidateSet(peer.candidates, (), peer.candidates_serial, peer.candidates_signature),
                self.mesh.now,
            )

    def leave(self, node: Node) -> None:
        """It does not talk to the control plane any more, which soon forgets it; its paths live on."""
        self.streams = {stream: other for stream, other in self.streams.items() if other is not node}

    def run(self, seconds: float) -> None:
        end = self.mesh.now + seconds
        while self.mesh.now < end:
            self.mesh.run(STEP_S)
            self.talk()

    def talk(self) -> None:
        """Exchange what the two planes have to say."""
        now = self.mesh.now
        for stream, node in self.streams.items():
            services = ServiceSet(node.offers, node.engine.uses())
            if self.told.get(node.name) != services:
                self.told[node.name] = services
                self.core.receive(stream, services, now)
            report = node.engine.take_report(now) if node.role is Role.ROBOT else Heartbeat()
            self.core.receive(stream, report, now)
        self.core.handle_timer(now)
        picture = self.core.start_solving(now)
        if picture is not None:
            plan = solve(picture.problem, time_limit_s=60.0, hint=self.core.plan)
            self.core.solved(self.core.settle(picture, plan, now), now)
        while (event := self.core.next_event()) is not None:
            if isinstance(event, SendMessage) and event.stream in self.streams:
                self._deliver(event.stream, event.message)
            elif isinstance(event, OffersRefusedNotice):
                self.refused_offers.append(event)

    def _deliver(self, stream: StreamId, message: ControlMessage) -> None:
        node, now = self.streams[stream], self.mesh.now
        if isinstance(message, Welcome):
            return
        if isinstance(message, PeerSet):
            self.peer_sets[node.name] = message
            resource = ResourceKind.PEERS
            error = node.engine.apply_peers(self._believed(node, message), now)
        else:
            resource = ResourceKind.MAPPING
            heeded = MappingSet(message.version, message.nonce) if node.name in self.rogues else message
            error = node.engine.apply_mapping(heeded)
        assert error is None
        self.core.receive(stream, Ack(resource, message.version, message.nonce), now)
        self.mesh.pump(node)

    def _believed(self, node: Node, told: PeerSet) -> PeerSet:
        if node.name not in self.rogues:
            return told
        others = (other.told_to(node) for other in self.mesh.nodes.values() if other.role is not node.role)
        return dataclasses.replace(told, peers=tuple(others), removed=(), policy=0)


def restored(peer_set: PeerSet) -> PeerSet:
    """What a sidecar has after a restart, from its disk."""
    # Addresses of the mesh are none that could be written down; robots come by themselves.
    peers = tuple(dataclasses.replace(peer, candidates=()) for peer in peer_set.peers)
    found = parse_control_message(
        control_message_to_proto(dataclasses.replace(peer_set, peers=peers)).SerializeToString()
    )
    assert isinstance(found, PeerSet)
    return found
