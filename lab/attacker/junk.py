"""Makes junk for a sidecar's port: datagrams that must be refused, one kind for each different cost of refusal."""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING

from plr.sidecar.core.wire.frame import HEADER_BYTES, INTRODUCTION_FLAG, MAX_DATAGRAM_BYTES
from plr.sidecar.core.wire.introduction import HELLO_BYTES

if TYPE_CHECKING:
    import random
    from collections.abc import Sequence

LONGEST_BYTES = 1400
"""Longest junk; it fits every path of the lab."""
_NUMBER = slice(HEADER_BYTES - 8, HEADER_BYTES)
"""Position of the packet number in the clear header."""


class JunkKind(enum.StrEnum):
    """The kind of junk."""

    NOISE = "noise"
    """Random bytes."""
    HEADED = "headed"
    """The clear header of a captured datagram, another packet number, random bytes."""
    INTRODUCED = "introduced"
    """A captured introduction, another packet number, random bytes after the name that it asks to be known by."""
    FLIPPED = "flipped"
    """A captured datagram with one bit changed."""
    REPLAYED = "replayed"
    """A captured datagram, unchanged."""
    MANGLED = "mangled"
    """A captured datagram, cut, stretched or changed."""


def make_junk(kind: JunkKind, seen: Sequence[bytes], count: int, rng: random.Random) -> list[bytes]:
    """Return `count` datagrams; `seen` are real ones, needed for all kinds but NOISE."""
    return [_one(kind, seen, rng) for _ in range(count)]


def _one(kind: JunkKind, seen: Sequence[bytes], rng: random.Random) -> bytes:
    match kind:
        case JunkKind.NOISE:
            return noise(rng)
        case JunkKind.HEADED:
            return headed(rng.choice(seen), rng)
        case JunkKind.INTRODUCED:
            known = [one for one in seen if is_introduction(one)]
            return headed(rng.choice(known), rng, HEADER_BYTES + HELLO_BYTES) if known else noise(rng)
        case JunkKind.FLIPPED:
            return flipped(rng.choice(seen), rng)
        case JunkKind.REPLAYED:
            return rng.choice(seen)
        case JunkKind.MANGLED:
            return mangled(rng.choice(seen), rng)


def noise(rng: random.Random) -> bytes:
    """Return random bytes, a few or many."""
    return rng.randbytes(rng.choice((rng.randint(1, 64), rng.randint(1, LONGEST_BYTES))))


def is_introduction(datagram: bytes) -> bool:
    """Return whether a sidecar introduces itself with this datagram."""
    return len(datagram) > HEADER_BYTES and bool(datagram[1] & INTRODUCTION_FLAG)


def headed(datagram: bytes, rng: random.Random, kept: int = HEADER_BYTES) -> bytes:
    """Return the first `kept` bytes with a plausible next packet number, and random bytes."""
    head = bytearray(datagram[:kept])
    number = int.from_bytes(head[_NUMBER], "big") + rng.randint(1, 1 << rng.randint(1, 40))
    head[_NUMBER] = (number & (1 << 64) - 1).to_bytes(8, "big")
    return bytes(head) + rng.randbytes(rng.choice((len(datagram) - kept, rng.randint(0, 1000))))


def flipped(datagram: bytes, rng: random.Random) -> bytes:
    """Return the datagram with one bit changed."""
    changed = bytearray(datagram)
    bit = rng.randrange(8 * len(changed))
    changed[bit >> 3] ^= 1 << (bit & 7)
    return bytes(changed)


def mangled(datagram: bytes, rng: random.Random) -> bytes:
    """Return the datagram cut, stretched, or with bytes changed, doubled or swapped, as a fuzzer does."""
    changed = bytearray(datagram)
    for _ in range(rng.randint(1, 4)):
        where = rng.randint(0, len(changed))
        match rng.randrange(6):
            case 0:
                del changed[where:]
            case 1:
                changed[where:where] = rng.randbytes(rng.randint(1, 40))
            case 2:
                del changed[where : where + rng.randint(1, 40)]
            case 3 if where < len(changed):
                changed[where] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))
            case 4 if where < len(changed):
                changed[where] ^= 1 << rng.randrange(8)
            case _:
                changed += changed[:where]
    return bytes(changed[:MAX_DATAGRAM_BYTES])
