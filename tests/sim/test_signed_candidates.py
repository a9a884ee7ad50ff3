"""A hostile control plane tells a fleet where its members are: it can hold back what they said, and add nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from plr.protos.model.ids import InterfaceId, InterfaceName, Version
from plr.protos.model.members import Candidate, CandidateKind, PeerSet
from plr.protos.trust.candidate_signature import sign_candidates
from tests.sim.certified import CertifiedMesh

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from lab.simulated.mesh import Mesh, Node
    from plr.protos.model.ids import Address
    from plr.protos.model.members import Peer

pytestmark = pytest.mark.audit("sec-5")

ETH0 = InterfaceName("eth0")
VICTIM = "victim"
AIMED = Candidate(InterfaceId(0), ETH0, CandidateKind.HOST, (VICTIM, 53))
PHANTOM = Candidate(InterfaceId(7), InterfaceName("eth7"), CandidateKind.HOST, (VICTIM, 53))


def fleet(folder: Path) -> tuple[CertifiedMesh, Node, Node]:
    mesh = CertifiedMesh(1, folder)
    robot, cloud = mesh.robot("wlan0", "wwan0"), mesh.cloud("cloud-a")
    mesh.unreachable.add(VICTIM)
    return mesh, robot, cloud


def tell(mesh: Mesh, node: Node, *peers: Peer) -> None:
    mesh.version += 1
    assert node.engine.apply_peers(PeerSet(Version(mesh.version), mesh.version, peers), node.now) is None
    mesh.pump(node)


def sent_to(mesh: Mesh, host: str, seconds: float) -> int:
    """Datagrams that anybody sends there from now on."""
    seen = 0

    def tap(source: Address, destination: Address, data: bytes) -> None:
        nonlocal seen
        seen += destination[0] == host

    mesh.tap = tap
    mesh.run(seconds)
    mesh.tap = None
    return seen


def dropped(node: Node, reason: str) -> int:
    return node.engine.stats.dropped[reason]


def assert_answered(mesh: Mesh, robot: Node) -> None:
    before = len(robot.responses())
    robot.submit(b"as ever")
    mesh.run(1.0)
    assert len(robot.responses()) == before + 1


def resigned(peer: Peer, by: Node, mesh: CertifiedMesh) -> Peer:
    """With a larger serial and a signature of somebody's certificate."""
    serial = peer.candidates_serial + 1
    key = mesh.files[by.name].private_key
    signature = sign_candidates(key, peer.session, serial, peer.candidates)
    return replace(peer, candidates_serial=serial, candidates_signature=signature)


LIES: dict[str, Callable[[CertifiedMesh, Peer, Node], Peer]] = {
    "under the old signature": lambda _mesh, peer, _robot: peer,
    "under the old signature, as newer": lambda _mesh, peer, _robot: replace(peer, candidates_serial=99),
    "without signature": lambda _mesh, peer, _robot: replace(peer, candidates_serial=99, candidates_signature=b""),
    "signed by another member": lambda mesh, peer, robot: resigned(peer, robot, mesh),
}


@pytest.mark.parametrize("lie", LIES)
@pytest.mark.parametrize("added", [AIMED, PHANTOM], ids=["of an interface there is", "of a further interface"])
def test_an_address_that_a_control_plane_adds_is_sent_nothing(tmp_path: Path, lie: str, added: Candidate) -> None:
    """Before: a probe each, some 16 a second from each interface of each robot, for as long as it says so."""
    mesh, robot, cloud = fleet(tmp_path)
    mesh.push_views()
    mesh.run(2.0)
    honest = cloud.told_to(robot)
    aimed = replace(honest, candidates=(*honest.candidates, added))
    tell(mesh, robot, LIES[lie](mesh, aimed, robot))
    assert sent_to(mesh, VICTIM, 30.0) == 0
    assert dropped(robot, "bad_candidates") == 1
    assert "cloud-a" in robot.engine.peers.ignored_candidates
    assert_answered(mesh, robot)


@pytest.mark.parametrize("lie", LIES)
def test_nor_is_one_in_the_first_view_of_all(tmp_path: Path, lie: str) -> None:
    mesh, robot, cloud = fleet(tmp_path)
    honest = cloud.told_to(robot)
    aimed = replace(honest, candidates=(*honest.candidates, AIMED))
    tell(mesh, robot, LIES[lie](mesh, aimed, robot))
    assert sent_to(mesh, VICTIM, 30.0) == 0
    assert dropped(robot, "bad_candidates") == 1
    # What it says after that it signed itself, and is found by it.
    mesh.push_views()
    mesh.run(2.0)
    assert robot.engine.peers.ignored_candidates == {}
    assert_answered(mesh, robot)


@pytest.mark.parametrize("meanwhile", ["known", "out of the view"])
def test_what_a_peer_announced_once_is_not_played_again(tmp_path: Path, meanwhile: str) -> None:
    """Its address of then may be another's now."""
    mesh, robot, cloud = fleet(tmp_path)
    honest = cloud.told_to(robot)
    first = resigned(replace(honest, candidates=(*honest.candidates, AIMED)), cloud, mesh)
    tell(mesh, robot, first)
    assert sent_to(mesh, VICTIM, 3.0) > 0, "it said so itself"
    tell(mesh, cloud, robot.told_to(cloud))
    second = resigned(replace(first, candidates=honest.candidates), cloud, mesh)
    tell(mesh, robot, second)
    mesh.run(3.0)
    if meanwhile != "known":
        tell(mesh, robot)
        for wire in mesh.all_wires_of("cloud-a.eth0"):
            wire.cut = True
        mesh.run(30.0)
        assert "cloud-a" not in robot.engine.peers
        for wire in mesh.all_wires_of("cloud-a.eth0"):
            wire.cut = False
    tell(mesh, robot, first)
    assert sent_to(mesh, VICTIM, 30.0) == 0
    assert dropped(robot, "old_candidates") == 1
    assert_answered(mesh, robot)


def test_what_another_run_announced_is_not_played_into_this_one(tmp_path: Path) -> None:
    mesh, robot, cloud = fleet(tmp_path)
    honest = cloud.told_to(robot)
    before = resigned(replace(honest, candidates=(*honest.candidates, AIMED)), cloud, mesh)
    mesh.run(1.0)
    cloud.start()
    now = cloud.told_to(robot)
    forged = replace(
        now,
        candidates=before.candidates,
        candidates_serial=before.candidates_serial,
        candidates_signature=before.candidates_signature,
    )
    tell(mesh, robot, forged)
    assert sent_to(mesh, VICTIM, 30.0) == 0
    assert dropped(robot, "bad_candidates") == 1


def test_a_restart_keeps_the_addresses_until_new_ones_are_signed(tmp_path: Path) -> None:
    """As the registry tells it: no addresses at all, then those of the new run."""
    mesh, robot, cloud = fleet(tmp_path)
    mesh.push_views()
    mesh.run(2.0)
    mesh.at(0.0, cloud.start)
    mesh.run(0.1)
    told = cloud.told_to(robot)
    tell(mesh, robot, replace(told, candidates=(), candidates_serial=0, candidates_signature=b""))
    tell(mesh, cloud, robot.told_to(cloud))
    mesh.run(3.0)
    assert_answered(mesh, robot)
    tell(mesh, robot, told)
    assert robot.engine.peers.ignored_candidates == {}
    assert dropped(robot, "bad_candidates") == dropped(robot, "old_candidates") == 0
    assert_answered(mesh, robot)


def test_a_renewed_certificate_signs_further_addresses(tmp_path: Path) -> None:
    mesh, robot, cloud = fleet(tmp_path)
    mesh.push_views()
    mesh.run(2.0)
    old = cloud.told_to(robot)
    renewed = mesh.renew(cloud)
    # Signed with the new key while the credential is the old one's: not proven, and the known ones stay.
    tell(mesh, robot, cloud.told_to(robot))
    assert dropped(robot, "bad_candidates") == 1
    (kept,) = robot.engine.peers.all()
    assert kept.candidates == old.candidates
    cloud.own.renew(renewed)
    tell(mesh, robot, cloud.told_to(robot))
    assert robot.engine.peers.ignored_candidates == {}
    assert_answered(mesh, robot)


def test_many_addresses_of_one_interface_are_cut_to_a_few(tmp_path: Path) -> None:
    """A member that signs 256 of them itself."""
    mesh, robot, cloud = fleet(tmp_path)
    honest = cloud.told_to(robot)
    many = tuple(Candidate(InterfaceId(0), ETH0, CandidateKind.HOST, (VICTIM, 1000 + port)) for port in range(256))
    tell(mesh, robot, resigned(replace(honest, candidates=many), cloud, mesh))
    ports = set()
    mesh.tap = lambda _source, destination, _data: ports.add(destination)
    mesh.run(60.0)
    assert ports == {(VICTIM, 1000 + port) for port in range(8)}
    assert dropped(robot, "candidates_full") == 248
