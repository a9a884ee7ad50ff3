"""A new revocation list travels from sidecar to sidecar while no control plane is there, whatever one member does."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import pytest

from lab.simulated.mesh import Mesh, rule
from plr.controlplane.ca.authority import Authority
from plr.controlplane.ca.files import write_atomically, write_tls_files
from plr.protos.model.ids import Role
from plr.protos.program.tls_files import CRL_FILE, TlsWatch, load_tls_files
from plr.protos.trust.identity import IdentityRole
from plr.sidecar.control.announcement import Announcer
from plr.sidecar.control.revocations import Revocations
from plr.sidecar.core.base.values import Priority
from plr.sidecar.core.engine.revocation_exchange import ASK_NEXT_AFTER_S, MAX_SENDING_BYTES
from plr.sidecar.core.seam.links import SetCredential
from plr.sidecar.core.wire.messages import RevocationLists, RevocationsHeld, RevocationsWanted, encode_message

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from lab.simulated.mesh import Node
    from plr.protos.model.ids import NodeName
    from plr.protos.trust.credential import SessionCredential
    from plr.sidecar.core.wire.messages import RevocationMessage

pytestmark = pytest.mark.audit("sec-12")

LOOK_S = 1.0
HOP_S = 4.0
"""Telling, waiting, asking, sending, judging: what a list takes from a sidecar to the next, with retransmissions."""


class Keeper:
    """What `sidecar/runtime.py` does about one node's lists; its folder is real, and so are all signatures."""

    def __init__(self, fleet: Fleet, node: Node, *, max_age_s: float = float("inf")) -> None:
        self.fleet, self.node = fleet, node
        self.folder = fleet.folder / node.name
        self.tls = TlsWatch(load_tls_files(self.folder))
        self.kept = b""
        self.judged = 0
        self.revocations = Revocations(self.tls, self, self._keep, lambda _: None, max_age_s)

        def judge(credential: SessionCredential) -> float:
            check = self.tls.current.trust.check
            return check(credential.certificate, fleet.now_wall, max_age_s).not_after

        node.own._verify = judge
        node.own.forget_admitted()
        self.revocations.tell()
        self.revocations.look(fleet.now_wall)

    def _keep(self, pem: bytes) -> None:
        self.kept = pem

    def trust_changed(self) -> None:
        self.node.own.forget_admitted()
        self.node.engine.recheck_peers(self.node.engine.peers.all_refused(), self.node.now)

    def set_revocations(self, numbers: Mapping[int, int], pem: bytes) -> None:
        self.node.engine.revocations.set_own(numbers, pem, self.node.now)

    def judged_revocations(self, peer: NodeName, *, good: bool) -> None:
        self.node.engine.revocations.on_judged(peer, self.node.now, good=good)

    def look(self) -> None:
        """What the control client's thread does each second."""
        if not self.node.alive:
            return
        if self.tls.poll() is not None:
            self.trust_changed()
            self.revocations.tell()
        for peer, pem in self.node.engine.revocations.take_arrived():
            self.judged += 1
            self.revocations.heard(peer, pem)
        self.revocations.look(self.fleet.now_wall)
        self.fleet.mesh.pump(self.node)
        self.fleet.mesh.at(LOOK_S, self.look)

    @property
    def number(self) -> int:
        """Of the list in use."""
        (one,) = self.tls.current.trust.lists().values()
        return -1 if one is None else one.number

    def talks_to(self, name: str) -> bool:
        return name in self.node.engine.peers and self.node.engine.routes.reaches(self.fleet.mesh.nodes[name].name)


class Fleet:
    """A mesh whose members have certificates of a real CA, and a clock."""

    def __init__(self, folder: Path, robots: int, clouds: int, *, loss: float = 0.0, seed: int = 1) -> None:
        self.folder = folder
        self.mesh = mesh = Mesh(seed)
        self.begun_wall = 1_800_000_000.0
        self.ca = Authority.create(clock=lambda: self.now_wall)
        nodes = [mesh.add(f"robot-{number}", Role.ROBOT, ["wlan0"], (rule(),)) for number in range(robots)]
        nodes += [mesh.cloud(f"cloud-{number}") for number in range(clouds)]
        for node in nodes:
            role = IdentityRole(node.role.value)
            issued = self.ca.issue(node.name, role)
            write_tls_files(folder / node.name, issued, self.ca.ca_pem, self.ca.crl_pem())
            self.certify(node, issued.certificate_der)
        for one in nodes[:robots]:
            for other in nodes[robots:]:
                for wire in mesh.both_ways(f"{one.name}.wlan0", f"{other.name}.eth0"):
                    wire.loss = loss
        self.keepers: dict[str, Keeper] = {}

    def certify(self, node: Node, certificate: bytes) -> None:
        node.own.renew(replace(node.own.credential, certificate=certificate))
        files = load_tls_files(self.folder / node.name)
        node.announcer = Announcer(node.session, lambda: files, lambda _: ())
        for link in node.links.values():
            link.execute(SetCredential(node.own.credential.encode()), node.now)

    @property
    def now_wall(self) -> float:
        return self.begun_wall + self.mesh.now

    def start(self, *, max_age_s: float = float("inf"), settle_s: float = 10.0) -> None:
        for node in self.mesh.nodes.values():
            self.keepers[node.name] = Keeper(self, node, max_age_s=max_age_s)
            self.mesh.at(self.mesh.rng.uniform(0.0, LOOK_S), self.keepers[node.name].look)
        self.mesh.push_views()  # the last thing that the control plane does
        self.mesh.run(settle_s)

    def install(self, name: str) -> None:
        """An operator copies the newest list to one node."""
        write_atomically(self.folder / name / CRL_FILE, self.ca.crl_pem(), 0o644)

    def send(self, sender: str, receiver: str, message: RevocationMessage) -> None:
        """A member says what its program would not."""
        node = self.mesh.nodes[sender]
        path = node.engine.routes.best_to(self.mesh.nodes[receiver].name)
        assert path is not None
        ends_at = node.now + 60.0
        node.engine._outbox.send(
            path, encode_message(message), priority=Priority.HIGH, deadline=ends_at, expires=ends_at
        )
        self.mesh.pump(node)

    def dropped(self, name: str) -> Mapping[str, int]:
        return self.mesh.nodes[name].engine.stats.dropped

    def counted(self, name: str) -> Mapping[str, int]:
        return self.mesh.nodes[name].engine.stats.revocations


@pytest.mark.parametrize("seed", [1])
def test_a_list_that_one_node_is_given_reaches_all(tmp_path: Path, seed: int) -> None:
    """12 robots, 8 clouds, 30 % loss, no control plane: the list goes cloud, robots, clouds."""
    fleet = Fleet(tmp_path, 12, 8, loss=0.3, seed=seed)
    fleet.start()
    others = [keeper for name, keeper in fleet.keepers.items() if name != "robot-3"]
    clouds = [keeper for keeper in others if keeper.node.role is Role.CLOUD]
    assert all(keeper.talks_to("robot-3") for keeper in clouds)
    fleet.ca.revoke("robot-3")
    fleet.install("cloud-0")
    fleet.mesh.run(3 * HOP_S)
    assert {keeper.number for keeper in others} == {1}
    assert not any(keeper.talks_to("robot-3") for keeper in clouds)
    assert all("robot-3" in keeper.node.engine.peers.refused for keeper in clouds)
    assert all(keeper.kept == keeper.tls.current.trust.crl_pem() for keeper in others if keeper.node.name != "cloud-0")
    # Nobody was sent it twice but where two asked at once, and nobody asks on.
    sent = sum(fleet.counted(name)["sent"] for name in fleet.keepers)
    assert len(others) - 1 <= sent <= len(others) + 5
    fleet.mesh.run(40.0)
    assert sum(fleet.counted(name)["sent"] for name in fleet.keepers) == sent


def test_who_was_away_hears_of_it_when_a_path_comes_up(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, 2, 2)
    fleet.start()
    for wire in fleet.mesh.all_wires_of("robot-1.wlan0"):
        wire.cut = True
    fleet.ca.revoke("cloud-1")
    fleet.install("cloud-0")
    fleet.mesh.run(300.0)
    assert fleet.keepers["robot-0"].number == 1
    assert fleet.keepers["robot-1"].number == 0
    for wire in fleet.mesh.all_wires_of("robot-1.wlan0"):
        wire.cut = False
    fleet.mesh.run(30.0)
    assert fleet.keepers["robot-1"].number == 1
    assert not fleet.keepers["robot-1"].talks_to("cloud-1")


def test_nothing_travels_where_all_hold_the_same(tmp_path: Path) -> None:
    """A control plane tells all of them within a moment: the numbers travel, the lists do not."""
    fleet = Fleet(tmp_path, 5, 5)
    fleet.start()
    fleet.ca.revoke("robot-0")

    def welcome(keeper: Keeper) -> None:
        assert keeper.revocations.take(fleet.ca.crl_pem(), "the control plane")
        fleet.mesh.pump(keeper.node)

    for keeper in fleet.keepers.values():
        fleet.mesh.at(fleet.mesh.rng.uniform(0.0, 0.3), partial(welcome, keeper))
    fleet.mesh.run(60.0)
    assert all(not fleet.counted(name) for name in fleet.keepers)


def test_the_revoked_does_not_pass_it_on_and_is_not_waited_for(tmp_path: Path) -> None:
    """It says that it holds the newest list, and says nothing more: others are asked."""
    fleet = Fleet(tmp_path, 3, 3)
    fleet.start()
    fleet.ca.revoke("cloud-1")
    (ca,) = fleet.keepers["robot-0"].tls.current.trust.lists()
    for robot in ("robot-0", "robot-1", "robot-2"):
        fleet.send("cloud-1", robot, RevocationsHeld({ca: 1}))
    fleet.mesh.nodes["cloud-1"].engine.revocations._lists = b""
    fleet.mesh.run(2.0)
    assert all(fleet.counted(robot)["asked"] == 1 for robot in ("robot-0", "robot-1", "robot-2"))
    fleet.install("cloud-0")
    fleet.mesh.run(ASK_NEXT_AFTER_S + 2 * HOP_S)
    for name in ("robot-0", "robot-1", "robot-2", "cloud-2"):
        assert fleet.keepers[name].number == 1
        assert not fleet.keepers[name].talks_to("cloud-1")


@pytest.mark.parametrize("answer", [b"junk", b"an old one", b"of another CA", b""])
def test_who_claims_a_newer_list_and_has_none_costs_a_few_questions(tmp_path: Path, answer: bytes) -> None:
    """An hour of claims of an absurd number, each question answered at once with something of no use."""
    fleet = Fleet(tmp_path, 1, 2)
    fleet.start()
    (ca,) = fleet.keepers["robot-0"].tls.current.trust.lists()
    answers = {b"an old one": fleet.ca.crl_pem(), b"of another CA": Authority.create().crl_pem()}
    pem = answers.get(answer, answer)
    robot = fleet.keepers["robot-0"]
    asked = 0
    for _ in range(360):
        fleet.send("cloud-1", "robot-0", RevocationsHeld({ca: 2**64 - 1}))
        fleet.mesh.run(5.0)
        if answer and fleet.counted("robot-0")["asked"] > asked:
            fleet.send("cloud-1", "robot-0", RevocationLists(pem))
        asked = fleet.counted("robot-0")["asked"]
        fleet.mesh.run(5.0)
    # After 30 s, 60 s, 120 s and so on; what is no list of our CA ends it for an hour at once.
    assert asked == (7 if answer in (b"", b"an old one") else 1)
    assert robot.judged == (0 if not answer else asked)
    assert robot.number == 0
    assert robot.talks_to("cloud-0")
    assert robot.talks_to("cloud-1")
    # And the honest one is asked at once.
    fleet.ca.revoke("cloud-1")
    fleet.install("cloud-0")
    fleet.mesh.run(ASK_NEXT_AFTER_S + HOP_S)
    assert robot.number == 1
    assert not robot.talks_to("cloud-1")


def test_lists_that_nobody_asked_for_are_not_looked_at(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, 1, 2)
    fleet.start()
    fleet.ca.revoke("cloud-0")
    for _ in range(50):
        fleet.send("cloud-1", "robot-0", RevocationLists(fleet.ca.crl_pem()))
        fleet.mesh.run(0.1)
    assert fleet.keepers["robot-0"].judged == 0
    assert fleet.dropped("robot-0")["revocations_unasked"] == 50


def test_who_asks_on_and_on_is_sent_little(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, 1, 2)
    fleet.start()
    for _ in range(600):
        fleet.send("robot-0", "cloud-0", RevocationsWanted({}))
        fleet.mesh.run(1.0)
    assert fleet.counted("cloud-0")["sent"] == 5  # at once, after 20 s, 60 s, 140 s, 300 s
    assert fleet.dropped("cloud-0")["revocations_asked_too_often"] == 595


def test_a_restart_does_not_renew_what_a_member_may_cost(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, 1, 2)
    fleet.start()
    exchange = fleet.mesh.nodes["cloud-0"].engine.revocations
    robot = fleet.mesh.nodes["robot-0"].name
    for _ in range(20):
        exchange.on_message(robot, RevocationsWanted({}), fleet.mesh.now)
        exchange.forget_peer(robot)
    assert fleet.counted("cloud-0")["sent"] == 1


def test_long_lists_go_to_many_in_turn(tmp_path: Path) -> None:
    """Ten robots ask at once for a megabyte: four are under way at a time, over 1 MB/s, and all get it."""
    fleet = Fleet(tmp_path, 10, 1)
    for wire in fleet.mesh.all_wires_of("cloud-0.eth0"):
        wire.bytes_per_s = 1e6
    fleet.start()
    cloud = fleet.keepers["cloud-0"]
    (ca,) = cloud.tls.current.trust.lists()
    fleet.mesh.nodes["cloud-0"].engine.revocations.set_own({ca: 7}, bytes(1_000_000), fleet.mesh.now)
    most = 0
    for _ in range(600):
        fleet.mesh.run(0.1)
        most = max(most, fleet.mesh.nodes["cloud-0"].engine._outbox.held_bytes)
    assert most <= MAX_SENDING_BYTES + 100_000
    assert fleet.counted("cloud-0")["sent"] == 10
    assert all(fleet.keepers[f"robot-{number}"].judged == 1 for number in range(10))


# -- age ----------------------------------------------------------------------------------------------------------


def test_without_a_list_that_is_new_enough_nobody_is_talked_to(tmp_path: Path) -> None:
    """A list ages past the limit, and then every node gets a new one."""
    fleet = Fleet(tmp_path, 2, 2)
    fleet.ca.publish()
    for name in fleet.mesh.nodes:
        fleet.install(name)
    fleet.start(max_age_s=3600.0)
    robot, cloud = fleet.keepers["robot-0"], fleet.keepers["cloud-0"]
    fleet.mesh.run(3500.0)
    assert robot.talks_to("cloud-0")
    fleet.mesh.run(100.0)
    assert not robot.talks_to("cloud-0")
    assert not cloud.talks_to("robot-0")
    assert robot.revocations.state.too_old
    assert {refusal.cause for refusal in robot.node.engine.peers.refused.values()} == {"list_too_old"}
    fleet.mesh.run(600.0)
    fleet.ca.publish()
    for name in fleet.mesh.nodes:  # nobody is left who could pass it on
        fleet.install(name)
    fleet.mesh.run(30.0)
    assert all(robot.talks_to(name) for name in ("cloud-0", "cloud-1"))
    assert not robot.revocations.state.too_old


def test_a_newer_list_comes_in_time_from_a_peer(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, 2, 2)
    fleet.ca.publish()
    for name in fleet.mesh.nodes:
        fleet.install(name)
    fleet.start(max_age_s=3600.0)
    for _ in range(4):
        fleet.mesh.run(1800.0)
        fleet.ca.publish()
        fleet.install("cloud-1")
    fleet.mesh.run(30.0)
    assert {keeper.number for keeper in fleet.keepers.values()} == {5}
    assert all(fleet.keepers["robot-0"].talks_to(name) for name in ("cloud-0", "cloud-1"))
    assert not any(keeper.revocations.state.too_old for keeper in fleet.keepers.values())


def test_a_clock_that_runs_wrong_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    fleet = Fleet(tmp_path, 1, 1)
    fleet.ca.publish()
    for name in fleet.mesh.nodes:
        fleet.install(name)
    fleet.start(max_age_s=3600.0)
    robot = fleet.keepers["robot-0"].revocations
    wall = fleet.now_wall
    robot.look(wall + 86_400.0)
    robot.look(wall + 86_401.0)
    assert [record.levelname for record in caplog.records if "this clock is wrong" in record.message] == ["ERROR"]
    robot.look(wall)
    assert any("recent enough again" in record.message for record in caplog.records)
    robot.look(wall - 3600.0)
    assert any("this clock is behind" in record.message for record in caplog.records)
