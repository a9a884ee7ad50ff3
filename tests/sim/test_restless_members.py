"""A member that changes what it announces all the time: the others are not told each time, and hear the last of it."""

from __future__ import annotations

import pytest

from controlplane.core.control_events import Settings
from controlplane.core.registry import Refusal
from protos.model import CandidateSet, Drain, NodeName, PeerSet, Role, ServiceSet
from tests.sim.control_world import World
from tests.unit.controlplane.samples import candidate, interfaces, offer, registration

pytestmark = pytest.mark.audit("sec-5")


def test_who_flaps_is_told_of_every_few_seconds_and_at_last_as_it_is() -> None:
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


def test_who_registers_again_and_again_is_told_of_once_a_second() -> None:
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
