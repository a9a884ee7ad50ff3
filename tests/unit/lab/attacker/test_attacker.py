"""The attacker's tools do what they say: an attack that never leaves proves nothing."""

from __future__ import annotations

import random
import socket

import pytest

from lab.attacker.junk import JunkKind, flipped, headed, make_junk, mangled
from lab.attacker.send_many import BATCH, Volley, flood
from lab.attacker.wire import Captured, parse
from plr.sidecar.core.wire.frame import HEADER_BYTES, MAX_DATAGRAM_BYTES

REAL = [bytes(range(100)), bytes(range(200))]


@pytest.fixture
def pair() -> tuple[socket.socket, socket.socket]:
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.bind(("127.0.0.1", 0))
    receiver.settimeout(5.0)
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.connect(receiver.getsockname())
    return sender, receiver


def test_a_volley_leaves_as_it_was_laid_out(pair: tuple[socket.socket, socket.socket]) -> None:
    sender, receiver = pair
    datagrams = [b"", b"one", bytes(1200), b"last"]
    volley = Volley(datagrams)
    with sender, receiver:
        assert volley.send(sender, 0, BATCH) == 4
        assert [receiver.recv(2000) for _ in datagrams] == datagrams
        assert volley.send(sender, 3, BATCH) == 1
        assert receiver.recv(2000) == b"last"


def test_a_flood_sends_as_many_as_were_asked_for(pair: tuple[socket.socket, socket.socket]) -> None:
    sender, receiver = pair
    with sender, receiver:
        sent = flood([sender], make_junk(JunkKind.NOISE, [], 100, random.Random(1)), 5_000.0, 0.2)
    assert 500 <= sent <= 1000 + BATCH


@pytest.mark.parametrize("kind", JunkKind)
def test_junk_is_of_its_kind(kind: JunkKind) -> None:
    junk = make_junk(kind, REAL, 200, random.Random(2))
    assert len(junk) == 200
    assert all(len(one) <= MAX_DATAGRAM_BYTES for one in junk)
    assert all((one in REAL) == (kind is JunkKind.REPLAYED) for one in junk)


def test_a_flipped_datagram_differs_in_one_bit_and_a_headed_one_keeps_its_session() -> None:
    rng = random.Random(3)
    for _ in range(100):
        changed = flipped(REAL[1], rng)
        assert sum((one ^ other).bit_count() for one, other in zip(changed, REAL[1], strict=True)) == 1
        assert headed(REAL[1], rng)[: HEADER_BYTES - 8] == REAL[1][: HEADER_BYTES - 8]
        assert len(mangled(REAL[1], rng)) <= MAX_DATAGRAM_BYTES


@pytest.mark.parametrize(("one", "other"), [("192.0.2.1", "192.0.2.2"), ("2001:db8::1", "2001:db8::2")])
def test_a_captured_datagram_is_the_same_when_it_is_sent_again(one: str, other: str) -> None:
    kind = b"\x86\xdd" if ":" in one else b"\x08\x00"
    datagram = Captured("eth0", bytes(12) + kind, (one, 5), (other, 6), b"payload", False)
    assert parse("eth0", datagram.frame(), outgoing=False) == datagram
    assert parse("eth0", datagram.frame() + bytes(10), outgoing=False) == datagram, "Ethernet pads short frames"
    for size in range(len(datagram.frame())):
        parse("eth0", datagram.frame()[:size], outgoing=False)
