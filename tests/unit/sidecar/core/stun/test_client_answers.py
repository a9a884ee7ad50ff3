"""Whom the STUN client believes, and what."""

from __future__ import annotations

import pytest

from plr.protos.stun.codec import MessageClass, StunMessage, decode, encode
from plr.sidecar.core.stun.events import Failed, Mapped, StunDrop
from tests.unit.sidecar.stun_network import (
    MOVED,
    OUTSIDE,
    A,
    Address,
    B,
    make,
    refusal,
    reply,
    start,
)


def test_an_error_response_hands_over_to_the_next_server_at_once() -> None:
    client = make(A, B)
    request = start(client)
    assert client.receive_datagram(refusal(request), A, 0.1)
    ((second, server),) = client.datagrams_to_send()
    assert server == B
    assert second != request
    client.receive_datagram(refusal(second, 420), B, 0.2)
    assert client.next_event() == Failed(4, "192.0.2.2:3478 answered 420 Busy", None)


def test_strangers_are_counted_and_not_believed() -> None:
    client = make(A)
    request = start(client)
    true_answer = reply(request, OUTSIDE)
    forged = bytearray(true_answer)
    forged[-1] ^= 1
    assert client.receive_datagram(bytes(forged), A, 0.1)
    assert client.receive_datagram(true_answer, B, 0.1)
    assert client.receive_datagram(true_answer, (A[0], 3479), 0.1)
    assert client.receive_datagram(request, A, 0.1)
    another = StunMessage(MessageClass.SUCCESS, bytes(12), xor_mapped_address=MOVED)
    assert client.receive_datagram(encode(another), A, 0.1)
    assert client.next_event() is None
    assert client.drops == {
        StunDrop.MALFORMED: 1,
        StunDrop.WRONG_SOURCE: 2,
        StunDrop.NOT_A_RESPONSE: 1,
        StunDrop.UNKNOWN_TRANSACTION: 1,
    }
    # None of them spoilt the transaction for the real server.
    assert client.receive_datagram(true_answer, A, 0.2)
    assert client.next_event() == Mapped(4, OUTSIDE, A)
    assert client.receive_datagram(true_answer, A, 0.3), "a duplicate is consumed"
    assert client.next_event() is None
    assert client.drops[StunDrop.UNKNOWN_TRANSACTION] == 2


@pytest.mark.parametrize(
    ("address", "drop"),
    [
        (None, StunDrop.NO_ADDRESS),
        (("203.0.113.5", 0), StunDrop.BAD_ADDRESS),
        (("0.0.0.0", 61000), StunDrop.BAD_ADDRESS),
        (("224.0.0.1", 61000), StunDrop.BAD_ADDRESS),
    ],
)
def test_an_answer_without_a_usable_address_fails(address: Address | None, drop: StunDrop) -> None:
    client = make(A)
    answer = StunMessage(MessageClass.SUCCESS, decode(start(client)).transaction_id, xor_mapped_address=address)
    client.receive_datagram(encode(answer), A, 0.1)
    assert client.next_event() == Failed(4, "192.0.2.1:3478 answered without a usable address", None)
    assert client.drops == {drop: 1}


def test_an_answer_with_unknown_required_attributes_fails() -> None:
    client = make(A)
    answer = bytearray(encode(StunMessage(MessageClass.SUCCESS, decode(start(client)).transaction_id)))
    answer[2:] = b"\x00\x04" + answer[4:] + bytes.fromhex("7fff0000")
    client.receive_datagram(bytes(answer), A, 0.1)
    assert client.next_event() == Failed(4, "192.0.2.1:3478 answered with unknown attributes", None)
    assert client.drops == {StunDrop.UNKNOWN_ATTRIBUTE: 1}


def test_datagrams_of_the_mesh_are_left_to_others() -> None:
    client = make(A)
    start(client)
    assert not client.receive_datagram(b"\xd1" + bytes(100), A, 0.1)
    assert not client.receive_datagram(b"", A, 0.1)
    assert not client.drops
