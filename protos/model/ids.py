"""Defines the names and numbers that both planes use: typed identifiers and the protocol's version.

Frozen values, without IO and without protobuf. Times are seconds (float), probabilities in [0, 1], unless a name says
otherwise.
"""

from __future__ import annotations

import enum
from typing import NewType

PROTOCOL_VERSION = 3
"""Newest version of the control stream and of the datagram layout spoken here; peers of another version are refused."""


OLDEST_PROTOCOL_VERSION = 3
"""The oldest version spoken here; normally the one before the newest, but version 2 was never released."""


NodeName = NewType("NodeName", str)
"""Name of a sidecar, unique in the mesh."""


InterfaceName = NewType("InterfaceName", str)
"""Name of a network interface of one sidecar, such as wlan0."""


InterfaceId = NewType("InterfaceId", int)
"""Number of an interface, 0 to 255, stable within one session."""


ServiceName = NewType("ServiceName", str)
"""Fully qualified ROS service name, such as /plan_path."""


SessionId = NewType("SessionId", int)
"""64-bit number of one run of a sidecar, in the header of every datagram it sends."""


Version = NewType("Version", int)
"""Version of a pushed resource; only grows. 0 means none."""

NO_VERSION = Version(0)


Address = tuple[str, int]
"""IP address in canonical text form, and UDP port; IPv4-mapped IPv6 addresses are written as IPv4."""


MAX_VERSION = (1 << 63) - 1
"""Largest version of a resource: half of the field's range, so that a larger one can always be issued."""


class Role(enum.Enum):
    """What a sidecar is for."""

    ROBOT = "robot"
    CLOUD = "cloud"
