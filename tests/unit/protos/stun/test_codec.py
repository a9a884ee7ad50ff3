"""The STUN codec against RFC 5769's test vectors, and against what it must refuse."""

from __future__ import annotations

import hashlib
import hmac
import struct

import pytest

from plr.protos.base.errors import DecodeError
from plr.protos.stun.codec import (
    MAX_STUN_BYTES,
    MAX_UNKNOWN_ATTRIBUTES,
    MessageClass,
    StunMessage,
    decode,
    encode,
    is_stun,
)

TRANSACTION_ID = bytes.fromhex("b7e7a701bc34d686fa87dfae")
PASSWORD = b"VOkJxbRl1RmTxUk/WvJxBt"

SAMPLE_REQUEST = bytes.fromhex(
    "00010058 2112a442 b7e7a701bc34d686fa87dfae"
    "80220010 5354554e207465737420636c69656e74"
    "00240004 6e0001ff"
    "80290008 932ff9b151263b36"
    "00060009 6576746a3a68367659202020"
    "00080014 9aeaa70cbfd8cb56781ef2b5b2d3f249c1b571a2"
    "80280004 e57a3bcf"
)
"""RFC 5769 section 2.1."""

SAMPLE_IPV4_RESPONSE = bytes.fromhex(
    "0101003c 2112a442 b7e7a701bc34d686fa87dfae"
    "8022000b 7465737420766563746f7220"
    "00200008 0001a147e112a643"
    "00080014 2b91f599fd9e90c38c7489f92af9ba53f06be7d7"
    "80280004 c07d4c96"
)
"""RFC 5769 section 2.2."""

SAMPLE_IPV6_RESPONSE = bytes.fromhex(
    "01010048 2112a442 b7e7a701bc34d686fa87dfae"
    "8022000b 7465737420766563746f7220"
    "00200014 0002a1470113a9faa5d3f179bc25f4b5bed2b9d9"
    "00080014 a382954e4be67bf11784c97c8292c275bfe3ed41"
    "80280004 c8fb0b4c"
)
"""RFC 5769 section 2.3."""

LONG_TERM_REQUEST = bytes.fromhex(
    "00010060 2112a442 78ad3433c6ad72c029da412e"
    "00060012 e3839ee38388e383aae38383e382afe382b90000"
    "0015001c 662f2f3439396b39353464364f4c33346f4c394653547679363473 41".replace(" ", "")
    + "0014000b 6578616d706c652e6f726700"
    "00080014 f67024656dd64a3e02b8e0712e85c9a28ca89666"
)
"""RFC 5769 section 2.4."""


def message(body: str, kind: str = "0001", length: int | None = None) -> bytes:
    """A Binding message (request by default) with these attributes, given as hex."""
    raw = bytes.fromhex(body)
    size = struct.pack("!H", len(raw) if length is None else length)
    return bytes.fromhex(kind) + size + bytes.fromhex("2112a442") + TRANSACTION_ID + raw


@pytest.mark.parametrize("vector", [SAMPLE_REQUEST, SAMPLE_IPV4_RESPONSE, SAMPLE_IPV6_RESPONSE])
def test_the_vectors_are_transcribed_faithfully(vector: bytes) -> None:
    # MESSAGE-INTEGRITY covers all before it, with a length that ends behind it: 8 bytes of FINGERPRINT less.
    signed = bytearray(vector[:-32])
    signed[2:4] = struct.pack("!H", len(vector) - 8 - 20)
    assert hmac.new(PASSWORD, signed, hashlib.sha1).digest() == vector[-28:-8]


def test_rfc5769_sample_request() -> None:
    decoded = decode(SAMPLE_REQUEST)
    assert decoded.message_class is MessageClass.REQUEST
    assert decoded.transaction_id == TRANSACTION_ID
    assert decoded.software == "STUN test client"
    assert decoded.fingerprint
    # PRIORITY belongs to ICE, which is not spoken here; ICE-CONTROLLED may be passed over.
    assert decoded.unknown_required == (0x0024,)


@pytest.mark.parametrize(
    ("vector", "address"),
    [
        (SAMPLE_IPV4_RESPONSE, ("192.0.2.1", 32853)),
        (SAMPLE_IPV6_RESPONSE, ("2001:db8:1234:5678:11:2233:4455:6677", 32853)),
    ],
)
def test_rfc5769_sample_responses(vector: bytes, address: tuple[str, int]) -> None:
    decoded = decode(vector)
    assert decoded.message_class is MessageClass.SUCCESS
    assert decoded.transaction_id == TRANSACTION_ID
    assert decoded.software == "test vector"
    assert decoded.xor_mapped_address == address
    assert decoded.reflexive_address == address
    assert decoded.unknown_required == ()


def test_rfc5769_long_term_request_is_parsed_past_its_credentials() -> None:
    decoded = decode(LONG_TERM_REQUEST)
    assert decoded.transaction_id == bytes.fromhex("78ad3433c6ad72c029da412e")
    assert not decoded.fingerprint
    assert decoded.unknown_required == ()


def test_every_flipped_bit_of_a_fingerprinted_message_is_noticed() -> None:
    for position in range(8 * len(SAMPLE_IPV4_RESPONSE)):
        damaged = bytearray(SAMPLE_IPV4_RESPONSE)
        damaged[position // 8] ^= 1 << position % 8
        try:
            decoded = decode(bytes(damaged))
        except DecodeError:
            continue
        # The flip hid FINGERPRINT itself: then its absence is what gives it away.
        assert not decoded.fingerprint


@pytest.mark.parametrize("kind", list(MessageClass))
def test_a_message_comes_back_as_it_was_written(kind: MessageClass) -> None:
    written = StunMessage(
        kind,
        TRANSACTION_ID,
        xor_mapped_address=("203.0.113.9", 4242),
        mapped_address=("2001:db8::1", 65535),
        software="plr 0.1 ✓",
        error_code=420,
        error_reason="Unknown Attribute",
        unknown_attributes=(3, 0x7FFF),
        fingerprint=True,
    )
    assert decode(encode(written)) == written
    assert decode(memoryview(encode(written))) == written


def test_the_plain_mapped_address_serves_where_the_xored_one_is_missing() -> None:
    assert decode(message("00010008 00011092 c0000201", "0101")).reflexive_address == ("192.0.2.1", 4242)


def test_an_ipv4_mapped_address_is_told_as_ipv4() -> None:
    decoded = decode(message("00010014 00021092 00000000000000000000ffffc0000201", "0101"))
    assert decoded.mapped_address == ("192.0.2.1", 4242)


def test_only_the_first_of_a_repeated_attribute_counts() -> None:
    assert decode(message("80220004 61616161 80220004 62626262")).software == "aaaa"


def test_attributes_behind_the_integrity_are_ignored() -> None:
    decoded = decode(message("00080014" + "00" * 20 + "80220004 61616161 00240004 00000000"))
    assert decoded.software is None
    assert decoded.unknown_required == ()


def test_unknown_required_attributes_are_listed_once_and_capped() -> None:
    many = "".join(f"{0x4000 + i // 2:04x}0000" for i in range(4 * MAX_UNKNOWN_ATTRIBUTES))
    assert decode(message(many)).unknown_required == tuple(range(0x4000, 0x4000 + MAX_UNKNOWN_ATTRIBUTES))


def test_text_cannot_forge_log_lines() -> None:
    assert decode(message("80220008 610a1b5bff626364")).software == "a\ufffd\ufffd[\ufffdbcd"


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (b"", "0 bytes"),
        (message("")[:19], "19 bytes"),
        (message("80220004 61616161" * 200), "at most"),
        (message("") + b"\0", "length field 0"),
        (message("")[:-1] + b"\0\0\0\0\0", "length field 0"),
        (message("", length=4), "length field 4"),
        (message("000000", length=3), "length field 3"),
        (message("", kind="8001"), "first two bits"),
        (message("")[:4] + b"\0\0\0\0" + message("")[8:], "magic cookie"),
        (message("", kind="0003"), "Binding method"),
        (message("", kind="0000"), "Binding method"),
        (message("80220001"), "overruns"),
        (message("8022ffff 00000000"), "overruns"),
        (message("80280004 00000000"), "FINGERPRINT"),
        (message("80280000"), "FINGERPRINT"),
        (message("00200004 00010000", "0101"), "address of 4 bytes"),
        (message("00200008 00020000 00000000", "0101"), "address of 8 bytes"),
        (message("00200014 00010000" + "00" * 16, "0101"), "address of 20 bytes"),
        (message("", kind="0111"), "without ERROR-CODE"),
        (message("00090002 00000000", "0111"), "ERROR-CODE of 2"),
        (message("00090004 00000200", "0111"), "error class 2"),
        (message("00090004 00000464", "0111"), "number 100"),
        (message("000a0001 00000000", "0101"), "even number"),
        (message("802202fc" + "61" * 764), "text of 764"),
    ],
)
def test_malformed_messages_are_refused(data: bytes, complaint: str) -> None:
    with pytest.raises(DecodeError, match=complaint):
        decode(data)


def test_an_attribute_behind_the_fingerprint_is_refused() -> None:
    whole = encode(StunMessage(MessageClass.REQUEST, TRANSACTION_ID, fingerprint=True))
    longer = bytearray(whole + bytes.fromhex("80220000"))
    longer[2:4] = struct.pack("!H", len(longer) - 20)
    with pytest.raises(DecodeError):
        decode(bytes(longer))


@pytest.mark.parametrize(
    "unfit",
    [
        StunMessage(MessageClass.REQUEST, b"short"),
        StunMessage(MessageClass.REQUEST, TRANSACTION_ID, software="x" * 128),
        StunMessage(MessageClass.ERROR, TRANSACTION_ID, error_code=200),
        StunMessage(MessageClass.SUCCESS, TRANSACTION_ID, xor_mapped_address=("host.example", 1)),
        StunMessage(MessageClass.SUCCESS, TRANSACTION_ID, xor_mapped_address=("192.0.2.1", 65536)),
        StunMessage(MessageClass.ERROR, TRANSACTION_ID, error_code=420, unknown_attributes=(1,) * MAX_STUN_BYTES),
    ],
)
def test_what_does_not_fit_the_format_is_not_written(unfit: StunMessage) -> None:
    with pytest.raises(ValueError, match=r"."):
        encode(unfit)


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (SAMPLE_REQUEST, True),
        (message(""), True),
        (b"\xd1" + SAMPLE_REQUEST[1:], False),
        (b"\x40" + SAMPLE_REQUEST[1:], False),
        (SAMPLE_REQUEST[:19], False),
        (b"", False),
        (bytes(64), False),
    ],
)
def test_stun_is_told_from_other_datagrams_by_its_first_bytes(data: bytes, expected: bool) -> None:
    assert is_stun(data) is expected
    assert is_stun(memoryview(data)) is expected
