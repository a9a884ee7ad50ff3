"""What a listener on the way can do with the datagrams it sees: nothing, and each attempt is counted.

Every test sends to the robot and to a cloud, while requests go on.
"""

from __future__ import annotations

import random
import time
from typing import TYPE_CHECKING

import pytest

from lab.attacker.junk import flipped, headed, mangled
from tests.attacks.world import ATTACKER, World, is_ours, send_all

if TYPE_CHECKING:
    from lab.attacker.wire import Captured

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(180)]

COUNT = 100
INLINE_S = 4.0
HELD_S = 0.03
VICTIMS = ("cloud_a", "robot")


@pytest.fixture(params=VICTIMS)
def victim(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


def test_replayed(world: World, victim: str) -> None:
    tap = world.tap(victim)
    with world.calls():
        seen = world.towards(tap, COUNT)
        before = world.refusals(victim)
        send_all(tap, seen)
        world.wait_until_refused(victim, before, COUNT, "duplicate")


def test_replayed_in_another_order_much_later(world: World, victim: str) -> None:
    tap = world.tap(victim)
    with world.calls():
        seen = world.towards(tap, COUNT)
        world.towards(tap, 2 * COUNT)
        before = world.refusals(victim)
        random.Random(1).shuffle(seen)
        send_all(tap, seen)
        world.wait_until_refused(victim, before, COUNT, "duplicate")


def test_every_datagram_doubled_and_out_of_order(world: World) -> None:
    """Nothing reaches the cloud but by the attacker's hand, who holds it back, shuffles it and sends it twice."""
    tap, rng = world.tap("cloud_a"), random.Random(7)
    address = {world.lab.host("cloud_a").address(family=family) for family in (4, 6)}
    with world.calls(), world.roads_from("robot") as roads:
        model = world.towards(tap, 1)[0]
        before = world.refusals("cloud_a")
        passed = 0
        with world.nothing_reaches(tap):
            end = time.monotonic() + INLINE_S
            while time.monotonic() < end:
                taken = [one for road in roads for one in road.take() if one.destination[0] in address]
                held = [one._replace(ethernet=model.ethernet) for one in taken]
                passed += sum(map(is_ours, held))
                held *= 2
                rng.shuffle(held)
                send_all(tap, held)
                time.sleep(HELD_S)
        assert passed > COUNT
        world.wait_until_refused("cloud_a", before, passed, "duplicate", "old_introduction")


def test_one_bit_flipped(world: World, victim: str) -> None:
    tap, rng = world.tap(victim), random.Random(2)
    with world.calls():
        seen = world.towards(tap, COUNT)
        before = world.refusals(victim)
        send_all(tap, [one._replace(payload=flipped(one.payload, rng)) for one in seen])
        world.wait_until_refused(victim, before, COUNT)


def test_header_kept_and_content_forged(world: World, victim: str) -> None:
    """Live session, interface numbers, and packet numbers that come next: the tag is what is missing."""
    tap, rng = world.tap(victim), random.Random(3)
    with world.calls():
        seen = world.towards(tap, COUNT)
        before = world.refusals(victim)
        forged = [headed(one.payload, rng).ljust(60, b"x") for one in seen]
        send_all(tap, [one._replace(payload=payload) for one, payload in zip(seen, forged, strict=True)])
        world.wait_until_refused(victim, before, COUNT * 9 // 10, "unauthentic", "malformed")


def test_cut_and_stretched(world: World, victim: str) -> None:
    tap, rng = world.tap(victim), random.Random(4)
    with world.calls():
        seen = world.towards(tap, COUNT)
        before = world.refusals(victim)
        payloads = [mangled(one.payload, rng)[:1400] for one in seen]
        changed = [one._replace(payload=new) for one, new in zip(seen, payloads, strict=True) if new != one.payload]
        send_all(tap, changed)
        # What is left of some is not ours, or STUN's: counted under other names.
        world.wait_until_refused(victim, before, len(changed) // 2)


def test_reflected(world: World, victim: str) -> None:
    """What a sidecar sent comes back to it, as if from its peer."""
    tap = world.tap(victim)
    with world.calls():
        sent = tap.wait_for(lambda one: not one.outgoing and is_ours(one), COUNT)
        outgoing = world.towards(tap, 1)[0]
        before = world.refusals(victim)
        send_all(tap, [back(one, outgoing) for one in sent])
        world.wait_until_refused(victim, before, COUNT)


def back(one: Captured, model: Captured) -> Captured:
    """The datagram turned round; `model` is one that goes to where this came from."""
    return model._replace(source=one.destination, destination=one.source, payload=one.payload)


def test_sent_from_another_address(world: World, victim: str) -> None:
    """Copies with the attacker's source address move nothing: not one answer goes there."""
    tap = world.tap(victim)
    world.tap(ATTACKER)
    rng = random.Random(5)
    with world.calls():
        seen = [world.from_attacker(one) for one in world.towards(tap, COUNT)]
        before = world.refusals(victim)
        send_all(tap, seen + [one._replace(payload=headed(one.payload, rng)) for one in seen])
        world.wait_until_refused(victim, before, COUNT, "duplicate")
        world.wait_until_refused(victim, before, 2 * COUNT)
        world.towards(tap, COUNT)
    assert world.answers_to_attacker() == []


def test_a_stranger_gets_no_answer(world: World, victim: str) -> None:
    """Nothing that is not authentic is answered, so nothing can be amplified: also not what asks for an answer."""
    tap = world.tap(victim)
    world.tap(ATTACKER)
    rng = random.Random(6)
    with world.calls():
        model = world.towards(tap, 1)[0]
        mine = world.from_attacker(model)
        before = world.refusals(victim)
        junk = [bytes([0xD0 | rng.randrange(16)]) + rng.randbytes(rng.randrange(1300)) for _ in range(COUNT)]
        send_all(tap, [mine._replace(payload=payload) for payload in junk])
        world.wait_until_refused(victim, before, COUNT)
        world.towards(tap, COUNT)
    assert world.answers_to_attacker() == []


def test_replayed_into_a_new_session(world: World) -> None:
    """Everything a run sent, its introductions too, played again to its peer after its restart."""
    tap = world.tap("cloud_a")
    before_restart = world.system.parts["robot.sidecar"]
    with world.calls():
        seen = world.towards(tap, COUNT)
    world.end_calls()
    assert before_restart.terminate() == 0
    before_restart.log.unlink()
    world.system.wait_for_offer(world.start_robot())
    seen += [one for one in tap.take() if one.outgoing and is_ours(one)][:COUNT]
    with world.calls():
        before = world.refusals("cloud_a")
        send_all(tap, seen[:COUNT])
        world.wait_until_refused("cloud_a", before, COUNT)
