"""Answers STUN Binding requests (RFC 8489 section 6.3.1). Sans-IO and without state.

Anyone may ask from a forged source address, so an answer is never worth forging for: a success is 12 bytes
(IPv4) or 24 bytes (IPv6) longer than its request, plus SOFTWARE where set; a refusal at most 32 bytes.
"""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING

from protos.errors import DecodeError
from protos.stun import MessageClass, StunMessage, decode, encode, is_stun

if TYPE_CHECKING:
    from collections import Counter

    from protos.model import Address

UNKNOWN_ATTRIBUTE_CODE = 420


class StunOutcome(enum.StrEnum):
    """What became of a datagram that reached the STUN port."""

    ANSWERED = "answered"
    REFUSED = "refused"
    """Answered with 420: the request relies on an extension that is not spoken here."""
    NOT_STUN = "not_stun"
    MALFORMED = "malformed"
    NOT_A_REQUEST = "not_a_request"
    BAD_SOURCE = "bad_source"


def respond(
    data: bytes | memoryview, source: Address, outcomes: Counter[StunOutcome], *, software: str | None = None
) -> bytes | None:
    """The response to send back to `source`, or None; counts into `outcomes` which it was and why."""
    outcome, response = _respond(data, source, software)
    outcomes[outcome] += 1
    return response


def _respond(data: bytes | memoryview, source: Address, software: str | None) -> tuple[StunOutcome, bytes | None]:
    if not is_stun(data):
        return StunOutcome.NOT_STUN, None
    if source[1] == 0:
        return StunOutcome.BAD_SOURCE, None
    try:
        request = decode(data)
    except DecodeError:
        return StunOutcome.MALFORMED, None
    if request.message_class is not MessageClass.REQUEST:
        return StunOutcome.NOT_A_REQUEST, None
    if request.unknown_required:
        refusal = StunMessage(
            MessageClass.ERROR,
            request.transaction_id,
            error_code=UNKNOWN_ATTRIBUTE_CODE,
            error_reason="Unknown Attribute",
            unknown_attributes=request.unknown_required,
            fingerprint=request.fingerprint,
        )
        return StunOutcome.REFUSED, encode(refusal)
    success = StunMessage(
        MessageClass.SUCCESS,
        request.transaction_id,
        xor_mapped_address=source,
        software=software,
        # RFC 8489 section 7: it comes back when the request has it, and costs nothing where it does not.
        fingerprint=request.fingerprint,
    )
    return StunOutcome.ANSWERED, encode(success)
