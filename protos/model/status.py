"""Describes what the control plane tells an operator about each sidecar."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from plr.protos.model.ids import Version
from plr.protos.model.members import NO_REVOCATIONS, RevocationSet

if TYPE_CHECKING:
    from collections.abc import Mapping

    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
    from plr.protos.model.mapping import ServiceMapping
    from plr.protos.model.members import Peer, ServiceUse
    from plr.protos.model.report import PathReport

_NONE_YET = Version(0)


class SyncState(enum.Enum):
    """Whether a sidecar applied what it was last sent.

    A nack is never shown as synced, and stays a nack while the same content is sent again.
    """

    NOT_SENT = "not sent"
    STALE = "stale"
    SYNCED = "synced"
    REJECTED = "rejected"


@dataclass(frozen=True, slots=True)
class ResourceStatus:
    """Progress of one resource of one sidecar; `error` is the detail of the last nack."""

    version_sent: Version = _NONE_YET
    version_acked: Version = _NONE_YET
    state: SyncState = SyncState.NOT_SENT
    error: str = ""


class Fault(enum.Enum):
    """What is wrong with an interface that another one of the robot makes up for."""

    FLAPPING = "flapping"
    """A path over it goes up and down all the time."""
    USELESS = "useless"
    """A path over it is up, but nothing arrives in time, or most is lost."""


@dataclass(frozen=True, slots=True)
class InterfaceFault:
    """What is wrong with one interface of a robot."""

    interface: InterfaceName
    fault: Fault
    text: str
    """Details, for people."""


@dataclass(frozen=True, slots=True)
class StatusQuery:
    """Whose status to return (everybody's if no name is given), and how many of those in order to describe in full.

    0 means any number.
    """

    names: tuple[NodeName, ...] = ()
    detailed_at_most: int = 0


@dataclass(frozen=True, slots=True)
class SidecarStatus:
    """What the control plane knows about one sidecar, for the operator, without its secret token."""

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
    """Services that it offers but the policy does not allow."""
    revocations: RevocationSet = NO_REVOCATIONS
    unmet: tuple[ServiceName, ...] = ()
    """Services that its configuration names but nobody serves."""
    untyped: tuple[ServiceName, ...] = ()
    """Services that it would carry or offer if their type were installed there."""
    unreached: tuple[ServiceName, ...] = ()
    """Services that its configuration names and known servers offer, none of which it reaches."""
    down: tuple[InterfaceName, ...] = ()
    """Interfaces that it would use but that carry nothing now."""
    faults: tuple[InterfaceFault, ...] = ()
    """What is wrong with its other interfaces."""
    withdrawn: tuple[ServiceName, ...] = ()
    """Services that it has offered since it registered, no longer offers, and its configuration does not name."""
    unanswered: Mapping[ServiceName, int] = field(default_factory=dict)
    """Number of consecutive requests that it had but did not answer, by service; services without any are left out."""
    abridged: bool = False
    """Whether its addresses, mapping and paths are left out, as it is in order and one of many."""
