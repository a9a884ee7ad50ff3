"""What a link does not take: it is counted, nothing changes, and nothing is sent back."""

from __future__ import annotations

from typing import Any

import pytest

from plr.protos.model.ids import InterfaceId
from plr.sidecar.core.path.probing import FIRST_PROBE_S
from plr.sidecar.core.seam.links import Send
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import ProbeReply
from plr.sidecar.core.wire.introduction import Introduction
from tests.support.builders import Bench, message
from tests.unit.sidecar.core.link.test_link import (
    ELSEWHERE,
    OTHER_SESSION,
    PATH,
    PROBE,
    state_changes,
    up,
)


def good(**changes: Any) -> bytes:
    return up().datagram(PROBE, **{"number": 10, **changes})


def flipped(datagram: bytes, position: int) -> bytes:
    changed = bytearray(datagram)
    changed[position] ^= 0x10
    return bytes(changed)


BAD = {
    "garbage": (b"\xff" * 100, "malformed"),
    "empty": (b"", "malformed"),
    "truncated header": (good()[:19], "malformed"),
    "no room for a frame": (good()[:36], "malformed"),
    "another version": (b"\xd1" + good()[1:], "version"),
    "unsealed": (b"\xd3\x00" + good()[2:], "unsealed"),
    "unknown flags": (b"\xd3\x09" + good()[2:], "malformed"),
    "a frame in clear": (good()[:20] + PROBE.ljust(40, b"\0"), "unauthentic"),
    "another phase of the keys": (b"\xd3\x01" + good()[2:], "unauthentic"),
    "a changed packet number": (flipped(good(), 19), "unauthentic"),
    "a changed frame": (flipped(good(), 22), "unauthentic"),
    "a changed tag": (flipped(good(), -1), "unauthentic"),
    "cut short": (good()[:-1], "unauthentic"),
    "lengthened": (good() + b"\0", "unauthentic"),
    "good frame then garbage": (up().datagram(PROBE, b"\xff", number=10), "malformed"),
    "wrong interface": (good(receiver=InterfaceId(4)), "wrong_interface"),
    "unknown interface of the peer": (good(interface=InterfaceId(8)), "unknown_path"),
    "unknown session": (good(session=OTHER_SESSION), "unknown_session"),
    "unknown session, no room for a frame": (good(session=OTHER_SESSION)[:36], "unknown_session"),
    "a stranger's introduction": (Bench().introduction(token=bytes(16), session=OTHER_SESSION), "unknown_introducer"),
    "an introduction cut short": (Bench().introduction()[:60], "unauthentic"),
    "an introduction of nearly nothing": (Bench().introduction()[:37], "unauthentic"),
    "a peer's introduction from before its restart": (
        Bench().introduction(session=OTHER_SESSION, incarnation=1),
        "old_introduction",
    ),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_datagrams_are_counted_and_provoke_nothing(kind: str) -> None:
    datagram, reason = BAD[kind]
    bench = up()
    bench.receive_datagram(datagram, ELSEWHERE)
    assert bench.link.stats.dropped == {reason: 1}
    assert bench.events() == []
    assert bench.sent() == []
    bench.receive(PROBE)
    assert bench.frames(bench.sent()) == [ProbeReply(1)], "the others are still served"


def test_a_duplicate_is_dropped_and_not_answered_again() -> None:
    bench = up()
    for _ in range(3):
        bench.receive(PROBE, number=10)
    assert bench.link.stats.dropped["duplicate"] == 2
    assert bench.frames(bench.sent()) == [ProbeReply(1)]


def test_an_unasked_probe_reply_brings_nothing_up() -> None:
    bench = Bench()
    bench.sent()
    bench.receive(frame.encode_probe_reply(ProbeReply(77)))
    assert state_changes(bench) == []
    assert bench.link.stats.dropped["unasked_probe_reply"] == 1


def test_acknowledging_the_unsent_is_counted_and_changes_nothing() -> None:
    bench, outbound = up(), message()
    bench.execute(Send(PATH, outbound))
    bench.sent()
    bench.receive(frame.encode_ack([(0, 10**6)], 0.0))
    assert bench.link.stats.dropped["acks_the_unsent"] == 1
    assert bytes(outbound.acked) == b"\0\0\0"


def test_a_flood_of_probes_is_answered_in_fewer_bytes_than_it_has() -> None:
    bench = up()
    before = bench.link.stats.bytes.copy()
    for number in range(100, 200):
        bench.receive(PROBE * frame.MAX_FRAMES, number=number)
        bench.sent()
    flood = bench.link.stats.bytes
    assert flood["sent"] - before["sent"] <= flood["received"] - before["received"]


def test_a_flood_to_a_path_that_is_down_provokes_few_probes() -> None:
    bench = Bench()
    bench.wait(10.0)
    introductions = 0
    start = bench.now
    for number in range(1000):
        bench.now += 0.0001
        bench.receive(PROBE, number=number)
        introductions += sum(isinstance(item, Introduction) for item in bench.frames(bench.sent()))
    assert 1 <= introductions <= (bench.now - start) / FIRST_PROBE_S + 1


def test_owed_frames_are_capped() -> None:
    bench = up()
    for number in range(10, 60):
        bench.receive(PROBE * 60, number=number)
    assert bench.link.stats.dropped["pending_frames_full"] == 50 * 60 - 256
    assert len(bench.frames(bench.sent())) == 256
