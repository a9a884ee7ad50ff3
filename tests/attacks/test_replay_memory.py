"""A member floods a cloud with sessions and interfaces while a robot is away: what the cloud knows of the robot stays.

In simulated time. The robot is parked: it is in no view, its path is down, its process goes on. The hostile member
begins a new session every second, each with 31 interfaces that do not exist.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.simulated.mesh import Mesh, rule
from lab.simulated.sessions import credential_of, seal, session_of
from plr.protos.model.ids import InterfaceId, InterfaceName, NodeName, Role, SessionId, Version
from plr.protos.model.members import PeerSet, RemovalReason, RemovedPeer
from plr.sidecar.core.link.memory import MAX_REMEMBERED_PATHS_OF_PEER
from plr.sidecar.core.path.key_exchange import DEFAULT_LIMITS, KeyLimits
from plr.sidecar.core.path.keys import make_path_keys
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import Header
from plr.sidecar.core.wire.introduction import encode_introduction

if TYPE_CHECKING:
    from lab.simulated.mesh import Node
    from plr.protos.model.ids import Address
    from plr.sidecar.core.link.link import Link

pytestmark = pytest.mark.audit("sec-1")

SESSIONS = 150
"""31 paths of each are more than the 4,096 that a link once remembered for all of its peers."""
PHANTOMS = range(10, 41)
CALLS = 20


class Flood:
    """The hostile member's sessions; `proven`: its interfaces also send what opens."""

    def __init__(self, mesh: Mesh, evil: Node, cloud: Node, *, proven: bool) -> None:
        self._mesh = mesh
        self._evil = evil
        self._cloud = cloud
        self._proven = proven

    def begin_session(self, incarnation: int, session: SessionId) -> None:
        """Introduce 31 interfaces of one session."""
        cloud = self._cloud
        credential = credential_of(self._evil.name, Role.ROBOT, session, incarnation)
        own = session_of(self._evil.name, Role.ROBOT, session, incarnation)
        keys = own.admit(cloud.as_peer())
        to = cloud.address(InterfaceName("eth0"))
        for number in PHANTOMS:
            interface = InterfaceId(number)
            head = Header(interface, InterfaceId(0), session, 1)
            token = self._evil.told_to(cloud).token
            introduction = encode_introduction(head, token, cloud.name, 7, credential.encode())
            self._mesh.inject(("evil.wlan0", 1), to, introduction)
            if self._proven:
                sealing = make_path_keys(keys, interface, InterfaceId(0), DEFAULT_LIMITS, 0.0, leads=True).sealing
                probe = seal(sealing, head, frame.encode_probe(frame.Probe(1)))
                self._mesh.inject(("evil.wlan0", 1), to, probe)

    def run(self) -> None:
        """As many sessions as a memory without shares does not hold, as fast as restarts are believed."""
        incarnation, session = self._evil.incarnation, self._evil.session
        for further in range(1, SESSIONS + 1):
            newer = SessionId((session + further) % 2**64)
            self.begin_session(incarnation + further, newer)
            # The first introduction made the session known and its own path; the others came before that.
            self.begin_session(incarnation + further, newer)
            self._mesh.run(1.05)


def show_all_but(mesh: Mesh, *away: NodeName, left: bool = False) -> None:
    """The control plane's view without these; `left`: they said that they leave, so nobody keeps them."""
    mesh.version += 1
    for node in mesh.nodes.values():
        others = (other for other in mesh.nodes.values() if other.role is not node.role and other.name not in away)
        peers = tuple(other.told_to(node) for other in others)
        removed = tuple(RemovedPeer(name, RemovalReason.LEFT) for name in away) if left else ()
        assert node.engine.apply_peers(PeerSet(Version(mesh.version), mesh.version, peers, removed), mesh.now) is None
        mesh.pump(node)


def cut(mesh: Mesh, interface: str, *, off: bool) -> None:
    for wire in mesh.all_wires_of(interface):
        wire.cut = off


def of_cloud(cloud: Node) -> Link:
    return cloud.links[InterfaceName("eth0")]


@pytest.mark.parametrize("proven", [False, True], ids=["of which nothing opens", "of which a probe opens"])
def test_recorded_requests_of_a_robot_that_is_away_never_run_again(*, proven: bool) -> None:
    """Before: 20 of 20 ran a second time, from a foreign address."""
    mesh = Mesh(1)
    robot, evil, cloud = mesh.robot("wlan0"), mesh.add("evil", Role.ROBOT, ["wlan0"], (rule(),)), mesh.cloud("cloud-a")
    recorded: list[tuple[Address, bytes]] = []
    mesh.push_views()
    mesh.run(10)
    mesh.tap = lambda source, to, data: recorded.append((to, data)) if source[0] == "robot.wlan0" else None
    for number in range(CALLS):
        robot.submit(b"open gripper %d" % number)
        mesh.run(0.5)
    mesh.tap = None
    assert len(cloud.executed) == CALLS
    cut(mesh, "robot.wlan0", off=True)
    mesh.run(5)
    show_all_but(mesh, robot.name)
    mesh.run(1)
    cut(mesh, "evil.wlan0", off=True)
    Flood(mesh, evil, cloud, proven=proven).run()
    memory = of_cloud(cloud)._table._memory
    assert len(memory) <= MAX_REMEMBERED_PATHS_OF_PEER + 1
    assert (len(memory) > 31) == proven, "what never proved itself is not remembered"
    show_all_but(mesh)
    mesh.run(1)
    for to, data in recorded:
        mesh.inject(("elsewhere", 7), to, data)
        mesh.run(0.01)
    mesh.run(2)
    assert len(cloud.executed) == CALLS
    assert of_cloud(cloud).stats.dropped["duplicate"] >= CALLS


@pytest.mark.parametrize("proven", [False, True], ids=["of which nothing opens", "of which a probe opens"])
def test_a_robot_whose_keys_have_changed_comes_back_after_the_flood(*, proven: bool) -> None:
    """Before: locked out until it restarted, since the cloud began with the first phase again."""
    mesh = Mesh(1)
    mesh.key_limits = KeyLimits(seconds=2.0)
    robot, evil, cloud = mesh.robot("wlan0"), mesh.add("evil", Role.ROBOT, ["wlan0"], (rule(),)), mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(10)
    for number in range(CALLS):
        robot.submit(b"x%d" % number)
        mesh.run(0.5)
    assert len(robot.responses()) == CALLS
    (path,) = robot.links[InterfaceName("wlan0")]._paths.values()
    assert path.sealing.phase > 1
    cut(mesh, "robot.wlan0", off=True)
    mesh.run(5)
    show_all_but(mesh, robot.name)
    mesh.run(1)
    cut(mesh, "evil.wlan0", off=True)
    Flood(mesh, evil, cloud, proven=proven).run()
    cut(mesh, "robot.wlan0", off=False)
    show_all_but(mesh)
    mesh.run(5)
    for number in range(CALLS):
        robot.submit(b"y%d" % number)
        mesh.run(0.5)
    mesh.run(5)
    assert len(robot.responses()) == 2 * CALLS
    assert cloud.executed


def test_a_member_that_is_kept_though_not_listed_does_not_go_back_to_an_old_session() -> None:
    mesh = Mesh(1)
    mesh.robot("wlan0")
    evil, cloud = mesh.add("evil", Role.ROBOT, ["wlan0"], (rule(),)), mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(5)
    old = evil.told_to(cloud)
    cut(mesh, "evil.wlan0", off=True)
    flood = Flood(mesh, evil, cloud, proven=True)
    newest = SessionId(evil.session + 1)
    for _ in range(2):
        flood.begin_session(evil.incarnation + 1, newest)
    mesh.run(30)
    show_all_but(mesh, evil.name)
    mesh.run(1)
    assert not of_cloud(cloud)._table.to(evil.name)
    mesh.version += 1
    views = (mesh.nodes["robot"].told_to(cloud), old)
    assert cloud.engine.apply_peers(PeerSet(Version(mesh.version), mesh.version, views), mesh.now) is None
    mesh.pump(cloud)
    assert {path.session for path in of_cloud(cloud)._table.to(evil.name)} == {newest}


def test_a_forgotten_session_is_refused_and_a_newer_one_is_not() -> None:
    """Whoever fills its own share loses its own old sessions: one of them that comes back does not start over."""
    mesh = Mesh(1)
    mesh.robot("wlan0")
    evil, cloud = mesh.add("evil", Role.ROBOT, ["wlan0"], (rule(),)), mesh.cloud("cloud-a")
    mesh.push_views()
    mesh.run(5)
    old = evil.told_to(cloud)
    cut(mesh, "evil.wlan0", off=True)
    Flood(mesh, evil, cloud, proven=True).run()
    mesh.run(30)
    show_all_but(mesh, evil.name, left=True)
    mesh.run(1)
    link = of_cloud(cloud)
    mesh.version += 1
    views = (mesh.nodes["robot"].told_to(cloud), old)
    assert cloud.engine.apply_peers(PeerSet(Version(mesh.version), mesh.version, views), mesh.now) is None
    mesh.pump(cloud)
    assert not link._table.to(evil.name)
    assert link.stats.dropped["forgotten_session"] >= 1
    evil.start()
    cut(mesh, "evil.wlan0", off=False)
    show_all_but(mesh)
    mesh.run(5)
    evil.submit(b"honest again")
    mesh.run(1)
    assert len(evil.responses()) == 1
