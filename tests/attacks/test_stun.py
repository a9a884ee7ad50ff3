"""STUN is answered before anybody is authentic: what an attacker makes of that stays small, and harms nobody else.

The control plane answers questions whose source may be forged; a robot hears answers that may be.
"""

from __future__ import annotations

import random
import time
from typing import TYPE_CHECKING

import pytest

from lab.attacker.wire import Captured
from lab.system import STUN_PORT
from plr.controlplane.core.stun.source_limits import ANSWERS_BURST, ANSWERS_PER_S
from plr.protos.stun.codec import MessageClass, StunMessage, decode, encode, is_stun
from tests.attacks.world import ATTACKER, ATTACKERS_PORT, World, is_ours, send_all

if TYPE_CHECKING:
    from lab.attacker.wire import Tap
    from plr.protos.model.ids import Address

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(180)]

QUESTIONS = 3000
ANSWERS = 300
QUESTION = encode(StunMessage(MessageClass.REQUEST, bytes(range(12))))
EXTRA_BYTES = 12
"""An answer over IPv4 is so much longer than its question (responder.py)."""
OUTCOMES = "plr_stun_datagrams_total"
UNASKED = "stun_unknown_transaction"


def ethernet_of(tap: Tap) -> bytes:
    """The Ethernet header of what passes a tap on its way to the host, whatever that is."""
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        for data, outgoing in tap.frames():
            if outgoing:
                return data[:14]
        time.sleep(0.01)
    raise AssertionError(f"nothing leaves by {tap.interface}")


def ask(world: World, host: str) -> Address | None:
    """Ask the control plane from a host which address it is seen under."""
    with world.lab.host(host).socket() as sock:
        sock.settimeout(5.0)
        sock.sendto(QUESTION, (world.lab.host("control").address(), STUN_PORT))
        return decode(sock.recv(2048)).xor_mapped_address


@pytest.mark.parametrize("whose", [ATTACKER, "cloud_b"], ids=["its own address", "the address of another"])
def test_a_flood_of_questions(world: World, whose: str) -> None:
    """Whoever it claims to come from gets few answers, and others get theirs meanwhile."""
    tap, victim = world.tap("control"), world.tap(whose)
    source = (world.lab.host(whose).address(), ATTACKERS_PORT)
    question = Captured(
        tap.interface,
        ethernet_of(tap),
        source,
        (world.lab.host("control").address(), STUN_PORT),
        QUESTION,
        outgoing=True,
    )
    held_back = world.control_counter(OUTCOMES, outcome="too_often")
    with world.calls():
        began = time.monotonic()
        send_all(tap, [question] * QUESTIONS)
        assert ask(world, "cloud_a") is not None
        took_s = time.monotonic() - began
    allowed = ANSWERS_BURST + ANSWERS_PER_S * (took_s + 1.0)
    assert allowed < QUESTIONS / 2, "the flood was none"
    world.wait_until_counted(OUTCOMES, held_back + QUESTIONS - allowed, outcome="too_often")
    answers = [one for one in victim.take() if one.outgoing and one.destination == source and is_stun(one.payload)]
    assert 0 < len(answers) <= allowed
    assert max(len(one.payload) for one in answers) <= len(QUESTION) + EXTRA_BYTES


def test_answers_that_nobody_asked_for(world: World) -> None:
    """They name the attacker's address, from the STUN server's own: the robot is told nothing, and moves nowhere."""
    tap, rng = world.tap("robot"), random.Random(1)
    world.tap(ATTACKER)
    with world.calls():
        model = tap.wait_for(lambda one: one.outgoing and is_ours(one))[0]
        family = 6 if ":" in model.destination[0] else 4
        mine = (world.lab.host(ATTACKER).address(family=family), ATTACKERS_PORT)
        known, before = world.counter("cloud_a", "plr_peers_version"), stun_drops(world)
        forged = [
            model._replace(
                source=(world.lab.host("control").address(family=family), STUN_PORT),
                payload=encode(StunMessage(MessageClass.SUCCESS, rng.randbytes(12), xor_mapped_address=mine)),
            )
            for _ in range(ANSWERS)
        ]
        send_all(tap, forged)
        world.system.wait("the robot to count them", lambda: stun_drops(world) >= before + ANSWERS)
        world.towards(tap, ANSWERS)
    assert world.counter("cloud_a", "plr_peers_version") == known, "nothing new of the robot was told"
    assert world.answers_to_attacker() == []


def stun_drops(world: World) -> float:
    return world.counter("robot", "plr_datagrams_dropped_total", reason=UNASKED)
