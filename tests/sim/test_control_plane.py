"""Many sidecars join, move, fall silent, refuse, restart and leave in seeded random order; invariants at each step.

- versions of each resource of each sidecar only grow, nonces too;
- a sidecar that refused what it was sent last is never shown as synced;
- a mapping names only peers the sidecar was sent and interfaces it told;
- when all is quiet, every connected sidecar that does not refuse is synced and sees exactly who is there.
"""

from __future__ import annotations

import dataclasses
import random
import zlib

import pytest

from controlplane.core.control_events import Settings
from protos.model import (
    CandidateSet,
    MappingSet,
    NodeName,
    PeerSet,
    Role,
    ServiceSet,
    SessionId,
    SyncState,
    Version,
)
from tests.sim.control_world import SimSidecar, World
from tests.unit.controlplane.samples import PLAN_TYPE, interfaces, offer, path, registration, use

SERVICES = ("/plan", "/detect", "/grasp")
NICS = ("wlan0", "wwan0", "eth0")


class Chaos:
    """Draws what happens next, and holds the invariants."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.world = World(Settings(warm_up_s=0.0))
        self.world.on_receive = self.check_message
        self.incarnations: dict[str, int] = {}
        self.last: dict[tuple[NodeName, type], tuple[int, int]] = {}
        self.sent_peers: dict[NodeName, set[str]] = {}
        self.told_interfaces: dict[NodeName, set[str]] = {}
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
            return
        for mapping in message.services:
            assert 0.0 <= mapping.predicted_miss <= 1.0
            for assignment in mapping.assignments:
                assert assignment.server in self.sent_peers[sidecar.name]
                assert assignment.interface in self.told_interfaces[sidecar.name]

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
        anew = known is None or restart or self.rng.random() < 0.5
        if anew:
            self.incarnations[name] = self.incarnations.get(name, 0) + 1
        said = registration(name, role, incarnation=self.incarnations[name])
        said = dataclasses.replace(said, session=SessionId(zlib.crc32(name.encode()) << 20 | self.incarnations[name]))
        if known is not None:
            lost_disk = anew and self.rng.random() < 0.3
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
        self.world.say(sidecar, CandidateSet(interfaces(*nics)))

    def tell_services(self, sidecar: SimSidecar) -> None:
        names = self.rng.sample(SERVICES, self.rng.randint(1, len(SERVICES)))
        if sidecar.registration.role is Role.CLOUD:
            offers = tuple(offer(name, capacity=self.rng.choice([0, 0, 1, 3])) for name in names)
            self.world.say(sidecar, ServiceSet(offers))
        else:
            uses = tuple(use(name, idempotent=self.rng.random() < 0.7, type_=PLAN_TYPE) for name in names)
            self.world.say(sidecar, ServiceSet((), uses))

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
        if draw < 0.25 or not anyone:
            self.join(restart=self.rng.random() < 0.2)
        elif draw < 0.35:
            self.world.leave(self.rng.choice(anyone))
        elif draw < 0.42:
            self.world.drop_stream(self.rng.choice(anyone))
        elif draw < 0.47:
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

    def settle(self) -> None:
        """Nothing happens for long enough: everybody has to be in order."""
        self.world.run(self.world.settings.lease_s * 2)
        there = {role: {s.name for s in self.connected(role) if not s.silent} for role in Role}
        assert {sidecar.name for sidecar in self.world.core.registry} == there[Role.ROBOT] | there[Role.CLOUD]
        status = {found.peer.name: found for found in self.world.core.status(self.world.now)}
        for sidecar in self.connected():
            shown = status[sidecar.name]
            assert shown.peers.state in (SyncState.SYNCED, SyncState.REJECTED)
            if shown.peers.state is SyncState.SYNCED:
                other = Role.CLOUD if sidecar.registration.role is Role.ROBOT else Role.ROBOT
                assert sidecar.peer_names == there[other]
            if sidecar.registration.role is Role.ROBOT:
                assert shown.mapping.state in (SyncState.SYNCED, SyncState.REJECTED)
                if shown.mapping.state is SyncState.SYNCED:
                    assert sidecar.services == shown.services
                    assert {mapping.service for mapping in sidecar.services} == {u.name for u in shown.uses}


@pytest.mark.parametrize("seed", range(12))
def test_invariants_hold_in_any_order(seed: int) -> None:
    chaos = Chaos(seed)
    for step in range(150):
        chaos.happen()
        chaos.check_states()
        chaos.world.run(chaos.rng.choice([0.0, 0.01, 0.1, 1.0, 3.0]))
        chaos.check_states()
        if step % 50 == 49:
            chaos.settle()
    assert chaos.world.solvings > 10


@pytest.mark.parametrize("seed", range(4))
def test_a_restarted_control_plane_never_takes_a_living_server_from_a_robot(seed: int) -> None:
    """Robots and clouds come back in random order within the reconnect time; nobody is lost on the way."""
    rng = random.Random(seed)
    before = World()
    clouds = [before.cloud(f"cloud-{number}") for number in range(4)]
    robots = [before.robot(f"robot-{number}") for number in range(6)]
    before.run(2.0)
    world = World(Settings(warm_up_s=12.0), epoch=1_000_000)
    names = {cloud.name for cloud in clouds}
    arrivals = sorted((rng.uniform(0.0, 10.0), sidecar.name, sidecar) for sidecar in [*clouds, *robots])
    start = world.now

    def nobody_is_missing(sidecar: SimSidecar, message: PeerSet | MappingSet) -> None:
        if sidecar.registration.role is Role.ROBOT and isinstance(message, PeerSet):
            assert {peer.name for peer in message.peers} == names
            assert message.removed == ()

    world.on_receive = nobody_is_missing
    for delay, _, old in arrivals:
        world.run(start + delay - world.now)
        said = dataclasses.replace(
            old.registration, peers_version=old.peers_version, mapping_version=old.mapping_version
        )
        sidecar = world.join(said)
        sidecar.peers, sidecar.peers_version = old.peers, old.peers_version
        is_robot = said.role is Role.ROBOT
        world.say(sidecar, CandidateSet(interfaces("wlan0", "wwan0") if is_robot else interfaces("eth0")))
        world.say(sidecar, ServiceSet((), (use(),)) if is_robot else ServiceSet((offer(),)))
        for robot in world.sidecars.values():
            if robot.registration.role is Role.ROBOT:
                world.all_up(robot, tuple(names))
    world.run(5.0)
    for robot in robots:
        now = world.sidecars[robot.name]
        assert now.peer_names == names
        assert now.peers_version > robot.peers_version
        assert len(now.peer_sets) == 1
        assert len(now.pairs()) == 2
