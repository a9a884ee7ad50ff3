"""The messages of the control stream beside those sets.

Frozen values, without IO and without protobuf. Times are seconds (float), probabilities in [0, 1], unless a name says
otherwise.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from protos.model.mapping import MappingSet
from protos.model.members import CandidateSet, PeerSet, Registration, RevocationSet, ServiceSet
from protos.model.report import Report

if TYPE_CHECKING:
    from protos.model.ids import Version


class ResourceKind(enum.Enum):
    """What the control plane pushes."""

    PEERS = "peers"
    MAPPING = "mapping"


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """Renews the lease, as every other message does."""


@dataclass(frozen=True, slots=True)
class Drain:
    """The sidecar finishes what is in flight and goes."""


@dataclass(frozen=True, slots=True)
class Welcome:
    """The control plane's answer to a registration, sent again when any of it changes.

    `stun_servers` are host:port strings, `crl` what the fleet's CAs have revoked (PEM, signed by them; may be empty).
    """

    lease_s: float
    report_interval_s: float
    stun_servers: tuple[str, ...] = ()
    crl: bytes = field(default=b"", repr=False)
    reconnect_max_s: float = 0.0
    """The most between two attempts to connect again; 0: not told."""


@dataclass(frozen=True, slots=True)
class Ack:
    """`version` was applied."""

    resource: ResourceKind
    version: Version
    nonce: int


@dataclass(frozen=True, slots=True)
class Nack:
    """What was sent with `nonce` is refused; `version` is still in force."""

    resource: ResourceKind
    version: Version
    nonce: int
    error: str


SidecarMessage = Registration | CandidateSet | ServiceSet | Report | Ack | Nack | Heartbeat | Drain | RevocationSet
"""What a sidecar says on its stream; a Registration first, once."""


ControlMessage = Welcome | PeerSet | MappingSet
"""What the control plane says on a sidecar's stream."""
