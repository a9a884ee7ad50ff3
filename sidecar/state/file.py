"""Defines and codes the layout of the sidecar's files on disk; does no IO.

    offset  size
         0     8  magic: "plr-id\\0\\0" identity, "plr-last" last good messages of the control plane,
                  "plr-ctrl" addresses of the control plane that worked, "plr-crls" revocation lists,
                  "plr-clck" the time before which the clock is not believed
         8     2  format version: 2 of last good messages, 1 of the others
        10     4  length of the body
        14    32  SHA-256 of the body
        46        body

    identity     token (16), incarnation (8)
    addresses    number of names (1), the configured host:port names, number of addresses (1), for each its host and
                 its port (2); texts have their length (1) before them
    revocations  revocation lists, PEM
    clock        microseconds since 1970 (8)
    last good    owner: length (1), name of the sidecar; then ControlMessages that hold a Welcome, a PeerSet, a
                 MappingSet (the last of a kind counts): length (4), protobuf

Numbers are big-endian. The checksum finds torn writes and bad sectors, not an attacker: the folder is the sidecar's.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from plr.protos.base.errors import DecodeError
from plr.protos.base.host_port import canonical_ip
from plr.protos.convert import control_message_to_proto, parse_control_message
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import TOKEN_BYTES, PeerSet
from plr.protos.model.stream import Welcome

if TYPE_CHECKING:
    from plr.protos.model.ids import Address, NodeName
    from plr.protos.model.stream import ControlMessage

FORMAT_VERSION = 1
"""Format version of a file; any other is refused."""

LAST_GOOD_VERSION = 2
"""Since version 2 the tokens of peers are specific to this sidecar, and their addresses are signed."""

MAX_STATE_FILE_BYTES = 64 << 20
"""Well above the largest peer set and mapping that the control stream can carry."""

_IDENTITY_MAGIC = b"plr-id\0\0"
_LAST_GOOD_MAGIC = b"plr-last"
_ADDRESSES_MAGIC = b"plr-ctrl"
_REVOCATIONS_MAGIC = b"plr-crls"
_CLOCK_MAGIC = b"plr-clck"
_MICROSECONDS = struct.Struct("!Q")
_HEADER = struct.Struct("!8sHI32s")
_IDENTITY = struct.Struct(f"!{TOKEN_BYTES}sQ")
_PORT = struct.Struct("!H")
_LENGTH = struct.Struct("!I")


@dataclass(frozen=True, slots=True)
class SavedIdentity:
    """The sidecar's identity across restarts."""

    token: bytes = field(repr=False)
    """`TOKEN_BYTES` random bytes, drawn once."""
    incarnation: int
    """A number that grows with every start."""


@dataclass(frozen=True, slots=True)
class ControlAddresses:
    """Addresses where a control plane accepted the sidecar, newest first."""

    names: tuple[str, ...]
    """The configured host:port names; the addresses are void with any others."""
    addresses: tuple[Address, ...] = ()


@dataclass(frozen=True, slots=True)
class LastGood:
    """The last messages of the control plane that the sidecar put in force."""

    owner: NodeName
    welcome: Welcome | None = None
    peers: PeerSet | None = None
    mapping: MappingSet | None = None

    def with_message(self, message: ControlMessage) -> LastGood:
        """Return a copy with `message` in place of the last one of its kind."""
        match message:
            case Welcome():
                return replace(self, welcome=message)
            case PeerSet():
                return replace(self, peers=message)
            case MappingSet():
                return replace(self, mapping=message)


def encode_identity(identity: SavedIdentity) -> bytes:
    """Return the file's content."""
    return _seal(_IDENTITY_MAGIC, _IDENTITY.pack(identity.token, identity.incarnation))


def decode_identity(data: bytes) -> SavedIdentity:
    """Read the file's content; raises DecodeError."""
    body = _open(_IDENTITY_MAGIC, data)
    if len(body) != _IDENTITY.size:
        raise DecodeError(f"the identity has {len(body)} bytes, not {_IDENTITY.size}")
    return SavedIdentity(*_IDENTITY.unpack(body))


def encode_last_good(last: LastGood) -> bytes:
    """Return the file's content."""
    owner = last.owner.encode()
    parts = [bytes([len(owner)]), owner]
    for message in (last.welcome, last.peers, last.mapping):
        if message is not None:
            data = control_message_to_proto(message).SerializeToString(deterministic=True)
            parts += [_LENGTH.pack(len(data)), data]
    return _seal(_LAST_GOOD_MAGIC, b"".join(parts), LAST_GOOD_VERSION)


def decode_last_good(data: bytes, owner: NodeName) -> LastGood:
    """Read the file's content; raises DecodeError, even if only another sidecar wrote it."""
    body = _open(_LAST_GOOD_MAGIC, data, LAST_GOOD_VERSION)
    if not body:
        raise DecodeError("no owner")
    end = 1 + body[0]
    if body[1:end] != owner.encode():
        raise DecodeError(f"it was written by the sidecar {body[1:end]!r}")
    last = LastGood(owner)
    while end < len(body):
        message, end = _pull_message(body, end)
        if isinstance(message, PeerSet) and (message.base or message.more):
            raise DecodeError("it holds only a part of a peer set")
        last = last.with_message(message)
    return last


def encode_revocations(pem: bytes) -> bytes:
    """Return the file's content."""
    return _seal(_REVOCATIONS_MAGIC, pem)


def decode_revocations(data: bytes) -> bytes:
    """Read the file's content; raises DecodeError."""
    return _open(_REVOCATIONS_MAGIC, data)


def encode_clock_floor(floor: float) -> bytes:
    """Return the file's content; `floor` in seconds since 1970."""
    return _seal(_CLOCK_MAGIC, _MICROSECONDS.pack(int(floor * 1e6)))


def decode_clock_floor(data: bytes) -> float:
    """Read the file's content; raises DecodeError."""
    try:
        (microseconds,) = _MICROSECONDS.unpack(_open(_CLOCK_MAGIC, data))
    except struct.error:
        raise DecodeError("the clock's floor does not have 8 bytes") from None
    return float(microseconds) / 1e6


def encode_addresses(known: ControlAddresses) -> bytes:
    """Return the file's content."""
    parts = [bytes([len(known.names)]), *map(_text, known.names), bytes([len(known.addresses)])]
    for host, port in known.addresses:
        parts += [_text(host), _PORT.pack(port)]
    return _seal(_ADDRESSES_MAGIC, b"".join(parts))


def decode_addresses(data: bytes) -> ControlAddresses:
    """Read the file's content; raises DecodeError."""
    body = _open(_ADDRESSES_MAGIC, data)
    try:
        names, end = [], 1
        for _ in range(body[0]):
            name, end = _pull_text(body, end)
            names.append(name)
        addresses = []
        count, end = body[end], end + 1
        for _ in range(count):
            host, end = _pull_text(body, end)
            (port,) = _PORT.unpack_from(body, end)
            addresses.append((canonical_ip(host), port))
            end += _PORT.size
    except (IndexError, ValueError, struct.error) as error:
        raise DecodeError(f"addresses: {error}") from error
    return ControlAddresses(tuple(names), tuple(addresses))


def _text(text: str) -> bytes:
    data = text.encode()
    return bytes([len(data)]) + data


def _pull_text(body: bytes, start: int) -> tuple[str, int]:
    end = start + 1 + body[start]
    if end > len(body):
        raise DecodeError("truncated text")
    return body[start + 1 : end].decode(), end


def _pull_message(body: bytes, start: int) -> tuple[ControlMessage, int]:
    begin = start + _LENGTH.size
    if begin > len(body):
        raise DecodeError("truncated message length")
    (length,) = _LENGTH.unpack_from(body, start)
    end = begin + length
    if end > len(body):
        raise DecodeError("truncated message")
    return parse_control_message(body[begin:end]), end


def _seal(magic: bytes, body: bytes, version: int = FORMAT_VERSION) -> bytes:
    return _HEADER.pack(magic, version, len(body), hashlib.sha256(body).digest()) + body


def _open(magic: bytes, data: bytes, known_version: int = FORMAT_VERSION) -> bytes:
    if len(data) < _HEADER.size:
        raise DecodeError(f"{len(data)} bytes are too short for a header")
    found, version, length, digest = _HEADER.unpack_from(data)
    if found != magic:
        raise DecodeError("not a file of this kind")
    if version != known_version:
        raise DecodeError(f"format version {version}, not {known_version}")
    body = data[_HEADER.size :]
    if len(body) != length:
        raise DecodeError(f"the body has {len(body)} bytes, not {length}")
    if hashlib.sha256(body).digest() != digest:
        raise DecodeError("wrong checksum")
    return body
