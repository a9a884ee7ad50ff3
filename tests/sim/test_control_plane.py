"""The control plane among many sidecars, in simulated time; `control_chaos.py` tells what is checked at each step."""

from __future__ import annotations

import dataclasses
import random
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.core.control.events import Settings
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy
from plr.controlplane.core.publish.messages import CloseReason
from plr.protos.model.ids import InterfaceName, Role, Version
from plr.protos.model.members import AT_MOST_EVERY_INTERFACE, CandidateSet, Copies, InterfaceLabel, PeerSet, ServiceSet
from tests.sim.control_chaos import Chaos
from tests.support.control_world import SimSidecar, World
from tests.support.samples import interfaces, offer, registration, use

if TYPE_CHECKING:
    from plr.protos.model.mapping import MappingSet


@pytest.mark.parametrize("seed", range(12))
def test_invariants_hold_in_any_order(seed: int) -> None:
    run_and_settle(Chaos(seed))


POLICIES = (
    None,
    Policy(),
    Policy((CallRule(("*",), ("*",), ("*",)),), (OfferRule(("*",), ("*",)),)),
    Policy((CallRule(("robot-[0-3]",), ("/plan", "/detect"), ("*",)),), (OfferRule(("cloud-[0-5]",), ("*",)),)),
    Policy(
        (CallRule(("*",), ("/plan",), ("*",)), CallRule(("robot-1",), ("*",), ("*",))),
        (OfferRule(("*",), ("/[pg]*",)),),
    ),
)


@pytest.mark.parametrize("seed", range(12))
def test_they_hold_also_while_the_policy_changes(seed: int) -> None:
    run_and_settle(Chaos(seed, POLICIES))


def run_and_settle(chaos: Chaos) -> None:
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


@pytest.mark.parametrize("apart_s", [0.0, 0.3])
def test_certificates_that_end_together_end_these_streams_and_nothing_else(apart_s: float) -> None:
    """A robot's mapping changes within its lease, as a server of it goes too: there is nobody to send that to."""
    world = World()
    clouds, robots = [world.cloud(name) for name in ("a", "b")], [world.robot(name) for name in ("one", "two")]
    for robot in robots:
        world.all_up(robot, ("a", "b"))
    world.run(2.0)
    ending = (clouds[1], robots[0])
    for sidecar in ending:
        world.core.end_stream(sidecar.name, CloseReason.CERTIFICATE_ENDED, world.now)
        world.dispatch()
        world.run(apart_s)
    held = len(robots[0].received)
    world.run(world.settings.lease_s + 1.0)
    assert [sidecar.closed for sidecar in ending] == [[CloseReason.CERTIFICATE_ENDED]] * 2
    assert len(robots[0].received) == held
    assert {sidecar.name for sidecar in world.core.registry} == {"a", "two"}
    assert set(robots[1].pairs().values()) == {"a"}
    for sidecar in ending:
        sidecar.peers_version = sidecar.mapping_version = Version(0)
    # With new certificates.
    world.join(ending[0].registration)
    world.say(ending[0], CandidateSet(interfaces("eth0")))
    world.say(ending[0], ServiceSet((offer(),)))
    world.robot("one")
    world.run(2.0)
    assert robots[0].peer_names == robots[1].peer_names == {"a", "b"}
    assert set(robots[0].pairs().values()) <= {"a", "b"}


def test_labels_and_wishes_of_sidecars_decide_their_mappings() -> None:
    world = World()
    for name, region in (("cloud-a", "eu"), ("cloud-b", "eu"), ("cloud-c", "us")):
        cloud = world.join(dataclasses.replace(registration(name, Role.CLOUD), region=region))
        world.say(cloud, CandidateSet(interfaces("eth0")))
        world.say(cloud, ServiceSet((offer(),)))
    robot = world.robot("robot", copies=Copies(2, 2))
    nics = ("wlan0", "wwan0", "wwan1")
    carriers = {"wlan0": "own", "wwan0": "telekom", "wwan1": "telekom"}
    labels = tuple(InterfaceLabel(InterfaceName(nic), carrier) for nic, carrier in carriers.items())
    world.say(robot, CandidateSet(interfaces(*nics), labels))
    world.all_up(robot, ("cloud-a", "cloud-b", "cloud-c"), *nics)
    world.run(3.0)
    (mapping,) = robot.services
    assert len(mapping.assignments) == 2
    assert len({carriers[assignment.interface] for assignment in mapping.assignments}) == 2
    assert "cloud-c" in {assignment.server for assignment in mapping.assignments}
    world.say(robot, ServiceSet((), (use(copies=AT_MOST_EVERY_INTERFACE, target_miss=0.95),)))
    world.run(3.0)
    (mapping,) = robot.services
    assert len(mapping.assignments) == 1
    assert mapping.reason.startswith("least cost that meets the target")
