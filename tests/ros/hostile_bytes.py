"""Deserialises truncated, mutated and random bytes; prints how many were accepted and refused.

Run as `python -m tests.ros.hostile_bytes SEED COUNT`. The invariant: `deserialize` returns or raises RosBridgeError,
within an address space that leaves no room for what the lengths in the bytes promise.
"""

from __future__ import annotations

import random
import resource
import sys
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import GetPlan
from rcl_interfaces.msg import Parameter
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.serialization import serialize_message
from rclpy.type_support import check_for_type_support
from sensor_msgs.msg import CompressedImage, PointCloud2
from std_srvs.srv import Empty, SetBool, Trigger

from sidecar.ros.errors import RosBridgeError
from sidecar.ros.rcl import MessageType

ADDRESS_SPACE_BYTES = 3 << 30
"""Generous for rclpy's libraries, and less than one array of 2**32 - 1 poses."""
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


def main() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE_BYTES, ADDRESS_SPACE_BYTES))
    seed, count = map(int, sys.argv[1:])
    rng = random.Random(seed)
    originals = []
    for message in samples():
        check_for_type_support(type(message))
        originals.append((MessageType(type(message)), serialize_message(message)))
    accepted = 0
    for _ in range(count):
        kind, payload = rng.choice(originals)
        try:
            kind.deserialize(damage(payload, rng))
        except RosBridgeError:
            continue
        accepted += 1
    sys.stdout.write(f"{accepted} {count - accepted}\n")


if __name__ == "__main__":
    main()
