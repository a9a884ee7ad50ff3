"""Makes bytes that are small on the wire and huge as a ROS message, or no message at all."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import random

MB = 1 << 20


def bomb(sample: bytes, size: int, rng: random.Random) -> bytes:
    """Return `size` bytes that begin as a CDR message, one length of which announces as many elements as could fit."""
    head = bytearray(sample[:256])
    position = rng.randrange(1, len(head) // 4) * 4
    announced = size // rng.choice((1, 2, 4, 8, 16, 24, 56)) - rng.choice((0, 64))
    head[position : position + 4] = struct.pack("<I", max(0, announced))
    return bytes(head) + bytes(size - len(head))


def garbage(sample: bytes, rng: random.Random) -> bytes:
    """Return noise, or a message that is truncated or has a few bytes changed."""
    match rng.randrange(3):
        case 0:
            return rng.randbytes(10)
        case 1:
            return sample[: rng.randrange(len(sample))]
        case _:
            changed = bytearray(sample)
            for _ in range(4):
                changed[rng.randrange(len(changed))] = rng.randrange(256)
            # The last byte is cut too, so that it is no answer, whatever became of the others.
            return bytes(changed[:-1])
