"""Which addresses of peers are used: the newest that each signed. In insecure mode, whatever is told."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from lab.simulated.sessions import session_of
from plr.protos.model.ids import InterfaceId, InterfaceName, NodeName, Role, Version
from plr.protos.model.members import Candidate, CandidateKind, Peer, PeerSet
from plr.protos.trust.candidate_signature import sign_candidates, verify_candidates
from plr.protos.trust.clock_floor import ClockFloor
from plr.protos.trust.identity import IdentityRole
from plr.sidecar.core.crypto import session
from plr.sidecar.core.engine import announced as module
from plr.sidecar.core.engine.announced import Announced
from plr.sidecar.core.engine.peers import Peers
from plr.sidecar.state.start_session import start_session
from tests.support.builders import peer
from tests.unit.sidecar.state.test_start_session import Fleet

if TYPE_CHECKING:
    from pathlib import Path

    from plr.protos.program.tls_files import TlsFiles

pytestmark = pytest.mark.audit("sec-5")

INSECURE = session_of("robot-1", Role.ROBOT, 99)


def candidate(host: str, interface: int = 0) -> Candidate:
    return Candidate(InterfaceId(interface), InterfaceName(f"eth{interface}"), CandidateKind.HOST, (host, 1))


class Cloud:
    """A cloud with a certificate, and a robot that hears of it."""

    def __init__(self, folder: Path) -> None:
        self.fleet = fleet = Fleet(folder)
        self.files: TlsFiles = fleet.issue("cloud-a", IdentityRole.CLOUD)
        self.own = fleet.session(self.files)
        self.trusted = fleet.issue("robot-1")
        self.robot = start_session(NodeName("robot-1"), Role.ROBOT, 1, lambda: self.trusted, ClockFloor(time.time))
        self.dropped: Counter[str] = Counter()
        self.announced = Announced(self.robot, self.dropped)

    def told(self, serial: int, *hosts: str, signed: bool = True) -> Peer:
        credential, candidates = self.own.credential, tuple(map(candidate, hosts))
        return Peer(
            credential.name,
            credential.role,
            credential.session,
            bytes(16),
            credential.incarnation,
            candidates,
            credential=credential.encode(),
            candidates_serial=serial,
            candidates_signature=sign_candidates(self.files.private_key, credential.session, serial, candidates)
            if signed
            else b"",
        )

    def hosts(self, told: Peer) -> list[str]:
        return [used.address[0] for used in self.announced.candidates_of(told)]


@pytest.fixture
def cloud(tmp_path: Path) -> Cloud:
    return Cloud(tmp_path)


def test_the_newest_that_is_signed_is_used(cloud: Cloud) -> None:
    assert cloud.hosts(cloud.told(1, "a")) == ["a"]
    assert cloud.hosts(cloud.told(3, "c")) == ["c"]
    assert cloud.hosts(cloud.told(2, "b")) == ["c"]
    assert cloud.hosts(cloud.told(3, "another")) == ["c"]
    assert cloud.dropped == {"old_candidates": 2}
    assert "older" in cloud.announced.ignored[NodeName("cloud-a")]
    assert cloud.hosts(cloud.told(3, "c")) == ["c"]
    assert cloud.announced.ignored == {}
    assert cloud.hosts(cloud.told(4)) == []


def test_what_is_not_signed_is_not_used(cloud: Cloud) -> None:
    assert cloud.hosts(cloud.told(1, "a", signed=False)) == []
    assert cloud.announced.ignored == {"cloud-a": "its addresses are not signed"}
    assert cloud.hosts(replace(cloud.told(1, "a"), candidates=(candidate("victim"),))) == []
    assert cloud.announced.ignored == {"cloud-a": "the signature of its addresses is wrong"}
    assert cloud.dropped == {"bad_candidates": 2}
    assert cloud.hosts(cloud.told(1, "a")) == ["a"]
    assert cloud.announced.ignored == {}


def test_nothing_said_is_no_fault_and_changes_nothing(cloud: Cloud) -> None:
    """A peer that has restarted, or renewed its certificate, signs its addresses a moment later."""
    assert cloud.hosts(cloud.told(0, signed=False)) == []
    assert cloud.hosts(cloud.told(1, "a")) == ["a"]
    assert cloud.hosts(cloud.told(0, signed=False)) == ["a"]
    assert not cloud.dropped
    assert cloud.announced.ignored == {}


def test_a_new_run_counts_from_the_start(cloud: Cloud) -> None:
    assert cloud.hosts(cloud.told(9, "a")) == ["a"]
    old = cloud.told(10, "old")
    cloud.own = start_session(cloud.files.identity.name, Role.CLOUD, 2, lambda: cloud.files, ClockFloor(time.time))
    assert cloud.hosts(cloud.told(1, "b")) == ["b"]
    assert cloud.hosts(old) == ["b"]
    assert cloud.dropped == {"old_candidates": 1}


def test_what_a_thief_announced_last_does_not_outlive_the_revocation_of_its_key(cloud: Cloud, tmp_path: Path) -> None:
    """It signs with the largest incarnation there is; the node that gets a new certificate has a smaller one."""
    assert cloud.hosts(cloud.told(1, "a")) == ["a"]
    cloud.own = start_session(
        cloud.files.identity.name, Role.CLOUD, 2**64 - 1, lambda: cloud.files, ClockFloor(time.time)
    )
    assert cloud.hosts(cloud.told(2**64 - 1, "thief")) == ["thief"]
    fleet = cloud.fleet
    fleet.ca.revoke("cloud-a")
    cloud.trusted = replace(cloud.trusted, trust=fleet.trust())
    cloud.robot.forget_admitted()
    cloud.files = fleet.issue("cloud-a", IdentityRole.CLOUD)
    cloud.own = start_session(cloud.files.identity.name, Role.CLOUD, 2, lambda: cloud.files, ClockFloor(time.time))
    assert cloud.hosts(cloud.told(0, signed=False)) == []
    assert cloud.hosts(cloud.told(1, "b")) == ["b"]
    assert not cloud.dropped


@pytest.mark.audit("sec-1")
def test_links_hear_that_a_name_is_somebody_elses_now(cloud: Cloud) -> None:
    """They may have forgotten a path of a session with the largest incarnation, and would refuse all later ones."""
    peers = Peers(cloud.robot, cloud.dropped)
    name = cloud.files.identity.name
    cloud.own = start_session(name, Role.CLOUD, 2**64 - 1, lambda: cloud.files, ClockFloor(time.time))

    def era(version: int) -> int:
        assert peers.apply(PeerSet(Version(version), version, (cloud.told(1, "a"),)), lambda _: False) is None
        (told,) = peers.for_links()
        return told.era

    assert era(1) == 0
    cloud.fleet.ca.revoke("cloud-a")
    cloud.trusted = replace(cloud.trusted, trust=cloud.fleet.trust())
    cloud.robot.forget_admitted()
    assert peers.recheck() == [name]
    cloud.files = cloud.fleet.issue("cloud-a", IdentityRole.CLOUD)
    cloud.own = start_session(name, Role.CLOUD, 2, lambda: cloud.files, ClockFloor(time.time))
    assert [era(2), era(3)] == [1, 1]


def test_each_signature_is_looked_at_once(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    """Good or bad: judged before the engine's lock is taken, it costs nothing under it."""
    looks = 0
    verify = verify_candidates

    def counting(*arguments: object) -> None:
        nonlocal looks
        looks += 1
        verify(*arguments)  # type: ignore[arg-type]  # passed on

    monkeypatch.setattr(session, "verify_candidates", counting)
    good = cloud.told(1, "a")
    bad = replace(good, candidates_serial=2)
    for told in (good, good, bad, bad):
        cloud.announced.candidates_of(told)
    assert looks == 2


def test_in_insecure_mode_the_last_word_counts() -> None:
    announced = Announced(INSECURE, Counter())
    told = peer("cloud-a")
    assert announced.candidates_of(told) == told.candidates
    assert announced.candidates_of(replace(told, candidates=(candidate("b"),))) == (candidate("b"),)
    assert announced.candidates_of(replace(told, candidates=())) == ()
    assert announced.candidates_of(told) == told.candidates


def test_the_first_eight_of_an_interface_are_used() -> None:
    dropped: Counter[str] = Counter()
    announced = Announced(INSECURE, dropped)
    many = [candidate(f"{interface}.{number}", interface) for number in range(9) for interface in range(2)]
    used = announced.candidates_of(replace(peer("cloud-a"), candidates=tuple(many)))
    assert used == tuple(many[:16])
    assert dropped == {"candidates_full": 2}


def test_the_absent_ones_are_forgotten_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_ANNOUNCED_PEERS", 3)
    announced = Announced(INSECURE, Counter())
    for name in ("a", "b", "c", "a", "d"):
        announced.candidates_of(peer(name))
    assert list(announced._newest) == ["c", "a", "d"]
