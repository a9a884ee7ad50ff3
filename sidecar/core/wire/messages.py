"""Encodes and decodes reassembled messages. Integers are big-endian.

    request    1  request id (16 bytes) copy (8) priority (8) deadline left in us (32) lifetime left in us (32)
                  n (16) service name m (16) type name, payload
    response   2  request id (16 bytes) copy (8) processing time in us (32), payload
    rejection  3  request id (16 bytes) copy (8) reason (8) n (16) text
    cancel     4  request id (16 bytes) 0 (8)
    held       5  n (8), n times: CA (64) number of the newest revocation list that the sender has of it (64)
    wanted     6  as held: the sender asks for newer ones
    lists      7  revocation lists, PEM

`copy` numbers the copies of one request; the answer repeats it, so that each copy's latency is known whichever path
the answer takes. A passed deadline has 0 left. A cancel applies to all copies of its request.

The times left in a request are those when its message was made. It waits before it leaves, and parts of it may leave
again much later. So each datagram tells how much of the lifetime is left by then (frame.py), and the deadline shrinks
by as much.

A CA is named by the first 64 bits of its certificate's SHA-256; one without a list is omitted.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

from plr.protos.base.errors import DecodeError, UnknownKindError
from plr.protos.convert.fields import MAX_CRL_BYTES
from plr.protos.model.ids import ServiceName
from plr.protos.model.names import clean_text
from plr.protos.trust.identity import MAX_CA_CERTIFICATES
from plr.sidecar.core.base.request_id import REQUEST_ID_BYTES
from plr.sidecar.core.base.values import Priority, RejectReason, RequestId

if TYPE_CHECKING:
    from collections.abc import Callable

MAX_PAYLOAD_BYTES = 16 * 1024 * 1024
MAX_NAME_BYTES = 255
MAX_TEXT_BYTES = 500

_HEAD = struct.Struct(f">B{REQUEST_ID_BYTES}sB")
_REQUEST_TIMES = struct.Struct(">BII")
_U32 = struct.Struct(">I")
_U16 = struct.Struct(">H")
_LISTED = struct.Struct(">QQ")
_REQUEST, _RESPONSE, _REJECTION, _CANCEL, _HELD, _WANTED, _LISTS = range(1, 8)


@dataclass(frozen=True, slots=True)
class RequestMessage:
    """A copy of a request on its way to a server."""

    request_id: RequestId
    copy: int
    priority: Priority
    deadline_left_s: float
    lifetime_left_s: float
    service: ServiceName
    type: str
    payload: bytes | memoryview = field(repr=False)

    def when_left(self, lifetime_left_s: float) -> RequestMessage:
        """Return the request as it is once at most this much of its lifetime is left."""
        gone_s = self.lifetime_left_s - lifetime_left_s
        if gone_s <= 0:
            return self
        left_s = max(0.0, self.deadline_left_s - gone_s)
        return replace(self, deadline_left_s=left_s, lifetime_left_s=max(0.0, lifetime_left_s))


@dataclass(frozen=True, slots=True)
class ResponseMessage:
    """The answer to one copy; `processing_s` is the server's share of the time."""

    request_id: RequestId
    copy: int
    processing_s: float
    payload: bytes | memoryview = field(repr=False)


@dataclass(frozen=True, slots=True)
class RejectionMessage:
    """Says that the server did not answer one copy, and why."""

    request_id: RequestId
    copy: int
    reason: RejectReason
    text: str


@dataclass(frozen=True, slots=True)
class CancelMessage:
    """Says that the robot wants no (further) answer to this request."""

    request_id: RequestId


@dataclass(frozen=True, slots=True)
class RevocationsHeld:
    """The revocation lists that the sender has: the newest one's number by CA."""

    numbers: dict[int, int]


@dataclass(frozen=True, slots=True)
class RevocationsWanted:
    """Asks for revocation lists newer than these, which the sender has."""

    numbers: dict[int, int]


@dataclass(frozen=True, slots=True)
class RevocationLists:
    """Revocation lists, PEM; nothing is verified yet."""

    pem: bytes = field(repr=False)


RevocationMessage = RevocationsHeld | RevocationsWanted | RevocationLists
ServiceMessage = RequestMessage | ResponseMessage | RejectionMessage | CancelMessage
Message = ServiceMessage | RevocationMessage


class Encoded(NamedTuple):
    """A message's bytes, in two parts so that the payload is not copied."""

    head: bytes
    payload: bytes | memoryview

    @property
    def size(self) -> int:
        """Bytes of both parts."""
        return len(self.head) + len(self.payload)


def encode_message(message: Message) -> Encoded:
    """Return the message's bytes."""
    if isinstance(message, RequestMessage):
        service, kind = message.service.encode(), message.type.encode()
        deadline_us = _clamped(message.deadline_left_s * 1e6)
        lifetime_us = _clamped(message.lifetime_left_s * 1e6)
        head = b"".join(
            (
                _HEAD.pack(_REQUEST, message.request_id, message.copy),
                _REQUEST_TIMES.pack(message.priority, deadline_us, lifetime_us),
                _U16.pack(len(service)),
                service,
                _U16.pack(len(kind)),
                kind,
            )
        )
        return Encoded(head, message.payload)
    if isinstance(message, ResponseMessage):
        processing_us = _clamped(message.processing_s * 1e6)
        head = _HEAD.pack(_RESPONSE, message.request_id, message.copy) + _U32.pack(processing_us)
        return Encoded(head, message.payload)
    if isinstance(message, CancelMessage):
        return Encoded(_HEAD.pack(_CANCEL, message.request_id, 0), b"")
    if isinstance(message, RevocationsHeld | RevocationsWanted | RevocationLists):
        return _encode_about_revocations(message)
    text = message.text.encode(errors="replace")[:MAX_TEXT_BYTES]
    head = _HEAD.pack(_REJECTION, message.request_id, message.copy) + bytes((message.reason,)) + _U16.pack(len(text))
    return Encoded(head, text)


def request_bytes(service: ServiceName, kind: str, payload_bytes: int) -> int:
    """Return the length of the message that carries a request; all its copies are equally long."""
    names = 2 * _U16.size + len(service.encode()) + len(kind.encode())
    return _HEAD.size + _REQUEST_TIMES.size + names + payload_bytes


def _encode_about_revocations(message: RevocationMessage) -> Encoded:
    if isinstance(message, RevocationLists):
        return Encoded(bytes((_LISTS,)), message.pem)
    kind = _HELD if isinstance(message, RevocationsHeld) else _WANTED
    listed = [_LISTED.pack(ca, min(number, _MAX_NUMBER)) for ca, number in message.numbers.items()]
    return Encoded(bytes((kind, len(listed))) + b"".join(listed), b"")


def decode_message(view: memoryview) -> Message:
    """Parse a reassembled message; payloads view the buffer.

    Raises:
        UnknownKindError: a message that only a newer sidecar knows.
        DecodeError: anything else that is not a message.
    """
    if len(view) and view[0] in _ABOUT_REVOCATIONS:
        return _decode_about_revocations(view)
    try:
        kind, request_id, copy = _HEAD.unpack_from(view)
        decode = _DECODERS.get(kind)
        if decode is None:
            raise UnknownKindError(f"unknown message kind {kind}: the sender is newer")
        return decode(RequestId(request_id), copy, view, _HEAD.size)
    except struct.error:
        raise DecodeError("truncated message") from None


def _decode_request(request_id: RequestId, copy: int, view: memoryview, position: int) -> Message:
    priority, deadline_us, lifetime_us = _REQUEST_TIMES.unpack_from(view, position)
    try:
        priority = Priority(priority)
    except ValueError:
        raise DecodeError("unknown priority") from None
    service, position = _decode_text(view, position + _REQUEST_TIMES.size, MAX_NAME_BYTES)
    kind, position = _decode_text(view, position, MAX_NAME_BYTES)
    payload = _payload(view, position)
    return RequestMessage(
        request_id, copy, priority, deadline_us / 1e6, lifetime_us / 1e6, ServiceName(service), kind, payload
    )


def _decode_response(request_id: RequestId, copy: int, view: memoryview, position: int) -> Message:
    (processing_us,) = _U32.unpack_from(view, position)
    return ResponseMessage(request_id, copy, processing_us / 1e6, _payload(view, position + 4))


def _decode_rejection(request_id: RequestId, copy: int, view: memoryview, position: int) -> Message:
    if position >= len(view):
        raise DecodeError("truncated message")
    try:
        reason = RejectReason(view[position])
    except ValueError:
        # From a newer server: the request may have run, so no other server may run it.
        reason = RejectReason.SERVER_LOST
    text, position = _decode_text(view, position + 1, MAX_TEXT_BYTES, errors="replace")
    return RejectionMessage(request_id, copy, reason, clean_text(text))


def _decode_cancel(request_id: RequestId, _copy: int, _view: memoryview, _position: int) -> Message:
    return CancelMessage(request_id)


def _decode_about_revocations(view: memoryview) -> Message:
    if view[0] == _LISTS:
        if len(view) > 1 + MAX_CRL_BYTES:
            raise DecodeError("revocation lists over the limit")
        return RevocationLists(bytes(view[1:]))
    if len(view) < 2 or view[1] > MAX_CA_CERTIFICATES or len(view) != 2 + view[1] * _LISTED.size:
        raise DecodeError("malformed numbers of revocation lists")
    numbers = dict(_LISTED.iter_unpack(view[2:]))
    return RevocationsHeld(numbers) if view[0] == _HELD else RevocationsWanted(numbers)


_ABOUT_REVOCATIONS = frozenset((_HELD, _WANTED, _LISTS))
_MAX_NUMBER = 0xFFFFFFFFFFFFFFFF

_DECODERS: dict[int, Callable[[RequestId, int, memoryview, int], Message]] = {
    _REQUEST: _decode_request,
    _RESPONSE: _decode_response,
    _REJECTION: _decode_rejection,
    _CANCEL: _decode_cancel,
}


def _clamped(value: float) -> int:
    return max(0, min(int(value), 0xFFFFFFFF))


def _payload(view: memoryview, position: int) -> memoryview:
    payload = view[position:]
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise DecodeError("payload over the limit")
    return payload


def _decode_text(view: memoryview, position: int, limit: int, errors: str = "strict") -> tuple[str, int]:
    (length,) = _U16.unpack_from(view, position)
    position += 2
    raw = bytes(view[position : position + length])
    if len(raw) != length or length > limit:
        raise DecodeError("truncated or overlong text")
    try:
        return raw.decode(errors=errors), position + length
    except UnicodeDecodeError:
        raise DecodeError("text is not UTF-8") from None
