"""A member that changes what it announces all the time: the others are not told each time, and hear the last of it."""

from __future__ import annotations

import pytest

from plr.controlplane.core.control.events import Settings
from plr.controlplane.core.registry.registry import Refusal
from plr.controlplane.core.registry.restlessness import BYTES_BURST, BYTES_PER_S
from plr.protos.model.ids import NodeName, Role
from plr.protos.model.members import CandidateSet, PeerSet, ServiceSet
from plr.protos.model.stream import Drain
from tests.support.control_world import SimSidecar, World
from tests.support.samples import candidate, interfaces, offer, registration

pytestmark = pytest.mark.audit("sec-5")


def test_who_flaps_is_announced_every_few_seconds_and_at_last_as_it_is() -> None:
    world = World(Settings(warm_up_s=0.0))
    rogue, honest = (world.join(registration(name, Role.CLOUD)) for name in ("rogue", "honest"))
    for cloud in (rogue, honest):
        world.say(cloud, CandidateSet(interfaces("eth0")))
        world.say(cloud, ServiceSet((offer(),)))
    robot = world.robot("robot", "wlan0")
    world.run(1.0)
    before = sum(isinstance(message, PeerSet) for message in robot.received)
    for change in range(20 * 40):
        world.say(rogue, CandidateSet((candidate("eth0", port=5000 + change),)))
        world.run(0.05)
    told = sum(isinstance(message, PeerSet) for message in robot.received) - before
    assert told <= 30 + 2 * 40 / 5
    world.say(honest, CandidateSet((candidate("eth0", port=4444),)))
    world.run(0.1)
    ports = {peer.name: peer.candidates[0].address[1] for peer in robot.peers}
    assert ports[NodeName("honest")] == 4444
    world.run(10.0)
    ports = {peer.name: peer.candidates[0].address[1] for peer in robot.peers}
    assert ports[NodeName("rogue")] == 5000 + 20 * 40 - 1


def test_who_registers_again_and_again_is_announced_once_a_second() -> None:
    world = World(Settings(warm_up_s=0.0))
    rogue = world.join(registration("rogue", Role.CLOUD))
    world.say(rogue, CandidateSet(interfaces("eth0")))
    world.say(rogue, ServiceSet((offer(),)))
    robot = world.robot("robot", "wlan0")
    world.run(1.0)
    before = sum(isinstance(message, PeerSet) for message in robot.received)
    for _ in range(10 * 20):
        stream = world.core.register(rogue.registration, world.now)
        world.run(0.03)
        if isinstance(stream, Refusal):
            assert stream is Refusal.TOO_OFTEN
        else:
            world.core.receive(stream, Drain(), world.now)
        world.run(0.05)
    told = sum(isinstance(message, PeerSet) for message in robot.received) - before
    assert told <= 30 + 3 * 20


def many_offers(change: int) -> ServiceSet:
    """As much as may be offered: half a megabyte, of which one number changes."""
    return ServiceSet(tuple(offer(f"/s{number:04}{'x' * 240}", capacity=1 + change) for number in range(1024)))


def heard_bytes(robot: SimSidecar, name: str) -> int:
    """Return how many bytes of names it heard of a member's offers."""
    sets = [message for message in robot.received if isinstance(message, PeerSet)]
    return sum(
        len(one.name) + len(one.type)
        for told in sets
        for peer in told.peers
        if peer.name == name
        for one in peer.offers
    )


def budget(seconds: float) -> float:
    """When there is something left a whole list may be told, and once more that it is about to go."""
    return BYTES_BURST + 600_000 + BYTES_PER_S * seconds


def test_who_changes_a_long_list_all_the_time_costs_the_others_little_and_is_announced_as_it_is_at_last() -> None:
    world = World(Settings(warm_up_s=0.0))
    rogue = world.join(registration("rogue", Role.CLOUD))
    world.say(rogue, CandidateSet(interfaces("eth0")))
    robot = world.robot("robot", "wlan0")
    for change in range(60):
        world.say(rogue, many_offers(change))
        world.run(1.0)
    assert heard_bytes(robot, "rogue") <= budget(60.0)
    honest = world.cloud("honest")
    world.run(0.5)
    world.say(honest, CandidateSet((candidate("eth0", port=4444),)))
    world.run(0.5)
    ports = {peer.name: peer.candidates[0].address[1] for peer in robot.peers}
    assert ports[NodeName("honest")] == 4444, "others wait for nothing"
    world.say(rogue, ServiceSet((offer(),)))
    world.run(6.0)
    assert [len(peer.offers) for peer in robot.peers if peer.name == "rogue"] == [1], "nor does little of it"
    world.say(rogue, many_offers(99))
    world.run(500.0)
    assert [peer.offers[0].capacity for peer in robot.peers if peer.name == "rogue"] == [100]


def test_who_comes_and_goes_with_a_long_list_costs_the_others_no_more() -> None:
    world = World(Settings(warm_up_s=0.0))
    robot = world.robot("robot", "wlan0")
    rogue = world.join(registration("rogue", Role.CLOUD))
    world.say(rogue, CandidateSet(interfaces("eth0")))
    world.say(rogue, many_offers(0))
    for turn in range(300):
        world.run(3.0)
        run = registration("rogue", Role.CLOUD, incarnation=2 + turn // 6, token=rogue.registration.token)
        result = world.core.register(run, world.now)
        if isinstance(result, Refusal):
            continue
        rogue.stream = result
        world.say(rogue, CandidateSet(interfaces("eth0")))
        world.say(rogue, many_offers(0))
        if turn % 3 == 0:
            world.run(0.1)
            world.say(rogue, Drain())
    assert heard_bytes(robot, "rogue") <= budget(930.0)


def test_what_a_robot_says_that_it_serves_is_told_to_nobody() -> None:
    world = World(Settings(warm_up_s=0.0))
    cloud = world.cloud("cloud")
    robot = world.robot("robot", "wlan0")
    world.say(robot, many_offers(0))
    world.run(1.0)
    assert [peer.offers for peer in cloud.peers] == [()]
    (status,) = world.core.status(world.now, [NodeName("robot")])
    assert status.peer.offers == ()
    assert world.core.counters.robot_offers_ignored == 1024
