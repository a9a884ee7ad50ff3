"""Defines the remaining messages of the control stream.

Frozen values, without IO and without protobuf. Times are seconds (float), probabilities in [0, 1], unless a name says
otherwise.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import CandidateSet, PeerSet, Registration, RevocationSet, ServiceSet
from plr.protos.model.report import Report

if TYPE_CHECKING:
    from plr.protos.model.ids import Version


class ResourceKind(enum.Enum):
    """What the control plane pushes."""

    PEERS = "peers"
    MAPPING = "mapping"


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """A message that renews the lease, as every other message does."""


@dataclass(frozen=True, slots=True)
class Drain:
    """The sidecar finishes its requests in flight and leaves."""


@dataclass(frozen=True, slots=True)
class Welcome:
    """The control plane's answer to a registration, sent again when any of it changes.

    `stun_servers` are host:port strings; `crl` holds the fleet's revocation lists (PEM, signed by its CAs; may be
    empty).
    """

    lease_s: float
    report_interval_s: float
    stun_servers: tuple[str, ...] = ()
    crl: bytes = field(default=b"", repr=False)
    reconnect_max_s: float = 0.0
    """Longest interval between two attempts to reconnect; 0 if not given."""


@dataclass(frozen=True, slots=True)
class Ack:
    """`version` was applied."""

    resource: ResourceKind
    version: Version
    nonce: int


@dataclass(frozen=True, slots=True)
class Nack:
    """The content sent with `nonce` is refused; `version` is still in force."""

    resource: ResourceKind
    version: Version
    nonce: int
    error: str


SidecarMessage = Registration | CandidateSet | ServiceSet | Report | Ack | Nack | Heartbeat | Drain | RevocationSet
"""Messages of a sidecar on its stream: first one Registration."""


ControlMessage = Welcome | PeerSet | MappingSet
"""Messages of the control plane on a sidecar's stream."""
