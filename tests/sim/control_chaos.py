"""Many sidecars join, move, fall silent, refuse, are cut off, restart and leave in seeded random order; invariants at
each step.

- versions of each resource of each sidecar only grow, nonces too;
- a sidecar that refused what it was sent last is never shown as synced;
- a mapping names only peers the sidecar was sent and interfaces it told;
- neither peers nor mappings ever tell of a call that the policy of the moment denies;
- when all is quiet, and nobody refuses any more, every connected sidecar is synced and sees who is there
  and concerns it.
"""

from __future__ import annotations

import dataclasses
import random
import zlib
from typing import TYPE_CHECKING

from plr.controlplane.core.control.events import Settings
from plr.controlplane.core.publish.messages import CloseReason
from plr.protos.model.ids import InterfaceName, NodeName, Role, ServiceName, SessionId, Version
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import (
    AT_MOST_EVERY_INTERFACE,
    EVERY_INTERFACE,
    CandidateSet,
    Copies,
    InterfaceLabel,
    PeerSet,
    ServiceSet,
    ServiceUse,
)
from plr.protos.model.status import SyncState
from tests.support.control_world import SimSidecar, World
from tests.support.samples import PLAN_TYPE, interfaces, offer, path, registration, use

if TYPE_CHECKING:
    from plr.controlplane.core.policy.policy import Policy
    from plr.protos.model.members import Peer

SERVICES = ("/plan", "/detect", "/grasp")
NICS = ("wlan0", "wwan0", "eth0")


class Chaos:
    """Draws what happens next, and holds the invariants."""

    def __init__(self, seed: int, policies: tuple[Policy | None, ...] = (None,)) -> None:
        self.rng = random.Random(seed)
        self.policies = policies
        self.policy: Policy | None = None
        """In force. Whatever else happens, now and then it changes to one of `policies`."""
        self.world = World(Settings(warm_up_s=0.0))
        self.world.on_receive = self.check_message
        self.incarnations: dict[str, int] = {}
        self.last: dict[tuple[NodeName, type], tuple[int, int]] = {}
        self.sent_peers: dict[NodeName, set[str]] = {}
        self.told_interfaces: dict[NodeName, set[str]] = {}
        self.offered: dict[NodeName, set[ServiceName]] = {}
        self.control_plane_restarts = 0

    def check_message(self, sidecar: SimSidecar, message: PeerSet | MappingSet) -> None:
        version, nonce = self.last.get((sidecar.name, type(message)), (0, 0))
        assert message.version > version
        assert message.nonce > nonce
        self.last[sidecar.name, type(message)] = (message.version, message.nonce)
        if isinstance(message, PeerSet):
            self.sent_peers[sidecar.name] = {peer.name for peer in message.peers}
            assert not self.sent_peers[sidecar.name] & {removed.name for removed in message.removed}
            assert all(peer.role is not sidecar.registration.role for peer in message.peers)
            for peer in message.peers:
                self.check_peer(sidecar, peer)
            return
        for mapping in message.services:
            assert 0.0 <= mapping.predicted_miss <= 1.0
            for assignment in mapping.assignments:
                assert assignment.server in self.sent_peers[sidecar.name]
                assert assignment.interface in self.told_interfaces[sidecar.name]
                assert self.allows(sidecar.name, mapping.service, assignment.server)

    def check_peer(self, sidecar: SimSidecar, peer: Peer) -> None:
        if sidecar.registration.role is Role.ROBOT:
            assert all(self.allows(sidecar.name, told.name, peer.name) for told in peer.offers)
        else:
            assert peer.may_call.everything is (self.policy is None)
            assert all(self.allows(peer.name, service, sidecar.name) for service in peer.may_call.services)

    def allows(self, robot: NodeName, service: ServiceName, cloud: NodeName) -> bool:
        return self.policy is None or self.policy.allows(robot, service, cloud)

    def concern_each_other(self, one: NodeName, other: NodeName) -> bool:
        """Whether the robot of the two may call something that the cloud of the two offers now."""
        if self.policy is None:
            return True
        robot, cloud = sorted((one, other), reverse=True)  # robot-1 after cloud-1
        return any(self.allows(robot, service, cloud) for service in self.offered[cloud])

    def check_states(self) -> None:
        for status in self.world.core.status(self.world.now):
            sidecar = self.world.sidecars[status.peer.name]
            for resource, kind in ((status.peers, PeerSet), (status.mapping, MappingSet)):
                if resource.state is SyncState.SYNCED:
                    in_force = sidecar.peers_version if kind is PeerSet else sidecar.mapping_version
                    assert in_force == resource.version_sent == resource.version_acked
                if resource.state is SyncState.REJECTED:
                    assert resource.error

    # ── what happens ──

    def connected(self, role: Role | None = None) -> list[SimSidecar]:
        return [
            sidecar
            for sidecar in self.world.sidecars.values()
            if sidecar.stream is not None and role in (None, sidecar.registration.role)
        ]

    def join(self, *, restart: bool = False) -> None:
        role = self.rng.choice([Role.ROBOT, Role.CLOUD])
        name = f"{role.value}-{self.rng.randrange(8)}"
        known = self.world.sidecars.get(NodeName(name))
        if known is not None and known.stream is not None and not restart:
            return
        fresh = known is None or restart or self.rng.random() < 0.5
        if fresh:
            self.incarnations[name] = self.incarnations.get(name, 0) + 1
        said = registration(name, role, incarnation=self.incarnations[name])
        session = SessionId(zlib.crc32(name.encode()) << 20 | self.incarnations[name])
        said = dataclasses.replace(said, session=session, region=self.rng.choice(["", "eu", "us"]))
        if known is not None:
            lost_disk = fresh and self.rng.random() < 0.3
            if lost_disk:
                known.peers_version = known.mapping_version = Version(0)
            said = dataclasses.replace(said, peers_version=known.peers_version, mapping_version=known.mapping_version)
            known.silent = False
        sidecar = self.world.join(said)
        self.tell_interfaces(sidecar)
        self.tell_services(sidecar)

    def tell_interfaces(self, sidecar: SimSidecar) -> None:
        nics = self.rng.sample(NICS, self.rng.randint(0 if self.rng.random() < 0.1 else 1, len(NICS)))
        # What the sidecar told before may stand in a mapping that is on its way.
        self.told_interfaces[sidecar.name] = set(nics)
        labelled = [InterfaceName(nic) for nic in nics if self.rng.random() < 0.5]
        labels = (InterfaceLabel(nic, self.rng.choice(["", "a", "b"]), self.rng.random()) for nic in labelled)
        self.world.say(sidecar, CandidateSet(interfaces(*nics), tuple(labels)))

    def tell_services(self, sidecar: SimSidecar) -> None:
        names = self.rng.sample(SERVICES, self.rng.randint(1, len(SERVICES)))
        if sidecar.registration.role is Role.CLOUD:
            self.offered[sidecar.name] = {ServiceName(name) for name in names}
            offers = tuple(offer(name, capacity=self.rng.choice([0, 0, 1, 3])) for name in names)
            self.world.say(sidecar, ServiceSet(offers))
        else:
            self.world.say(sidecar, ServiceSet((), tuple(self.use(name) for name in names)))

    def use(self, name: str) -> ServiceUse:
        plain = use(name, idempotent=self.rng.random() < 0.7, type_=PLAN_TYPE)
        copies = self.rng.choice([EVERY_INTERFACE, EVERY_INTERFACE, AT_MOST_EVERY_INTERFACE, Copies(2, 2)])
        return dataclasses.replace(plain, copies=copies, target_miss=self.rng.choice([0.0, 0.0, 0.3, 1e-4]))

    def report(self, robot: SimSidecar) -> None:
        self.world.report(
            robot,
            *(
                path(nic, server, up=self.rng.random() < 0.8)
                for nic in self.told_interfaces[robot.name]
                for server in robot.peer_names
            ),
        )

    def happen(self) -> None:
        anyone, robots = self.connected(), self.connected(Role.ROBOT)
        draw = self.rng.random()
        if self.rng.random() < 0.1:
            self.change_policy()
        if draw < 0.25 or not anyone:
            self.join(restart=self.rng.random() < 0.2)
        elif draw < 0.35:
            self.world.leave(self.rng.choice(anyone))
        elif draw < 0.42:
            self.world.drop_stream(self.rng.choice(anyone))
        elif draw < 0.44:
            self.world.core.end_stream(self.rng.choice(anyone).name, CloseReason.CERTIFICATE_ENDED, self.world.now)
            self.world.dispatch()
        elif draw < 0.48:
            self.rng.choice(anyone).silent = True
        elif draw < 0.57:
            self.tell_interfaces(self.rng.choice(anyone))
        elif draw < 0.67:
            self.tell_services(self.rng.choice(anyone))
        elif draw < 0.77:
            sidecar = self.rng.choice(anyone)
            odds = self.rng.choice([0.0, 0.0, 0.3, 1.0])
            sidecar.refuse = lambda _: self.rng.random() < odds
        elif robots:
            self.report(self.rng.choice(robots))

    def change_policy(self) -> None:
        self.policy = self.rng.choice(self.policies)
        self.world.core.set_policy(self.policy, self.world.now)

    def settle(self) -> None:
        """Nothing happens for long enough, and causes to refuse have passed: everybody has to be in order."""
        for sidecar in self.world.sidecars.values():
            sidecar.refuse = lambda _: False
        self.world.run(self.world.settings.lease_s * 2)
        there = {role: {s.name for s in self.connected(role) if not s.silent} for role in Role}
        assert {sidecar.name for sidecar in self.world.core.registry} == there[Role.ROBOT] | there[Role.CLOUD]
        status = {found.peer.name: found for found in self.world.core.status(self.world.now)}
        for sidecar in self.connected():
            shown = status[sidecar.name]
            assert shown.peers.state is SyncState.SYNCED
            other = Role.CLOUD if sidecar.registration.role is Role.ROBOT else Role.ROBOT
            concerned = {name for name in there[other] if self.concern_each_other(sidecar.name, name)}
            # A cloud's robots keep their place while a server of it is away.
            assert concerned <= sidecar.peer_names <= there[other]
            for peer in sidecar.peers:
                self.check_peer(sidecar, peer)
            if sidecar.registration.role is Role.ROBOT:
                assert shown.mapping.state is SyncState.SYNCED
                assert sidecar.services == shown.services
                assert {mapping.service for mapping in sidecar.services} == {u.name for u in shown.uses}
