"""Encodes and decodes our datagrams. Integers are big-endian.

Datagram::

     0                   1                   2                   3
     0 1 2 3 4 5 6 7 8 9 0 1 2 3 4 5 6 7 8 9 0 1 2 3 4 5 6 7 8 9 0 1
    +-------+-------+---------------+---------------+---------------+
    | 1101  |version| flags         | sender's if   | receiver's if |
    +-------+-------+---------------+---------------+---------------+
    | session of the sender (64)                                    |
    +---------------------------------------------------------------+
    | packet number on this path and direction (64)                 |
    +---------------------------------------------------------------+
    | frames ..., sealed                                            |
    +---------------------------------------------------------------+
    | tag of the AEAD (16 bytes)                                    |
    +---------------------------------------------------------------+

The first 20 bytes stay in clear; they are the associated data, and the last 12 of them the nonce. Flags: bit 0 means
sealed and is always 1, bit 1 is the parity of the key phase (keys.py), bit 2 means introduction (introduction.py:
another key, and no frames); the others are 0. The first byte tells our datagrams (0xD3) from STUN's (0x00 to 0x3F,
RFC 8489 section 5) on the same socket.

Frames, each a type byte and then::

    PADDING      0  and every zero byte after it             pads a probe to the size that is tested (pmtu.py)
    PROBE        1  id (64)                                  is answered at once
    PROBE_REPLY  2  id (64)                                  proves that what stood in the probe was read
    ACK          3  largest (64) delay in us (32) n (8), n times: length - 1 of a range (16), gap - 1 below it (16)
    FRAGMENT     4  message (64) total size (32) symbol size (16) index (16) left in us (32), then the symbol: its
                    length follows from the other fields
    REPAIR       5  as FRAGMENT, of a repair symbol (fec.py): the index counts on after the source symbols
    FINISHED     6  message (64)                             the receiver has all of it
    ABANDON      7  message (64)                             the sender will not send the rest
    CLOSE        8  the sidecar goes away
    FORGOTTEN   10  message (64)                             the receiver dropped what it had of it: send it again
    KEY_OFFER   11  phase (32) public key (32 bytes) proof (16 bytes)    new keys (key_exchange.py)
    KEY_ANSWER  12  phase (32) public key (32 bytes) proof (16 bytes)

A message of `total size` bytes is cut into symbols of `symbol size` bytes, the last one shorter; `index` counts them.
`left` is how long the message is still of use when the datagram arrives, as far as its sender can tell. It is written
when the datagram is built, so that it holds for each copy and each retransmission, while the symbol's bytes never
change. Only FRAGMENT, REPAIR and FINISHED are ack-eliciting (RFC 9002 section 2): a PROBE is answered by its reply, and
nothing waits for the rest. A datagram holds at most one ACK, and one KEY_OFFER or KEY_ANSWER: each costs work, and the
newest ACK repeats what all earlier ones said.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, NamedTuple

from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import OLDEST_PROTOCOL_VERSION, PROTOCOL_VERSION, InterfaceId, SessionId
from plr.sidecar.core.crypto.aead import NONCE_BYTES, TAG_BYTES

if TYPE_CHECKING:
    from collections.abc import Sequence

FIRST_BYTE = 0xD0 | PROTOCOL_VERSION
FIRST_BYTES = frozenset(0xD0 | version for version in range(OLDEST_PROTOCOL_VERSION, PROTOCOL_VERSION + 1))
"""First bytes of the versions understood here: they have one layout."""
SEALED_FLAG, PHASE_FLAG, INTRODUCTION_FLAG = 1, 2, 4
_KNOWN_FLAGS = frozenset({SEALED_FLAG, SEALED_FLAG | PHASE_FLAG, SEALED_FLAG | INTRODUCTION_FLAG})
HEADER = struct.Struct(">BBBBQQ")
HEADER_BYTES = HEADER.size
NONCE_OFFSET = HEADER_BYTES - NONCE_BYTES
"""Where the nonce begins in the header: with the lower half of the session, before the packet number."""
CLEAR = struct.Struct(">IQQ")
"""The header with its first four bytes as one number: head, session, packet number."""
MIN_DATAGRAM_BYTES = HEADER_BYTES + 1 + TAG_BYTES
"""Datagram with one frame of one byte."""

BASE_BYTES = 1200
"""UDP payload that every path of the Internet carries (RFC 9000 section 14; BASE_PLPMTU)."""
MAX_DATAGRAM_BYTES = 8952
"""UDP payload of the longest accepted datagram: jumbo frames of 9000 bytes less the headers of IPv6 and UDP. Larger
ones gain nothing more. `pmtu.py` finds how long datagrams on a path may be."""
BASE_FRAMES_BYTES = BASE_BYTES - HEADER_BYTES - TAG_BYTES
"""Bytes of frames in a datagram that every path carries."""

MAX_MESSAGE_BYTES = 16 * 1024 * 1024 + 1024
"""Largest payload the product promises (16 MiB) plus the head of a message."""
MAX_ACK_RANGES = 32
"""More ranges would report losses that the sender has long declared."""
MAX_FRAMES = 64
"""Frames in one datagram; an honest one holds a handful."""

_PADDING, _PROBE, _PROBE_REPLY, _ACK, FRAGMENT_TYPE, REPAIR_TYPE, FINISHED_TYPE, _ABANDON = range(8)
_CLOSE, _FORGOTTEN, _KEY_OFFER, KEY_ANSWER_TYPE = 8, 10, 11, 12

_U64 = struct.Struct(">Q")
_ACK_HEAD = struct.Struct(">QIB")
_NEW_KEY = struct.Struct(">I32s16s")
_ACK_RANGE = struct.Struct(">HH")
_FRAGMENT_HEAD = struct.Struct(">QIHHI")
FRAGMENT_HEAD = struct.Struct(">BQIHHI")
"""What precedes the symbol in a FRAGMENT or REPAIR, its type byte included."""
FRAGMENT_HEAD_BYTES = FRAGMENT_HEAD.size

FRAGMENT_OVERHEAD_BYTES = HEADER_BYTES + FRAGMENT_HEAD_BYTES + TAG_BYTES
"""Bytes of a datagram with nothing but a fragment, besides the symbol."""
BASE_SYMBOL_BYTES = BASE_BYTES - FRAGMENT_OVERHEAD_BYTES
"""Bytes of a symbol that every path carries."""
MAX_SYMBOL_BYTES = MAX_DATAGRAM_BYTES - FRAGMENT_OVERHEAD_BYTES
FRAGMENT_DATAGRAM = struct.Struct(">IQQBQIHHI")
"""What precedes the symbol in a datagram with nothing but a FRAGMENT or REPAIR: the header, its first four bytes as one
number, and the frame's head."""
FRAGMENT_DATAGRAM_BYTES = FRAGMENT_DATAGRAM.size
MAX_LEFT_US = 0xFFFFFFFF
"""71 minutes: longer than any message is of use."""
MIN_SYMBOL_BYTES = 256
"""Smaller symbols would let a peer make us count millions of fragments for one message."""


class Header(NamedTuple):
    """The clear head of a datagram."""

    sender_interface: InterfaceId
    receiver_interface: InterfaceId
    session: SessionId
    packet_number: int
    flags: int = SEALED_FLAG


class Probe(NamedTuple):
    """Asks for a PROBE_REPLY with the same id at once."""

    id: int


class ProbeReply(NamedTuple):
    """Answers a PROBE."""

    id: int


class AckFrame(NamedTuple):
    """Packet numbers received on this path: inclusive ranges, highest first; `delay_s` since the largest came."""

    ranges: tuple[tuple[int, int], ...]
    delay_s: float


class Fragment(NamedTuple):
    """One symbol of a message; `data` views the datagram it came in."""

    message: int
    total: int
    symbol: int
    symbol_index: int
    data: memoryview
    left_us: int = MAX_LEFT_US
    """How long the message was still of use when this left its sender, less half a round trip."""


class Finished(NamedTuple):
    """The receiver holds the whole message."""

    message: int


class Abandon(NamedTuple):
    """The sender will not send the rest of the message."""

    message: int


class Forgotten(NamedTuple):
    """The receiver dropped what it had of the message."""

    message: int


class KeyOffer(NamedTuple):
    """Asks for a KEY_ANSWER, for the phase after the one in use."""

    phase: int
    key: bytes
    proof: bytes


class KeyAnswer(NamedTuple):
    """Completes new keys."""

    phase: int
    key: bytes
    proof: bytes


class Close(NamedTuple):
    """The sender goes away."""


Frame = Probe | ProbeReply | AckFrame | Fragment | Finished | Abandon | Forgotten | Close | KeyOffer | KeyAnswer


class VersionError(DecodeError):
    """One of our datagrams, but of another protocol version."""


class UnsealedError(DecodeError):
    """One of our datagrams, but in clear."""


def symbol_count(total: int, symbol: int) -> int:
    """Return the number of symbols of a message of `total` bytes; an empty message has one empty symbol."""
    return max(1, -(-total // symbol))


def clear_head(sender: InterfaceId, receiver: InterfaceId, flags: int = SEALED_FLAG) -> int:
    """Return the first four bytes of a header as one number."""
    return FIRST_BYTE << 24 | flags << 16 | sender << 8 | receiver


def encode_header(header: Header) -> bytes:
    """Return the 20 clear bytes."""
    return HEADER.pack(FIRST_BYTE, header.flags, *header[:4])


def decode_header(data: bytes | memoryview) -> Header:
    """Parse the clear head.

    Raises:
        VersionError: a datagram of ours, of another version.
        UnsealedError: a datagram of ours, in clear.
        DecodeError: anything else that is not a datagram of ours.
    """
    if len(data) < HEADER_BYTES:
        raise DecodeError("short datagram")
    first, flags, sender, receiver, session, packet_number = HEADER.unpack_from(data)
    if first not in FIRST_BYTES:
        if first & 0xF0 == FIRST_BYTE & 0xF0:
            raise VersionError(f"protocol version {first & 0x0F}, ours is {PROTOCOL_VERSION}")
        raise DecodeError("not a datagram of this protocol")
    if not flags & SEALED_FLAG:
        raise UnsealedError("not sealed")
    if flags not in _KNOWN_FLAGS:
        raise DecodeError("unknown flags")
    return Header(InterfaceId(sender), InterfaceId(receiver), SessionId(session), packet_number, flags)


def encode_probe(frame: Probe) -> bytes:
    """Return the frame's bytes."""
    return b"\x01" + _U64.pack(frame.id)


def encode_probe_reply(frame: ProbeReply) -> bytes:
    """Return the frame's bytes."""
    return b"\x02" + _U64.pack(frame.id)


def encode_key_offer(frame: KeyOffer) -> bytes:
    """Return the frame's bytes."""
    return bytes([_KEY_OFFER]) + _NEW_KEY.pack(*frame)


def encode_key_answer(frame: KeyAnswer) -> bytes:
    """Return the frame's bytes."""
    return bytes([KEY_ANSWER_TYPE]) + _NEW_KEY.pack(*frame)


def encode_ack(ranges: Sequence[tuple[int, int]], delay_s: float) -> bytes:
    """Encode inclusive `ranges`, highest first; omit those past MAX_ACK_RANGES or too wide to encode."""
    largest = ranges[0][1]
    body = bytearray()
    count = 0
    above: int | None = None
    for low, high in ranges[:MAX_ACK_RANGES]:
        gap = 0 if above is None else above - high - 2
        if gap > 0xFFFF:
            break
        length = min(high - low, 0xFFFF)
        body += _ACK_RANGE.pack(length, gap)
        count += 1
        if length < high - low:
            break
        above = low
    delay_us = min(int(delay_s * 1e6), 0xFFFFFFFF)
    return b"\x03" + _ACK_HEAD.pack(largest, delay_us, count) + bytes(body)


def encode_fragment_head(message: int, total: int, symbol: int, index: int, left_us: int = MAX_LEFT_US) -> bytes:
    """Return the bytes that precede the symbol."""
    kind = FRAGMENT_TYPE if index * symbol < total or not index else REPAIR_TYPE
    return FRAGMENT_HEAD.pack(kind, message, total, symbol, index, left_us)


def encode_finished(frame: Finished) -> bytes:
    """Return the frame's bytes."""
    return b"\x06" + _U64.pack(frame.message)


def encode_abandon(frame: Abandon) -> bytes:
    """Return the frame's bytes."""
    return b"\x07" + _U64.pack(frame.message)


def encode_forgotten(frame: Forgotten) -> bytes:
    """Return the frame's bytes."""
    return b"\x0a" + _U64.pack(frame.message)


def finished_number(encoded: bytes) -> int:
    """Return the message number of an encoded FINISHED frame."""
    (number,) = _U64.unpack_from(encoded, 1)
    return int(number)


def encode_close() -> bytes:
    """Return the frame's byte."""
    return b"\x08"


def encode_padding(size: int) -> bytes:
    """Return a PADDING frame of this many bytes."""
    return bytes(size)


def decode_frames(view: memoryview) -> list[Frame]:
    """Parse the frames of an opened datagram.

    Raises:
        DecodeError: the bytes are not whole frames that we know; none of them is to be believed.
    """
    frames: list[Frame] = []
    position = 0
    end = len(view)
    acknowledged = exchanging = False
    try:
        while position < end:
            kind = view[position]
            position += 1
            if kind == _PADDING:
                position = _skip_padding(view, position)
            elif kind in (FRAGMENT_TYPE, REPAIR_TYPE):
                fragment, position = _decode_fragment(kind, view, position)
                frames.append(fragment)
            elif kind == _ACK:
                if acknowledged:
                    raise DecodeError("more than one acknowledgement")
                acknowledged = True
                ack, position = _decode_ack(view, position)
                frames.append(ack)
            elif kind in _ABOUT_A_MESSAGE:
                frames.append(_ABOUT_A_MESSAGE[kind](_U64.unpack_from(view, position)[0]))
                position += 8
            elif kind in (_PROBE, _PROBE_REPLY):
                (probe_id,) = _U64.unpack_from(view, position)
                frames.append(Probe(probe_id) if kind == _PROBE else ProbeReply(probe_id))
                position += 8
            elif kind == _CLOSE:
                frames.append(Close())
            elif kind in (_KEY_OFFER, KEY_ANSWER_TYPE):
                if exchanging:
                    raise DecodeError("more than one key offer or key answer")
                exchanging = True
                frames.append((KeyOffer if kind == _KEY_OFFER else KeyAnswer)(*_NEW_KEY.unpack_from(view, position)))
                position += _NEW_KEY.size
            else:
                raise DecodeError(f"unknown frame type {kind}")
            if len(frames) > MAX_FRAMES:
                raise DecodeError("too many frames")
    except struct.error:
        raise DecodeError("truncated frame") from None
    if not frames:
        raise DecodeError("no frames")
    return frames


def _skip_padding(view: memoryview, position: int) -> int:
    """Return where the zeros end."""
    rest = view[position:]
    return len(view) - len(bytes(rest).lstrip(b"\0"))


_ABOUT_A_MESSAGE: dict[int, type[Finished | Abandon | Forgotten]] = {
    FINISHED_TYPE: Finished,
    _ABANDON: Abandon,
    _FORGOTTEN: Forgotten,
}


def is_repair_index(index: int, total: int, symbol: int) -> bool:
    """Return whether a message of `total` bytes in symbols of `symbol` bytes (not 0) may have this repair symbol."""
    count = symbol_count(total, symbol)
    return count <= index < 2 * count


def _decode_fragment(kind: int, view: memoryview, position: int) -> tuple[Fragment, int]:
    message, total, symbol, index, left_us = _FRAGMENT_HEAD.unpack_from(view, position)
    position += _FRAGMENT_HEAD.size
    if total > MAX_MESSAGE_BYTES:
        raise DecodeError("message over the limit")
    if not MIN_SYMBOL_BYTES <= symbol <= MAX_SYMBOL_BYTES:
        raise DecodeError("symbol too small or too large")
    if kind == FRAGMENT_TYPE:
        start = index * symbol
        if start >= total and (index or total):
            raise DecodeError("fragment beyond the end of its message")
        length = min(symbol, total - start)
    else:
        if not is_repair_index(index, total, symbol):
            raise DecodeError("repair symbol beyond the end of its message")
        length = symbol
    data = view[position : position + length]
    if len(data) != length:
        raise DecodeError("truncated fragment")
    return Fragment(message, total, symbol, index, data, left_us), position + length


def _decode_ack(view: memoryview, position: int) -> tuple[AckFrame, int]:
    largest, delay_us, count = _ACK_HEAD.unpack_from(view, position)
    position += _ACK_HEAD.size
    if not 1 <= count <= MAX_ACK_RANGES:
        raise DecodeError("bad number of ack ranges")
    ranges = []
    high = largest
    for number in range(count):
        length, gap = _ACK_RANGE.unpack_from(view, position)
        position += _ACK_RANGE.size
        if number:
            high -= gap + 2
        low = high - length
        if low < 0:
            raise DecodeError("ack range below zero")
        ranges.append((low, high))
        high = low
    return AckFrame(tuple(ranges), delay_us / 1e6), position
