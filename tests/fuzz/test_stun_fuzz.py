"""Whatever the network brings, the STUN parser gives a value or DecodeError, and the cores above it stand."""

from __future__ import annotations

import random
import struct
from ipaddress import IPv4Address, IPv6Address

from hypothesis import given
from hypothesis import strategies as st

from plr.controlplane.core.stun.responder import StunOutcome, StunResponder
from plr.protos.base.errors import DecodeError
from plr.protos.stun.codec import (
    HEADER_BYTES,
    MAX_TEXT_CHARACTERS,
    Attribute,
    MessageClass,
    StunMessage,
    decode,
    encode,
    is_stun,
)
from plr.sidecar.core.stun.client import StunClient

COOKIE = bytes.fromhex("2112a442")

printable = st.text(st.characters(exclude_categories=["C", "Z"]), max_size=MAX_TEXT_CHARACTERS)
ips = st.one_of(
    st.integers(0, 2**32 - 1).map(lambda n: str(IPv4Address(n))),
    st.integers(0, 2**128 - 1).map(IPv6Address).filter(lambda ip: ip.ipv4_mapped is None).map(str),
)
addresses = st.tuples(ips, st.integers(0, 65535))
messages = st.builds(
    StunMessage,
    message_class=st.sampled_from([MessageClass.REQUEST, MessageClass.INDICATION, MessageClass.SUCCESS]),
    transaction_id=st.binary(min_size=12, max_size=12),
    xor_mapped_address=st.none() | addresses,
    mapped_address=st.none() | addresses,
    software=st.none() | printable,
    unknown_attributes=st.lists(st.integers(0, 65535), max_size=8).map(tuple),
    fingerprint=st.booleans(),
)
attributes = st.tuples(st.sampled_from([int(a) for a in Attribute]) | st.integers(0, 65535), st.binary(max_size=24))


@st.composite
def well_framed(draw: st.DrawFn) -> bytes:
    """A plausible header and attributes with any content, some of whose lengths lie."""
    body = b""
    for kind, value in draw(st.lists(attributes, max_size=8)):
        length = draw(st.just(len(value)) | st.integers(0, 65535))
        body += struct.pack("!HH", kind, length) + value + bytes(-len(value) % 4)
    kind = draw(st.sampled_from([0x0001, 0x0011, 0x0101, 0x0111]) | st.integers(0, 65535))
    return struct.pack("!HH", kind, len(body)) + COOKIE + draw(st.binary(min_size=12, max_size=12)) + body


datagrams = st.binary(max_size=200) | well_framed()


@given(messages)
def test_encode_then_decode_gives_the_message_back(message: StunMessage) -> None:
    data = encode(message)
    assert is_stun(data)
    assert decode(data) == message


@given(datagrams)
def test_decode_gives_a_message_or_its_one_error(data: bytes) -> None:
    try:
        message = decode(data)
    except DecodeError:
        return
    assert is_stun(data)
    assert message.transaction_id == data[8:HEADER_BYTES]


@given(messages, st.data())
def test_a_cut_message_is_refused(message: StunMessage, data: st.DataObject) -> None:
    whole = encode(message)
    cut = whole[: data.draw(st.integers(0, len(whole) - 1))]
    try:
        decode(cut)
    except DecodeError:
        return
    raise AssertionError(f"decoded {len(cut)} of {len(whole)} bytes")


@given(datagrams, addresses)
def test_the_responder_stands_and_never_amplifies(data: bytes, source: tuple[str, int]) -> None:
    responder = StunResponder(0.0)
    response = responder.respond(data, source, 0.0)
    outcomes = responder.outcomes
    assert outcomes.total() == 1
    answered = outcomes[StunOutcome.ANSWERED] + outcomes[StunOutcome.REFUSED]
    assert (response is not None) == bool(answered)
    if response is not None:
        assert decode(response).transaction_id == data[8:HEADER_BYTES]
        assert len(response) <= len(data) + 32


@given(st.lists(datagrams, max_size=5), st.lists(well_framed(), max_size=5), st.integers())
def test_the_client_stands_and_believes_no_stranger(noise: list[bytes], framed: list[bytes], seed: int) -> None:
    server = ("192.0.2.1", 3478)
    client = StunClient([server], random.Random(seed))
    client.start(0.0)
    ((request, _),) = client.datagrams_to_send()
    for data in noise + framed:
        assert client.receive_datagram(data, server, 0.1) is is_stun(data)
    assert client.next_event() is None
    assert client.mapping(4) is None
    # With the right transaction id anything may end the transaction, but nothing may break the client.
    for data in framed:
        client.receive_datagram(data[:8] + request[8:HEADER_BYTES] + data[HEADER_BYTES:], server, 0.2)
        client.handle_timer(0.2)
    assert client.next_timer() is not None
