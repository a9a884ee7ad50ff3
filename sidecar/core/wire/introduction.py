"""Encodes and opens the datagram that introduces a sidecar on a path that is down, without a control plane.

Layout: the 20 clear bytes of every datagram (flags bit 2 set), then::

    hello id (8 bytes)        = Expand(token, "plr 2 hello id")
    sealed:  probe id (64), offer of keys (phase (32), public key (32 bytes), proof (16 bytes); all 0: none),
             credential (protos/trust/credential.py)
    tag (16 bytes)

The token is the sender's for this receiver (`plr.protos.trust.pair_token`): stable, and known to these two and the
control plane alone. It is a gate at which a stranger's datagram costs one table lookup. Behind it, ChaCha20-Poly1305
takes its key from Expand(token, "plr 2 introduction" | session | sender's interface | receiver's interface | receiver's
name), the clear bytes and the hello id as associated data, and the nonce of every datagram (frame.py). So there is one
key for each path of a session, on which packet numbers do not repeat.

The control plane knows the token too, and so does anyone who reads the receiver's state folder. So an introduction
proves little: the signed credential names the sender, and the sealed datagrams that follow prove that it has the
session's key. Until then no address moves, nothing counts as received, and the answer is shorter than the question. A
sender that repeats itself could not read the answer, since it does not know our session: while the path is down here as
well, our own introductions, rare as they are, go there too. The offer of keys has its own proof (key_exchange.py): the
token alone is not enough to make one.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from plr.protos.base.errors import DecodeError
from plr.protos.trust.credential import decode_credential
from plr.sidecar.core.crypto.aead import TAG_BYTES
from plr.sidecar.core.crypto.key_schedule import expand
from plr.sidecar.core.wire.frame import (
    BASE_BYTES,
    HEADER_BYTES,
    INTRODUCTION_FLAG,
    NONCE_OFFSET,
    SEALED_FLAG,
    Header,
    KeyOffer,
    encode_header,
)

if TYPE_CHECKING:
    from plr.protos.model.ids import NodeName
    from plr.protos.trust.credential import SessionCredential

HELLO_BYTES = 8
INTRODUCTION_FLAGS = SEALED_FLAG | INTRODUCTION_FLAG
_SEALED_FROM = HEADER_BYTES + HELLO_BYTES
_HEAD = struct.Struct(">QI32s16s")
_NO_OFFER = KeyOffer(0, bytes(32), bytes(16))
_KEY_HEAD = struct.Struct(">QBB")
INTRODUCTION_BYTES = _SEALED_FROM + _HEAD.size + TAG_BYTES
"""Bytes of an introduction besides its credential."""
MAX_INTRODUCED_BYTES = BASE_BYTES - INTRODUCTION_BYTES
"""Longest credential that can be introduced: every path carries BASE_BYTES."""


class UnauthenticError(DecodeError):
    """The sender did not know the token, or the datagram was changed on its way."""


class Introduction(NamedTuple):
    """The content of an introduction; the credential is not verified yet."""

    probe_id: int
    offer: KeyOffer | None
    credential: SessionCredential


@lru_cache(maxsize=8192)
def hello_id(token: bytes) -> bytes:
    """Return the name under which a sidecar introduces itself to the one peer that holds this token of it."""
    return expand(token, b"plr 2 hello id", HELLO_BYTES)


def read_hello_id(datagram: memoryview) -> bytes:
    """Return the hello id of an introduction; shorter than HELLO_BYTES if the datagram is."""
    return bytes(datagram[HEADER_BYTES:_SEALED_FROM])


def encode_introduction(
    header: Header, token: bytes, receiver: NodeName, probe_id: int, credential: bytes, offer: KeyOffer | None = None
) -> bytes:
    """Return the whole datagram; `token` is ours for the receiver, `credential` ours and encoded."""
    clear = encode_header(header._replace(flags=INTRODUCTION_FLAGS)) + hello_id(token)
    plain = _HEAD.pack(probe_id, *(offer or _NO_OFFER)) + credential
    return clear + _cipher(header, token, receiver).encrypt(clear[NONCE_OFFSET:HEADER_BYTES], plain, clear)


def open_introduction(header: Header, datagram: memoryview, token: bytes, receiver: NodeName) -> Introduction:
    """Open and parse the datagram with this header; `token` is the sender's for us, `receiver` our name.

    Raises:
        UnauthenticError: the sender does not know the token.
        DecodeError: its content breaks the layout, or belongs to another session.
    """
    if len(datagram) < _SEALED_FROM:
        raise DecodeError("truncated introduction")
    clear = bytes(datagram[:_SEALED_FROM])
    try:
        cipher = _cipher(header, token, receiver)
        plain = cipher.decrypt(clear[NONCE_OFFSET:HEADER_BYTES], datagram[_SEALED_FROM:], clear)
    except InvalidTag:
        raise UnauthenticError("the sender does not know the token") from None
    if len(plain) < _HEAD.size:
        raise DecodeError("truncated introduction")
    credential = decode_credential(plain[_HEAD.size :])
    if credential.session != header.session:
        raise DecodeError("introduction with the credential of another session")
    probe_id, *rest = _HEAD.unpack_from(plain)
    offer = KeyOffer(*rest)
    return Introduction(probe_id, offer if offer != _NO_OFFER else None, credential)


def _cipher(header: Header, token: bytes, receiver: NodeName) -> ChaCha20Poly1305:
    path = _KEY_HEAD.pack(header.session, header.sender_interface, header.receiver_interface)
    return ChaCha20Poly1305(expand(token, b"plr 2 introduction" + path + receiver.encode()))
