"""What the STUN responder answers, and what it keeps silent about."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plr.controlplane.core.stun.responder import StunOutcome, StunResponder
from plr.controlplane.core.stun.source_limits import ANSWERS_BURST, ANSWERS_PER_S
from plr.protos.stun.codec import MessageClass, StunMessage, decode, encode

TRANSACTION_ID = bytes(range(12))
SOURCE = ("198.51.100.7", 40000)
NOW = 100.0


def request(message_class: MessageClass = MessageClass.REQUEST, *, fingerprint: bool = False) -> bytes:
    code = 400 if message_class is MessageClass.ERROR else None
    return encode(StunMessage(message_class, TRANSACTION_ID, error_code=code, fingerprint=fingerprint))


def with_attribute(attribute: bytes) -> bytes:
    plain = request()
    return plain[:2] + len(attribute).to_bytes(2, "big") + plain[4:] + attribute


@pytest.mark.parametrize("source", [SOURCE, ("2001:db8::7", 40000)])
@pytest.mark.parametrize("fingerprint", [False, True])
def test_a_binding_request_is_answered_with_its_source(source: tuple[str, int], fingerprint: bool) -> None:
    responder = StunResponder(NOW, software="plr")
    response = responder.respond(request(fingerprint=fingerprint), source, NOW)
    assert response is not None
    assert decode(response) == StunMessage(
        MessageClass.SUCCESS,
        TRANSACTION_ID,
        xor_mapped_address=source,
        software="plr",
        fingerprint=fingerprint,
    )
    assert responder.outcomes == {StunOutcome.ANSWERED: 1}


@pytest.mark.parametrize(("source", "growth"), [(SOURCE, 12), (("2001:db8::7", 40000), 24)])
def test_an_answer_is_longer_than_its_request_by_the_address_only(source: tuple[str, int], growth: int) -> None:
    for fingerprint in (False, True):
        asked = request(fingerprint=fingerprint)
        response = StunResponder(NOW).respond(asked, source, NOW)
        assert response is not None
        assert len(response) - len(asked) == growth


def test_an_extension_not_spoken_is_refused_by_name() -> None:
    responder = StunResponder(NOW)
    change_request = bytes.fromhex("00030004 00000006")
    response = responder.respond(with_attribute(change_request), SOURCE, NOW)
    assert response is not None
    refusal = decode(response)
    assert (refusal.message_class, refusal.error_code) == (MessageClass.ERROR, 420)
    assert refusal.unknown_attributes == (3,)
    assert refusal.transaction_id == TRANSACTION_ID
    assert responder.outcomes == {StunOutcome.REFUSED: 1}


def test_an_optional_extension_is_passed_over() -> None:
    responder = StunResponder(NOW)
    assert responder.respond(with_attribute(bytes.fromhex("80290008 0102030405060708")), SOURCE, NOW) is not None
    assert responder.outcomes == {StunOutcome.ANSWERED: 1}


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
    responder = StunResponder(NOW)
    assert responder.respond(data, source, NOW) is None
    assert responder.outcomes == {outcome: 1}


@given(st.lists(st.tuples(st.integers(0, 0xFFFF), st.binary(max_size=20)), max_size=8), st.booleans())
def test_no_answer_is_longer_than_its_request_by_more_than_it_must(
    attributes: list[tuple[int, bytes]], ipv6: bool
) -> None:
    body = b"".join(
        kind.to_bytes(2, "big") + len(value).to_bytes(2, "big") + value + bytes(-len(value) % 4)
        for kind, value in attributes
    )
    asked = with_attribute(body)
    response = StunResponder(NOW).respond(asked, ("2001:db8::7", 40000) if ipv6 else SOURCE, NOW)
    assert response is None or len(response) <= len(asked) + 32


def test_a_source_that_asks_too_often_gets_silence_until_it_waits() -> None:
    responder = StunResponder(NOW)
    answers = [responder.respond(request(), SOURCE, NOW) for _ in range(int(ANSWERS_BURST) + 10)]
    assert sum(answer is not None for answer in answers) == ANSWERS_BURST
    assert responder.outcomes == {StunOutcome.ANSWERED: ANSWERS_BURST, StunOutcome.TOO_OFTEN: 10}
    assert responder.respond(request(), ("198.51.100.8", 40000), NOW) is not None
    assert responder.respond(request(), SOURCE, NOW + 1.1 / ANSWERS_PER_S) is not None


def test_what_would_not_be_answered_anyway_takes_nothing_from_a_source() -> None:
    responder = StunResponder(NOW)
    for _ in range(1000):
        responder.respond(b"junk", SOURCE, NOW)
    assert responder.respond(request(), SOURCE, NOW) is not None
