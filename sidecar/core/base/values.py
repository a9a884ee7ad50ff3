"""Defines the values that every part of the core uses: identities, states, priorities and reasons."""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING, NamedTuple, NewType

if TYPE_CHECKING:
    from plr.protos.model.ids import InterfaceId, InterfaceName, NodeName

RequestId = NewType("RequestId", bytes)
"""16 bytes that name one request forever; see `request_id.py`."""

ExecutionId = NewType("ExecutionId", int)
"""Number of one execution on a cloud sidecar, unique within its session."""


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


class Priority(enum.IntEnum):
    """How urgent a service is: more urgent traffic goes first, whatever the deadlines.

    Smaller is more urgent, so that queues sort by it; the numbers are part of the wire format.
    """

    HIGH = 0
    NORMAL = 1
    LOW = 2


SHARE = 16
"""A waiting lower priority gets one symbol for this many of the higher ones."""


class RejectReason(enum.IntEnum):
    """Why a cloud sidecar did not run a request; the numbers are part of the wire format."""

    NOT_OFFERED = 1
    """No local server for this service."""
    WRONG_TYPE = 2
    """The service exists with another type."""
    BAD_PAYLOAD = 3
    """The bytes are not a request of this type."""
    OVERLOADED = 4
    """A table is full."""
    DRAINING = 5
    """The sidecar is shutting down."""
    SERVER_LOST = 6
    """The local server went away or gave no answer in time: the request may have run."""
    FORGOTTEN = 7
    """It ran, but the cached answer has been dropped."""
    TOO_LARGE = 8
    """It ran, but its answer is larger than a message may be."""
    CANCELLED = 9
    """The robot called it off before the local server got it."""
    FORBIDDEN = 10
    """The access policy does not let this robot call this service here."""

    @property
    def certainly_not_run(self) -> bool:
        """Whether another server may run the request without breaking at-most-once for it."""
        return self not in (RejectReason.SERVER_LOST, RejectReason.FORGOTTEN, RejectReason.TOO_LARGE)

    @property
    def may_pass(self) -> bool:
        """Whether the same server, or one that takes its place, may run the request in a moment."""
        return self in (RejectReason.NOT_OFFERED, RejectReason.DRAINING)
