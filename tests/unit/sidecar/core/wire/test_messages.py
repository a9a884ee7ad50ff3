from __future__ import annotations

import pytest

from plr.protos.base.errors import DecodeError, UnknownKindError
from plr.protos.convert.fields import MAX_CRL_BYTES
from plr.protos.model.ids import ServiceName
from plr.sidecar.core.base.values import Priority, RejectReason, RequestId
from plr.sidecar.core.wire.messages import (
    MAX_PAYLOAD_BYTES,
    MAX_TEXT_BYTES,
    CancelMessage,
    Message,
    RejectionMessage,
    RequestMessage,
    ResponseMessage,
    RevocationLists,
    RevocationsHeld,
    RevocationsWanted,
    decode_message,
    encode_message,
    request_bytes,
)

ID = RequestId(bytes(range(16)))
GOLDENS: dict[str, tuple[Message, str]] = {
    "request": (
        RequestMessage(ID, 2, Priority.LOW, 0.1, 1.5, ServiceName("/a"), "t", b"xyz"),
        "01" + ID.hex() + "02 02 000186a0 0016e360 0002 2f61 0001 74 78797a",
    ),
    "response": (ResponseMessage(ID, 1, 0.25, b"xyz"), "02" + ID.hex() + "01 0003d090 78797a"),
    "rejection": (
        RejectionMessage(ID, 0, RejectReason.OVERLOADED, "full"),
        "03" + ID.hex() + "00 04 0004 66756c6c",
    ),
    "cancel": (CancelMessage(ID), "04" + ID.hex() + "00"),
    "held": (RevocationsHeld({1: 7, 2: 2**70}), "05 02 0000000000000001 0000000000000007 0000000000000002" + "ff" * 8),
    "wanted": (RevocationsWanted({}), "06 00"),
    "lists": (RevocationLists(b"PEM"), "07 50454d"),
}


@pytest.mark.parametrize("kind", GOLDENS)
def test_the_bytes_of_each_message(kind: str) -> None:
    message, golden = GOLDENS[kind]
    encoded = b"".join(encode_message(message))
    assert encoded == bytes.fromhex(golden)
    if kind == "held":  # a number too long is told as the largest
        message = RevocationsHeld({1: 7, 2: 2**64 - 1})
    assert decode_message(memoryview(encoded)) == message


@pytest.mark.parametrize("kind", GOLDENS)
def test_a_message_cut_within_its_head_is_refused(kind: str) -> None:
    encoded = b"".join(encode_message(GOLDENS[kind][0]))
    head = len(encoded) - (3 if kind in ("request", "response", "lists") else 0)
    for length in range(head):
        with pytest.raises(DecodeError):
            decode_message(memoryview(encoded[:length]))


def test_other_kinds_reasons_and_text_are_refused() -> None:
    for bad in (
        "05" + "11" + 17 * 16 * "00",
        "05" + "01" + 15 * "00",
        "06" + "01" + 17 * "00",
        "05",
        "01" + ID.hex() + "00 00 00000000 00000000 0001 ff 0000",
        "01" + ID.hex() + "00 03 00000000 00000000 0001 61 0000",
    ):
        with pytest.raises(DecodeError):
            decode_message(memoryview(bytes.fromhex(bad)))


@pytest.mark.audit("ops-10")
def test_what_only_a_newer_sidecar_knows_is_told_from_what_is_broken() -> None:
    with pytest.raises(UnknownKindError, match="kind 8: the sender is newer"):
        decode_message(memoryview(bytes.fromhex("08" + ID.hex() + "00")))
    refused = decode_message(memoryview(bytes.fromhex("03" + ID.hex() + "00 ff 0000")))
    assert isinstance(refused, RejectionMessage)
    assert not refused.reason.certainly_not_run, "it may have run there, and must not run elsewhere"


def test_a_payload_over_the_limit_is_refused() -> None:
    whole = b"".join(encode_message(ResponseMessage(ID, 0, 0.0, bytes(MAX_PAYLOAD_BYTES))))
    assert isinstance(decode_message(memoryview(whole)), ResponseMessage)
    with pytest.raises(DecodeError, match="limit"):
        decode_message(memoryview(whole + b"\0"))


def test_lists_over_the_limit_are_refused() -> None:
    whole = bytes((7,)) + bytes(MAX_CRL_BYTES)
    assert isinstance(decode_message(memoryview(whole)), RevocationLists)
    with pytest.raises(DecodeError, match="limit"):
        decode_message(memoryview(whole + b"\0"))


def test_a_rejection_carries_any_text_cut_to_its_limit() -> None:
    for text in ("\u00fc" * MAX_TEXT_BYTES, "lone surrogate \udc80", "x" * 10_000):
        decoded = decode_message(
            memoryview(b"".join(encode_message(RejectionMessage(ID, 0, RejectReason.BAD_PAYLOAD, text))))
        )
        assert isinstance(decoded, RejectionMessage)
        assert decoded.text[:10] == text[:10].replace("\udc80", "?")
        assert len(decoded.text) <= MAX_TEXT_BYTES


def test_times_out_of_range_are_cut() -> None:
    for seconds, told in ((-1.0, 0.0), (1e12, 0xFFFFFFFF / 1e6)):
        decoded = decode_message(memoryview(b"".join(encode_message(ResponseMessage(ID, 0, seconds, b"")))))
        assert isinstance(decoded, ResponseMessage)
        assert decoded.processing_s == told


def test_the_length_of_a_request_is_known_before_it_is_encoded() -> None:
    for service, kind, payload in (("/a", "t", b""), ("/\u00fc", "long/srv/Type", bytes(1000))):
        message = RequestMessage(ID, 3, Priority.LOW, 0.1, 1.5, ServiceName(service), kind, payload)
        assert request_bytes(ServiceName(service), kind, len(payload)) == encode_message(message).size
