"""Defines what goes into the core besides messages, and what comes out of it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from plr.controlplane.core.problem.problem import Objective
from plr.controlplane.core.publish.messages import EndStream, SendMessage

if TYPE_CHECKING:
    from plr.controlplane.core.explain.departed import Departure
    from plr.controlplane.core.policy.path_rules import PathRule
    from plr.controlplane.core.policy.policy import Policy
    from plr.protos.model.ids import NodeName, Role, ServiceName
    from plr.protos.model.status import InterfaceFault
    from plr.protos.model.stream import Nack, ResourceKind


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings from the configuration."""

    lease_s: float = 5.0
    report_interval_s: float = 0.5
    warm_up_s: float = 12.0
    half_life_s: float = 60.0
    default_capacity_interfaces: int = 1
    objective: Objective = Objective.JOINT
    stun_servers: tuple[str, ...] = ()
    path_rules: tuple[PathRule, ...] = ()
    policy: Policy | None = None


@dataclass(slots=True)
class Counters:
    """Counts what happened, for the metrics."""

    nacks: Counter[ResourceKind] = field(default_factory=Counter)
    acks: Counter[ResourceKind] = field(default_factory=Counter)
    stale_answers: int = 0
    """Acks and nacks whose nonce is not the last one's."""
    reports: int = 0
    reports_ignored: int = 0
    """Reports of clouds, which measure nothing."""
    robot_offers_ignored: int = 0
    """Services that robots claim to serve: nobody calls robots."""
    report_entries_forbidden: int = 0
    """Entries of robots' reports about servers or services that they may not use."""
    interfaces_left_out: int = 0
    """Interfaces announced by robots beyond those that any mapping may use."""
    old_stream_messages: int = 0
    """Messages on a stream that is no longer the sidecar's."""
    offers_refused: int = 0
    """Newly known offers that the policy does not let their clouds make."""
    solved: int = 0
    relaxations: int = 0
    """Plans taken that exceed a capacity."""
    unproven: int = 0
    """Groups of blocks left further from their bound than wanted by the time limit."""


@dataclass(frozen=True, slots=True)
class NackNotice:
    """A sidecar refused what it was sent, for the log; a reason is told once until the sidecar takes something."""

    sidecar: NodeName
    nack: Nack


@dataclass(frozen=True, slots=True)
class DepartureNotice:
    """A sidecar is no longer present, for the log."""

    sidecar: NodeName
    departure: Departure


@dataclass(frozen=True, slots=True)
class StreamLostNotice:
    """A sidecar's stream ended but its lease has not, for the log of events."""

    sidecar: NodeName
    role: Role


@dataclass(frozen=True, slots=True)
class CutOffNotice:
    """Another policy leaves a sidecar nobody to talk to, or somebody again (`lifted`)."""

    sidecar: NodeName
    role: Role
    lifted: bool


@dataclass(frozen=True, slots=True)
class UnmetNotice:
    """A sidecar's configuration names services that nobody serves; told when they differ from before."""

    sidecar: NodeName
    services: tuple[ServiceName, ...]


@dataclass(frozen=True, slots=True)
class FaultNotice:
    """An interface of a robot is no help to it although it is up, or (`over`) this has ended."""

    sidecar: NodeName
    found: InterfaceFault
    over: bool


@dataclass(frozen=True, slots=True)
class OffersRefusedNotice:
    """A cloud offers services that the policy does not let it, for the log; each is told once."""

    sidecar: NodeName
    services: tuple[ServiceName, ...]


Event = (
    SendMessage
    | EndStream
    | NackNotice
    | DepartureNotice
    | StreamLostNotice
    | CutOffNotice
    | UnmetNotice
    | OffersRefusedNotice
    | FaultNotice
)
"""What the driver has to do, in this order."""
