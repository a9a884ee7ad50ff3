"""Name and liveness of a path."""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from protos.model import InterfaceId, InterfaceName, NodeName


class PathId(NamedTuple):
    """A path: our interface, the peer, and the peer's interface."""

    interface: InterfaceName
    peer: NodeName
    remote: InterfaceId


class PathState(enum.Enum):
    """Liveness of a path."""

    DOWN = "down"
    """Not validated, or silent for long: only probes travel."""
    UP = "up"
    UNSTABLE = "unstable"
    """Silent longer than its round-trip time explains: still used, but not relied on."""
