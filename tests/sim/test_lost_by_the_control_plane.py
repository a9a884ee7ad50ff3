"""Members whose control plane alone is out of reach: it forgets them, and their links may go dark as well after that.

The control plane reaches all others, and tells them that the lease expired.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from lab.simulated.mesh import SERVICE, Mesh, Node, rule
from lab.simulated.sessions import with_credential
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy
from plr.protos.model.ids import NodeName, Role
from plr.protos.model.members import RemovalReason
from plr.protos.trust.identity import EXPIRED, CertificateError
from plr.sidecar.core.seam.links import SetReady
from tests.sim.joined_planes import JoinedPlanes
from tests.sim.nat import NatMesh

if TYPE_CHECKING:
    from lab.simulated.mesh import Wire
    from plr.protos.trust.credential import SessionCredential
    from plr.sidecar.core.base.values import RequestId

EVERYBODY = (OfferRule(("*",), ("*",)),)
SOON_S = 2.0
"""Longer than a fiftieth of an outage, and a request."""
LONG_S = 300.0
"""A fiftieth of this is much longer."""


class Trial:
    """A robot with two interfaces behind NATs, and a cloud."""

    def __init__(self, seed: int = 1, policy: Policy | None = None, **changes: object) -> None:
        self.mesh: Mesh = NatMesh(seed)
        self.robot = self.mesh.robot("wlan0", "wwan0", rules=(rule(**{"lifetime_s": 60.0, **changes}),))
        self.cloud = self.mesh.cloud("cloud-a")
        self.planes = JoinedPlanes(self.mesh, policy)
        self.planes.join(self.cloud, self.robot)
        self.planes.run(3.0)

    def lose(self, node: Node) -> None:
        """Cut a node off from its control plane alone, until its lease has ended; its paths work."""
        self.planes.leave(node)
        self.planes.run(12.0)
        assert self.is_answered(), "a dead control plane costs no request"

    @property
    def wires(self) -> list[Wire]:
        return [wire for name in ("robot.wlan0", "robot.wwan0") for wire in self.mesh.all_wires_of(name)]

    def dark(self, seconds: float) -> None:
        """Cut all paths."""
        wires = self.wires
        for wire in wires:
            wire.cut = True
        self.planes.run(seconds)
        for wire in wires:
            wire.cut = False

    def ask(self) -> RequestId:
        return self.robot.submit(b"request")

    def is_answered(self, within_s: float = SOON_S) -> bool:
        asked = self.ask()
        self.planes.run(within_s)
        return any(answer.request_id == asked for answer in self.robot.responses())

    def other_end(self, lost: Node) -> Node:
        return self.cloud if lost is self.robot else self.robot


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("who", ["robot", "cloud"])
@pytest.mark.parametrize("dark_s", [10.0, 60.0])
def test_a_tunnel_does_not_part_it_from_its_peers_for_good(who: str, dark_s: float, seed: int) -> None:
    trial = Trial(seed)
    lost = getattr(trial, who)
    trial.lose(lost)
    other = trial.other_end(lost)
    trial.dark(dark_s)
    assert other.engine.peers.is_dormant(lost.name)
    trial.planes.run(SOON_S)
    assert trial.is_answered()
    assert other.engine.peers.is_unlisted(lost.name)
    assert [(name, removal.reason) for name, removal in other.engine.removals.latest()] == [
        (lost.name, RemovalReason.LEASE_EXPIRED)
    ]


def test_a_request_of_the_dark_is_answered_after_it() -> None:
    trial = Trial()
    trial.lose(trial.robot)
    trial.mesh.at(25.0, lambda: asked.append(trial.ask()))
    asked: list[RequestId] = []
    trial.dark(30.0)
    trial.planes.run(SOON_S)
    assert asked[0] in {answer.request_id for answer in trial.robot.responses()}


@pytest.mark.parametrize("who", ["robot", "cloud"])
def test_a_tunnel_ends_no_request_that_may_run_once_only(who: str) -> None:
    trial = Trial(idempotent=False)
    trial.cloud.server_delay = lambda: 0.3
    lost = getattr(trial, who)
    trial.lose(lost)
    asked = []
    for _ in range(10):
        asked.append(trial.ask())
        trial.planes.run(0.05)
    trial.dark(2.0)
    assert trial.other_end(lost).engine.peers.is_dormant(lost.name)
    trial.planes.run(SOON_S)
    assert set(asked) <= {answer.request_id for answer in trial.robot.responses()}
    assert len(trial.cloud.executed) == trial.robot.sequence, "each ran once"


@pytest.mark.parametrize("dark_s", [0.0, 60.0])
@pytest.mark.parametrize("who", ["robot", "cloud"])
def test_a_clock_that_is_wrong_for_two_seconds_does_not_part_it_from_its_peers(who: str, dark_s: float) -> None:
    trial = Trial()
    lost = getattr(trial, who)
    trial.lose(lost)
    trial.dark(dark_s)
    other = trial.other_end(lost)
    right = other.own._verify

    def wrong(_: SessionCredential) -> float:
        raise CertificateError(EXPIRED, "expired 99 s ago")

    for verify in (wrong, right):
        other.own._verify = verify
        other.own.forget_admitted()
        other.engine.recheck_peers(other.engine.peers.all_refused(), trial.mesh.now)
        trial.mesh.pump(other)
        assert (lost.name in [peer.name for peer in other.engine.peers.all_held()]) is (verify is right)
        trial.planes.run(2.0)
    assert trial.is_answered()


def test_a_member_cannot_take_the_place_of_a_lost_one() -> None:
    """Without certificates: it registers with the session number that it saw."""
    trial = Trial()
    thief = trial.mesh.add("thief", Role.ROBOT, ["wlan0"], (rule(),))
    trial.lose(trial.robot)
    trial.dark(20.0)
    stolen = with_credential(replace(thief.told_to(trial.cloud), session=trial.robot.session))
    view = trial.planes.peer_sets[trial.cloud.name]
    assert trial.cloud.engine.apply_peers(replace(view, peers=(*view.peers, stolen)), trial.mesh.now) is None
    trial.mesh.pump(trial.cloud)
    trial.planes.run(SOON_S)
    assert trial.is_answered()
    assert list(trial.cloud.engine.peers.refused) == [thief.name]


def test_a_robot_comes_back_while_the_views_of_its_server_keep_changing() -> None:
    """Each of them comes before the answer to the answer to its introduction."""
    trial = Trial()
    trial.lose(trial.robot)
    for wire in trial.wires:
        wire.delay_s = 0.15
    seen = trial.planes.peer_sets[trial.cloud.name]

    def view_again() -> None:
        assert trial.cloud.engine.apply_peers(seen, trial.mesh.now) is None
        trial.mesh.pump(trial.cloud)
        trial.mesh.at(0.1, view_again)

    view_again()
    trial.dark(10.0)
    assert trial.cloud.engine.peers.is_dormant(trial.robot.name)
    trial.planes.run(SOON_S)
    assert trial.is_answered()


@pytest.mark.parametrize("seed", range(5))
def test_what_arrives_before_the_answer_that_brings_its_path_up_is_not_lost(seed: int) -> None:
    trial = Trial(seed)
    trial.lose(trial.robot)
    trial.mesh.at(9.9, lambda: asked.extend(trial.ask() for _ in range(5)))
    asked: list[RequestId] = []
    trial.dark(10.0)
    for wire in trial.wires:
        wire.jitter_s = 0.005
    trial.planes.run(0.6)
    assert set(asked) <= {answer.request_id for answer in trial.robot.responses()}


def test_a_cloud_that_drains_waits_for_a_request_of_a_dormant_robot() -> None:
    trial = Trial()
    trial.lose(trial.robot)
    trial.cloud.server_delay = lambda: 8.0
    trial.ask()
    trial.planes.run(0.5)
    trial.dark(4.0)
    assert trial.cloud.engine.peers.is_dormant(trial.robot.name)
    trial.cloud.engine.drain()
    assert trial.cloud.engine.busy == 1
    trial.planes.run(6.0)
    assert trial.robot.sequence == len(trial.robot.responses())
    assert trial.cloud.engine.busy == 0


def test_a_robot_that_restarts_in_the_dark_is_answered() -> None:
    trial = Trial()
    trial.lose(trial.robot)
    trial.dark(20.0)
    before = trial.robot.session
    view = trial.planes.peer_sets[trial.robot.name]
    trial.robot.start()
    assert trial.robot.session != before
    assert trial.robot.engine.apply_peers(view, trial.mesh.now) is None
    trial.planes.run(3 * SOON_S)
    assert trial.is_answered()
    assert trial.cloud.engine.peers.session(trial.robot.name) == trial.robot.session


@pytest.mark.parametrize("who", ["robot", "cloud"])
def test_a_dormant_peer_costs_next_to_nothing(who: str) -> None:
    trial = Trial()
    lost = getattr(trial, who)
    trial.lose(lost)
    other = trial.other_end(lost)
    lost.alive = False
    trial.planes.run(60.0)
    assert other.engine.peers.is_dormant(lost.name)
    sent = 0

    def count(source: tuple[str, int], _to: object, data: bytes) -> None:
        nonlocal sent
        sent += len(data) if source[0].startswith(other.name) else 0

    trial.mesh.tap = count
    trial.mesh.run(3600.0)
    first_hour, sent = sent, 0
    if who == "robot":
        assert first_hour == 0, "a cloud sends it nothing"
    trial.mesh.run(8 * 3600.0)
    assert sent / 8 <= first_hour / 3


def test_a_robot_asks_a_dormant_server_at_once_when_its_own_link_is_new() -> None:
    trial = Trial()
    trial.lose(trial.cloud)
    trial.dark(LONG_S)
    for link in trial.robot.links.values():
        link.execute(SetReady(ready=True), trial.mesh.now)
    trial.mesh.pump(trial.robot)
    trial.planes.run(0.5)
    assert not trial.robot.engine.peers.is_dormant(trial.cloud.name)
    assert trial.is_answered()


def test_a_listed_server_that_was_dormant_is_asked_at_once() -> None:
    trial = Trial()
    trial.lose(trial.cloud)
    trial.dark(LONG_S)
    del trial.planes.told[trial.cloud.name]
    trial.planes.join(trial.cloud)
    trial.planes.run(SOON_S)
    assert not trial.robot.engine.peers.is_dormant(trial.cloud.name)
    assert trial.is_answered()
    assert trial.robot.engine.removals.latest() == []


def test_a_new_policy_ends_what_is_dormant() -> None:
    trial = Trial(policy=Policy((CallRule(("*",), (SERVICE,), ("*",)),), EVERYBODY))
    trial.lose(trial.robot)
    trial.dark(20.0)
    assert trial.cloud.engine.peers.is_dormant(trial.robot.name)
    trial.planes.core.set_policy(Policy((CallRule(("someone",), (SERVICE,), ("*",)),), EVERYBODY), trial.mesh.now)
    trial.planes.run(SOON_S)
    assert not trial.cloud.engine.peers.is_dormant(NodeName("robot"))
    assert not trial.is_answered()
