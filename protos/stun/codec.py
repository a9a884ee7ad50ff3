"""Encodes and decodes STUN Binding messages (RFC 8489), without IO.

::

     0                   1                   2                   3
     0 1 2 3 4 5 6 7 8 9 0 1 2 3 4 5 6 7 8 9 0 1 2 3 4 5 6 7 8 9 0 1
    +---+---------------------------+-------------------------------+
    |0 0|  class and method         |  length of what follows the   |
    |   |  (interleaved bits)       |  20-byte header, multiple of 4|
    +---+---------------------------+-------------------------------+
    |                    magic cookie 0x2112A442                    |
    +---------------------------------------------------------------+
    |                    transaction id (96 bits)                   |
    |                                                               |
    |                                                               |
    +===============================================================+   repeated:
    |        attribute type         |  length of value, unpadded    |
    +-------------------------------+-------------------------------+
    |                value, padded to a multiple of 4               |
    +---------------------------------------------------------------+

    MAPPED-ADDRESS, XOR-MAPPED-ADDRESS
    +---------------+---------------+-------------------------------+
    |       0       | family 1 or 2 | port (xor cookie's high half) |
    +---------------+---------------+-------------------------------+
    |        4 or 16 address bytes (xor cookie, transaction id)     |
    +---------------------------------------------------------------+

    ERROR-CODE
    +-------------------------------------+-------+-----------------+
    |                  0                  | class |  number 0..99   |
    +-------------------------------------+-------+-----------------+
    |                     reason phrase, UTF-8                      |
    +---------------------------------------------------------------+

Only the Binding method is supported. Credentials are skipped, not verified: nothing here relies on them.
"""

from __future__ import annotations

import enum
import struct
import zlib
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import TYPE_CHECKING

from plr.protos.base.errors import DecodeError

if TYPE_CHECKING:
    from plr.protos.model.ids import Address

MAGIC_COOKIE = 0x2112A442
HEADER_BYTES = 20
TRANSACTION_ID_BYTES = 12
BINDING_METHOD = 0x001

MAX_STUN_BYTES = 1500
"""Longest message to decode: one Ethernet MTU. RFC 8489 section 6.1 keeps messages below the path MTU."""

MAX_STUN_TEXT_BYTES = 763
"""Longest SOFTWARE and reason phrase (RFC 8489 sections 14.14 and 14.8: 127 characters in UTF-8)."""

MAX_TEXT_CHARACTERS = 127

MAX_UNKNOWN_ATTRIBUTES = 64
"""Unknown attribute types kept per message; our peers send none, and further ones add no information."""

_COOKIE_BYTES = MAGIC_COOKIE.to_bytes(4, "big")
_FINGERPRINT_XOR = 0x5354554E
_FINGERPRINT_BYTES = 8
_HEADER = struct.Struct("!HHI12s")
_ATTRIBUTE = struct.Struct("!HH")
_COMPREHENSION_OPTIONAL = 0x8000
_FAMILY_IPV4 = 1
_FAMILY_IPV6 = 2


class MessageClass(enum.IntEnum):
    """The two class bits of the message type."""

    REQUEST = 0
    INDICATION = 1
    SUCCESS = 2
    ERROR = 3


class Attribute(enum.IntEnum):
    """Attribute types of RFC 8489 section 18.3 that this codec comprehends."""

    MAPPED_ADDRESS = 0x0001
    USERNAME = 0x0006
    MESSAGE_INTEGRITY = 0x0008
    ERROR_CODE = 0x0009
    UNKNOWN_ATTRIBUTES = 0x000A
    REALM = 0x0014
    NONCE = 0x0015
    MESSAGE_INTEGRITY_SHA256 = 0x001C
    XOR_MAPPED_ADDRESS = 0x0020
    SOFTWARE = 0x8022
    FINGERPRINT = 0x8028


_COMPREHENDED = frozenset(int(attribute) for attribute in Attribute)
_AFTER_INTEGRITY = frozenset({Attribute.MESSAGE_INTEGRITY_SHA256, Attribute.FINGERPRINT})


@dataclass(frozen=True, slots=True)
class StunMessage:
    """One Binding message; `unknown_required` are its comprehension-required types unknown to this codec."""

    message_class: MessageClass
    transaction_id: bytes
    xor_mapped_address: Address | None = None
    mapped_address: Address | None = None
    software: str | None = None
    error_code: int | None = None
    error_reason: str = ""
    unknown_attributes: tuple[int, ...] = ()
    unknown_required: tuple[int, ...] = ()
    fingerprint: bool = False

    @property
    def reflexive_address(self) -> Address | None:
        """Source address of the request as the server saw it; the XORed form wins, as NATs rewrite the plain one."""
        return self.xor_mapped_address or self.mapped_address


def is_stun(data: bytes | memoryview) -> bool:
    """Return whether a datagram is STUN rather than the mesh's own, by its first bytes, without decoding it."""
    return len(data) >= HEADER_BYTES and data[0] < 0x40 and data[4:8] == _COOKIE_BYTES


def encode(message: StunMessage) -> bytes:
    """Encode a message; raise ValueError if a field does not fit the format (a mistake of the caller)."""
    if len(message.transaction_id) != TRANSACTION_ID_BYTES:
        raise ValueError(f"transaction id has {len(message.transaction_id)} bytes, expected {TRANSACTION_ID_BYTES}")
    body = bytearray()
    if message.error_code is not None:
        body += _encode_attribute(Attribute.ERROR_CODE, _error_value(message.error_code, message.error_reason))
    if message.unknown_attributes:
        listed = message.unknown_attributes
        body += _encode_attribute(Attribute.UNKNOWN_ATTRIBUTES, struct.pack(f"!{len(listed)}H", *listed))
    if message.xor_mapped_address is not None:
        value = _xor(_address_value(message.xor_mapped_address), message.transaction_id)
        body += _encode_attribute(Attribute.XOR_MAPPED_ADDRESS, value)
    if message.mapped_address is not None:
        body += _encode_attribute(Attribute.MAPPED_ADDRESS, _address_value(message.mapped_address))
    if message.software is not None:
        body += _encode_attribute(Attribute.SOFTWARE, _text_value(message.software))
    length = len(body) + (_FINGERPRINT_BYTES if message.fingerprint else 0)
    if HEADER_BYTES + length > MAX_STUN_BYTES:
        raise ValueError(f"message has {HEADER_BYTES + length} bytes, at most {MAX_STUN_BYTES} allowed")
    kind = _message_type(message.message_class)
    data = _HEADER.pack(kind, length, MAGIC_COOKIE, message.transaction_id) + bytes(body)
    if message.fingerprint:
        data += _encode_attribute(Attribute.FINGERPRINT, _fingerprint(data).to_bytes(4, "big"))
    return data


def decode(data: bytes | memoryview) -> StunMessage:
    """Decode a Binding message that fills the datagram exactly; raise DecodeError and nothing else."""
    data = bytes(data)
    if len(data) < HEADER_BYTES:
        raise DecodeError(f"STUN: {len(data)} bytes, a header has {HEADER_BYTES}")
    if len(data) > MAX_STUN_BYTES:
        raise DecodeError(f"STUN: {len(data)} bytes, at most {MAX_STUN_BYTES} allowed")
    kind, length, cookie, transaction_id = _HEADER.unpack_from(data)
    if kind & 0xC000 or cookie != MAGIC_COOKIE:
        raise DecodeError("STUN: first two bits are not 0, or no magic cookie")
    if length % 4 or HEADER_BYTES + length != len(data):
        raise DecodeError(f"STUN: length field {length} does not match a datagram of {len(data)} bytes")
    message_class = MessageClass((kind >> 4 & 1) | (kind >> 7 & 2))
    if kind != _message_type(message_class):
        raise DecodeError(f"STUN: message type {kind:#06x} is not of the Binding method")
    return _decode_attributes(data, message_class, transaction_id)


def _decode_attributes(data: bytes, message_class: MessageClass, transaction_id: bytes) -> StunMessage:
    values: dict[int, bytes] = {}
    unknown: dict[int, None] = {}
    offset = HEADER_BYTES
    while offset < len(data):
        if Attribute.FINGERPRINT in values:
            raise DecodeError("STUN: an attribute follows FINGERPRINT")
        # The total and every step are multiples of 4, so the 4-byte attribute header is always complete.
        kind, length = _ATTRIBUTE.unpack_from(data, offset)
        start = offset + _ATTRIBUTE.size
        if start + length > len(data):
            raise DecodeError(f"STUN: attribute {kind:#06x} of {length} bytes overruns the message")
        if kind == Attribute.FINGERPRINT:
            _check_fingerprint(data, offset, length)
        offset = start + (length + 3 & ~3)
        signed = Attribute.MESSAGE_INTEGRITY in values or Attribute.MESSAGE_INTEGRITY_SHA256 in values
        if signed and kind not in _AFTER_INTEGRITY:
            continue
        if kind in _COMPREHENDED:
            # Only the first of a repeated attribute counts (RFC 8489 section 14).
            values.setdefault(kind, data[start : start + length])
        elif kind < _COMPREHENSION_OPTIONAL and len(unknown) < MAX_UNKNOWN_ATTRIBUTES:
            unknown[kind] = None
    code, reason = _read_error(values.get(Attribute.ERROR_CODE))
    if message_class is MessageClass.ERROR and code is None:
        raise DecodeError("STUN: error response without ERROR-CODE")
    xored = values.get(Attribute.XOR_MAPPED_ADDRESS)
    return StunMessage(
        message_class=message_class,
        transaction_id=transaction_id,
        xor_mapped_address=_read_address(None if xored is None else _xor(xored, transaction_id)),
        mapped_address=_read_address(values.get(Attribute.MAPPED_ADDRESS)),
        software=_read_text(values.get(Attribute.SOFTWARE)),
        error_code=code,
        error_reason=reason,
        unknown_attributes=_read_unknown(values.get(Attribute.UNKNOWN_ATTRIBUTES)),
        unknown_required=tuple(unknown),
        fingerprint=Attribute.FINGERPRINT in values,
    )


def _message_type(message_class: MessageClass) -> int:
    return BINDING_METHOD | (message_class & 1) << 4 | (message_class & 2) << 7


def _encode_attribute(kind: Attribute, value: bytes) -> bytes:
    return _ATTRIBUTE.pack(kind, len(value)) + value + bytes(-len(value) % 4)


def _xor(value: bytes, transaction_id: bytes) -> bytes:
    """Apply or undo the XOR of XOR-MAPPED-ADDRESS on everything after the family byte."""
    mask = bytes(2) + _COOKIE_BYTES[:2] + _COOKIE_BYTES + transaction_id
    return bytes(a ^ b for a, b in zip(value, mask, strict=False)) + value[len(mask) :]


def _address_value(address: Address) -> bytes:
    host, port = address
    ip = ip_address(host)
    family = _FAMILY_IPV4 if isinstance(ip, IPv4Address) else _FAMILY_IPV6
    if not 0 <= port <= 0xFFFF:
        raise ValueError(f"port {port} is not in 0..65535")
    return struct.pack("!BBH", 0, family, port) + ip.packed


def _read_address(value: bytes | None) -> Address | None:
    if value is None:
        return None
    if len(value) == 8 and value[1] == _FAMILY_IPV4:
        return str(IPv4Address(value[4:])), int.from_bytes(value[2:4], "big")
    if len(value) == 20 and value[1] == _FAMILY_IPV6:
        ip = IPv6Address(value[4:])
        return str(ip.ipv4_mapped or ip), int.from_bytes(value[2:4], "big")
    raise DecodeError(f"STUN: address of {len(value)} bytes, expected 8 of family 1 or 20 of family 2")


def _error_value(code: int, reason: str) -> bytes:
    if not 300 <= code <= 699:
        raise ValueError(f"error code {code} is not in 300..699")
    return struct.pack("!HBB", 0, code // 100, code % 100) + _text_value(reason)


def _read_error(value: bytes | None) -> tuple[int | None, str]:
    if value is None:
        return None, ""
    if len(value) < 4:
        raise DecodeError(f"STUN: ERROR-CODE of {len(value)} bytes, expected at least 4")
    hundreds, number = value[2] & 7, value[3]
    if not 3 <= hundreds <= 6 or number > 99:
        raise DecodeError(f"STUN: error class {hundreds} number {number}, expected 3..6 and 0..99")
    return 100 * hundreds + number, _read_text(value[4:]) or ""


def _text_value(text: str) -> bytes:
    value = text.encode()
    if len(text) > MAX_TEXT_CHARACTERS or len(value) > MAX_STUN_TEXT_BYTES:
        raise ValueError(f"text of {len(text)} characters, at most {MAX_TEXT_CHARACTERS} allowed")
    return value


def _read_text(value: bytes | None) -> str | None:
    if value is None:
        return None
    if len(value) > MAX_STUN_TEXT_BYTES:
        raise DecodeError(f"STUN: text of {len(value)} bytes, at most {MAX_STUN_TEXT_BYTES} allowed")
    # The text ends up in logs, where a stranger's bytes must not forge lines or move a terminal's cursor.
    return "".join(c if c.isprintable() else "\ufffd" for c in value.decode(errors="replace"))


def _read_unknown(value: bytes | None) -> tuple[int, ...]:
    if value is None:
        return ()
    if len(value) % 2:
        raise DecodeError(f"STUN: UNKNOWN-ATTRIBUTES of {len(value)} bytes, expected an even number")
    return struct.unpack(f"!{len(value) // 2}H", value)[:MAX_UNKNOWN_ATTRIBUTES]


def _fingerprint(data: bytes) -> int:
    return zlib.crc32(data) ^ _FINGERPRINT_XOR


def _check_fingerprint(data: bytes, offset: int, length: int) -> None:
    start = offset + _ATTRIBUTE.size
    if length != 4 or int.from_bytes(data[start : start + 4], "big") != _fingerprint(data[:offset]):
        raise DecodeError("STUN: FINGERPRINT does not match the message")
