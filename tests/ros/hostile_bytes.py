"""Deserialises truncated, mutated, random and huge bytes; prints how many were accepted and refused, and the slowest.

Run as `python -m tests.ros.hostile_bytes SEED COUNT HUGE`. The invariant: `deserialize` returns or raises
RosBridgeError, within an address space that leaves no room for what the lengths in the bytes promise.
"""

from __future__ import annotations

import random
import resource
import struct
import sys
import time
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import GetPlan
from rcl_interfaces.msg import Parameter
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.serialization import serialize_message
from rclpy.type_support import check_for_type_support
from sensor_msgs.msg import CompressedImage, PointCloud2
from std_srvs.srv import Empty, SetBool, Trigger

from plr.sidecar.ros.errors import RosBridgeError
from plr.sidecar.ros.rcl import MessageType

HUGE_BYTES = 16 << 20
"""The longest request (docs/operate/limits.md)."""
MORE_ADDRESS_SPACE_BYTES = 8 * HUGE_BYTES
"""Beyond what rclpy's libraries take: two copies of the bytes, three times them as a message, the allocator's rest."""
INTERESTING = (b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\x00\x00\x00\x10", b"\x00\x00\x10\x00")


def samples() -> list[Any]:
    plan = GetPlan.Response()
    plan.plan.header.frame_id = "map"
    plan.plan.poses = [PoseStamped() for _ in range(5)]
    parameters = SetParameters.Request(parameters=[Parameter(name="abc") for _ in range(3)])
    parameters.parameters[0].value.string_array_value = ["a", "bb"]
    return [
        GetPlan.Request(),
        plan,
        SetBool.Request(data=True),
        SetBool.Response(message="abc"),
        Trigger.Response(message="x" * 50),
        Empty.Request(),
        CompressedImage(format="jpeg", data=bytes(100)),
        PointCloud2(data=bytes(64)),
        parameters,
        GetParameters.Request(names=["a", "bc"]),
    ]


def damage(payload: bytes, rng: random.Random) -> bytes:
    kind = rng.random()
    if kind < 0.3:
        return payload[: rng.randrange(len(payload) + 1)]
    if kind < 0.4:
        return rng.randbytes(rng.randrange(64))
    mutated = bytearray(payload)
    if kind < 0.7:
        for _ in range(rng.randrange(1, 6)):
            mutated[rng.randrange(len(mutated))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
    else:
        position = rng.randrange(len(mutated) // 4 + 1) * 4
        mutated[position : position + 4] = rng.choice(INTERESTING)
    return bytes(mutated)


def huge(payload: bytes, rng: random.Random) -> bytes:
    """The longest bytes: a message's beginning, one length of which announces as many elements as could be there."""
    head = bytearray(payload)
    position = rng.randrange(1, len(head) // 4 + 1) * 4
    announced = HUGE_BYTES // rng.choice((1, 2, 4, 8, 16, 24, 32, 56, 72)) - rng.choice((0, 64))
    head[position : position + 4] = struct.pack("<I", announced)
    return bytes(head) + bytes(HUGE_BYTES - len(head))


def address_space() -> int:
    """Bytes that this process takes."""
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def main() -> None:
    seed, count, huge_count = map(int, sys.argv[1:])
    rng = random.Random(seed)
    originals = []
    for message in samples():
        check_for_type_support(type(message))
        originals.append((MessageType(type(message)), serialize_message(message)))
    limit = address_space() + MORE_ADDRESS_SPACE_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    accepted, slowest_s = 0, 0.0
    for number in range(count + huge_count):
        kind, payload = rng.choice(originals)
        hostile = damage(payload, rng) if number < count else huge(payload, rng)
        began = time.thread_time()
        try:
            kind.deserialize(hostile)
            accepted += 1
        except RosBridgeError:
            pass
        finally:
            slowest_s = max(slowest_s, time.thread_time() - began)
    sys.stdout.write(f"{accepted} {count + huge_count - accepted} {slowest_s:.3f}\n")


if __name__ == "__main__":
    main()
