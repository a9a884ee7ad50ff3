"""Answers STUN Binding requests (RFC 8489 section 6.3.1). Sans-IO.

Anyone may ask from a forged source address, so an answer must never be worth forging for: a success is at most 12 bytes
(IPv4) or 24 bytes (IPv6) longer than its request, plus SOFTWARE where set; a refusal at most 32 bytes. And no source is
answered more often than `source_limits.py` allows.
"""

from __future__ import annotations

import enum
from collections import Counter
from typing import TYPE_CHECKING

from plr.controlplane.core.stun.source_limits import SourceLimits
from plr.protos.base.errors import DecodeError
from plr.protos.stun.codec import MessageClass, StunMessage, decode, encode, is_stun

if TYPE_CHECKING:
    from plr.protos.model.ids import Address

UNKNOWN_ATTRIBUTE_CODE = 420


class StunOutcome(enum.StrEnum):
    """What became of a datagram that reached the STUN port."""

    ANSWERED = "answered"
    REFUSED = "refused"
    """Answered with 420: the request relies on an extension that is not supported here."""
    NOT_STUN = "not_stun"
    MALFORMED = "malformed"
    NOT_A_REQUEST = "not_a_request"
    BAD_SOURCE = "bad_source"
    TOO_OFTEN = "too_often"


class StunResponder:
    """Answers datagrams; `outcomes` counts what came of them."""

    def __init__(self, now: float, *, software: str | None = None) -> None:
        self.outcomes: Counter[StunOutcome] = Counter()
        self._limits = SourceLimits(now)
        self._software = software

    def respond(self, data: bytes | memoryview, source: Address, now: float) -> bytes | None:
        """Return the response to send back to `source`, or None."""
        outcome, response = self._respond(data, source, now)
        self.outcomes[outcome] += 1
        return response

    def _respond(self, data: bytes | memoryview, source: Address, now: float) -> tuple[StunOutcome, bytes | None]:
        if not is_stun(data):
            return StunOutcome.NOT_STUN, None
        if source[1] == 0:
            return StunOutcome.BAD_SOURCE, None
        if not self._limits.allows(source, now):
            return StunOutcome.TOO_OFTEN, None
        return _answer(data, source, self._software)


def _answer(data: bytes | memoryview, source: Address, software: str | None) -> tuple[StunOutcome, bytes | None]:
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
        # RFC 8489 section 7: it is returned when the request has it, and costs nothing when it does not.
        fingerprint=request.fingerprint,
    )
    return StunOutcome.ANSWERED, encode(success)
