"""What the control plane tells an operator of each sidecar."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from protos.model.ids import Version
from protos.model.members import NO_REVOCATIONS, RevocationSet

if TYPE_CHECKING:
    from collections.abc import Mapping

    from protos.model.ids import InterfaceName, NodeName, ServiceName
    from protos.model.mapping import ServiceMapping
    from protos.model.members import Peer, ServiceUse
    from protos.model.report import PathReport

_NONE_YET = Version(0)


class SyncState(enum.Enum):
    """Whether a sidecar applied what it was sent last. A nack is never shown as synced, and stays one while the same is
    sent again."""

    NOT_SENT = "not sent"
    STALE = "stale"
    SYNCED = "synced"
    REJECTED = "rejected"


@dataclass(frozen=True, slots=True)
class ResourceStatus:
    """How far one resource of one sidecar got; `error` is the detail of the last nack."""

    version_sent: Version = _NONE_YET
    version_acked: Version = _NONE_YET
    state: SyncState = SyncState.NOT_SENT
    error: str = ""


@dataclass(frozen=True, slots=True)
class StatusQuery:
    """Whose status is asked for (nobody named: everybody's), and how many are told in full though they are in order.

    0: any number.
    """

    names: tuple[NodeName, ...] = ()
    detailed_at_most: int = 0


@dataclass(frozen=True, slots=True)
class SidecarStatus:
    """What the control plane knows of one sidecar, for the operator; its secret token is left out."""

    peer: Peer
    connected: bool
    lease_left_s: float
    software_version: str
    uses: tuple[ServiceUse, ...] = ()
    peers: ResourceStatus = ResourceStatus()
    mapping: ResourceStatus = ResourceStatus()
    services: tuple[ServiceMapping, ...] = ()
    paths: tuple[PathReport, ...] = ()
    refused_offers: tuple[ServiceName, ...] = ()
    """What it offers and the policy does not let it."""
    revocations: RevocationSet = NO_REVOCATIONS
    unmet: tuple[ServiceName, ...] = ()
    """Services that its configuration names and nobody serves."""
    untyped: tuple[ServiceName, ...] = ()
    """Services that it would carry or offer if their type were installed there."""
    unreached: tuple[ServiceName, ...] = ()
    """Services that its configuration names and servers offer that it knows of, none of which it reaches."""
    down: tuple[InterfaceName, ...] = ()
    """Interfaces that it would use and that carry nothing now."""
    withdrawn: tuple[ServiceName, ...] = ()
    """Services that it offered since it registered, does not now, and that its configuration does not name."""
    unanswered: Mapping[ServiceName, int] = field(default_factory=dict)
    """How many requests in a row it had and did not answer, by service; those without any are left out."""
    abridged: bool = False
    """Its addresses, mapping and paths are left out, as it is in order and one of many."""
