"""Bytes that are small on the wire and huge as a ROS message, or none at all."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import random

MB = 1 << 20


def bomb(sample: bytes, size: int, rng: random.Random) -> bytes:
    """`size` bytes that begin as a message in CDR, one length of which announces as many elements as could be there."""
    head = bytearray(sample[:256])
    position = rng.randrange(1, len(head) // 4) * 4
    announced = size // rng.choice((1, 2, 4, 8, 16, 24, 56)) - rng.choice((0, 64))
    head[position : position + 4] = struct.pack("<I", max(0, announced))
    return bytes(head) + bytes(size - len(head))


def garbage(sample: bytes, rng: random.Random) -> bytes:
    """Noise, or a message that is cut off, or has a few other bytes."""
    match rng.randrange(3):
        case 0:
            return rng.randbytes(10)
        case 1:
            return sample[: rng.randrange(len(sample))]
        case _:
            changed = bytearray(sample)
            for _ in range(4):
                changed[rng.randrange(len(changed))] = rng.randrange(256)
            # The last byte is gone as well, so that it is no answer, whatever became of the others.
            return bytes(changed[:-1])
