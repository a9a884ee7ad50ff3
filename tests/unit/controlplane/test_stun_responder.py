"""What the STUN responder answers, and what it keeps silent about."""

from __future__ import annotations

from collections import Counter

import pytest

from controlplane.core.stun_responder import StunOutcome, respond
from protos.stun import MessageClass, StunMessage, decode, encode

TRANSACTION_ID = bytes(range(12))
SOURCE = ("198.51.100.7", 40000)


def request(message_class: MessageClass = MessageClass.REQUEST, *, fingerprint: bool = False) -> bytes:
    code = 400 if message_class is MessageClass.ERROR else None
    return encode(StunMessage(message_class, TRANSACTION_ID, error_code=code, fingerprint=fingerprint))


def with_attribute(attribute: bytes) -> bytes:
    plain = request()
    return plain[:2] + len(attribute).to_bytes(2, "big") + plain[4:] + attribute


@pytest.mark.parametrize("source", [SOURCE, ("2001:db8::7", 40000)])
@pytest.mark.parametrize("fingerprint", [False, True])
def test_a_binding_request_is_answered_with_its_source(source: tuple[str, int], fingerprint: bool) -> None:
    outcomes: Counter[StunOutcome] = Counter()
    response = respond(request(fingerprint=fingerprint), source, outcomes, software="plr")
    assert response is not None
    assert decode(response) == StunMessage(
        MessageClass.SUCCESS,
        TRANSACTION_ID,
        xor_mapped_address=source,
        software="plr",
        fingerprint=fingerprint,
    )
    assert outcomes == {StunOutcome.ANSWERED: 1}


@pytest.mark.parametrize(("source", "growth"), [(SOURCE, 12), (("2001:db8::7", 40000), 24)])
def test_an_answer_is_longer_than_its_request_by_the_address_only(source: tuple[str, int], growth: int) -> None:
    for fingerprint in (False, True):
        asked = request(fingerprint=fingerprint)
        response = respond(asked, source, Counter())
        assert response is not None
        assert len(response) - len(asked) == growth


def test_an_extension_not_spoken_is_refused_by_name() -> None:
    outcomes: Counter[StunOutcome] = Counter()
    change_request = bytes.fromhex("00030004 00000006")
    response = respond(with_attribute(change_request), SOURCE, outcomes)
    assert response is not None
    refusal = decode(response)
    assert (refusal.message_class, refusal.error_code) == (MessageClass.ERROR, 420)
    assert refusal.unknown_attributes == (3,)
    assert refusal.transaction_id == TRANSACTION_ID
    assert outcomes == {StunOutcome.REFUSED: 1}


def test_an_optional_extension_is_passed_over() -> None:
    outcomes: Counter[StunOutcome] = Counter()
    assert respond(with_attribute(bytes.fromhex("80290008 0102030405060708")), SOURCE, outcomes) is not None
    assert outcomes == {StunOutcome.ANSWERED: 1}


@pytest.mark.parametrize(
    ("data", "source", "outcome"),
    [
        (b"", SOURCE, StunOutcome.NOT_STUN),
        (b"\xd1" + bytes(60), SOURCE, StunOutcome.NOT_STUN),
        (request()[:-1], SOURCE, StunOutcome.NOT_STUN),
        (request() + b"\0", SOURCE, StunOutcome.MALFORMED),
        (b"\x00\x03" + request()[2:], SOURCE, StunOutcome.MALFORMED),
        (with_attribute(bytes.fromhex("80280004 00000000")), SOURCE, StunOutcome.MALFORMED),
        (request(MessageClass.INDICATION), SOURCE, StunOutcome.NOT_A_REQUEST),
        (request(MessageClass.SUCCESS), SOURCE, StunOutcome.NOT_A_REQUEST),
        (request(MessageClass.ERROR), SOURCE, StunOutcome.NOT_A_REQUEST),
        (request(), ("198.51.100.7", 0), StunOutcome.BAD_SOURCE),
    ],
)
def test_anything_else_gets_silence_and_a_count(data: bytes, source: tuple[str, int], outcome: StunOutcome) -> None:
    outcomes: Counter[StunOutcome] = Counter()
    assert respond(data, source, outcomes) is None
    assert outcomes == {outcome: 1}
