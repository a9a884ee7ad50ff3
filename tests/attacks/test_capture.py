"""A passive capture of everything that passes the network: nothing of what is asked and answered can be read in it.

The capture is our own (packet sockets on every cable), so that it needs no tool that is not there everywhere.
"""

from __future__ import annotations

import random
import re
import zlib
from typing import TYPE_CHECKING

import pytest

from plr.sidecar.core.wire.frame import HEADER_BYTES
from tests.attacks.world import CLOUDS, World, is_ours
from tests.support.calling import Call, assert_flawless

if TYPE_CHECKING:
    from lab.attacker.wire import Captured

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(180)]

SIZE = 1000
CHUNK = 12
"""So many equal bytes are no accident."""


def test_nothing_can_be_read(world: World) -> None:
    taps = [world.tap("robot", "wlan0"), world.tap("robot", "wwan0"), *map(world.tap, (*CLOUDS, "control"))]
    frames: list[bytes] = []
    # The second run takes longer than the deadline: the robot tells the ids of requests that miss it, and of no others.
    sent = 0
    for options in (("--rate", "20", "--duration", "4"), ("--rate", "1", "--duration", "4", "--ask-delay-ms", "600")):
        call = Call(world.system, "--size", str(SIZE), *options)
        run = call.result()
        assert_flawless(run)
        sent = max(sent, run["summary"]["sent"])
    for tap in taps:
        frames += [data for data, _ in tap.frames()]
    ids = re.findall(r"\b[0-9a-f]{32}\b", world.system.parts["robot.sidecar"].log.read_text())
    assert ids, "the robot's log names requests that missed their deadline"
    wanted = [b"/echo", b"echo", b"DetectPeople", b"plr_demo_interfaces", *map(bytes.fromhex, ids)]
    rng = random.Random(1)  # the clients', by their --seed
    for _ in range(sent):
        payload = rng.randbytes(SIZE)
        wanted += [payload[start : start + CHUNK] for start in range(0, SIZE, 250)]
    everything = b"\n".join(frames)
    assert len(everything) > 2 * SIZE * sent, "the capture holds the run"
    assert [words for words in wanted if words in everything] == []


def test_sealed_is_all_but_the_header(world: World) -> None:
    """What follows the clear header does not compress: nothing in it repeats, of whatever meaning."""
    tap = world.tap("robot", "wlan0")
    with world.calls():
        seen = tap.wait_for(is_ours, 400, timeout_s=60.0)
    bodies = b"".join(one.payload[HEADER_BYTES:] for one in seen)
    assert len(zlib.compress(bodies, 9)) > 0.99 * len(bodies)
    assert {kind_of(one) for one in seen} == {"request", "short"}


def kind_of(one: Captured) -> str:
    return "request" if len(one.payload) > SIZE else "short"
