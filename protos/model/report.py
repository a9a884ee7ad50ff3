"""Describes what a robot measured since its last report.

Frozen values, without IO and without protobuf. Times are seconds (float), probabilities in [0, 1], unless a name says
otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.base.histogram import Histogram
    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
    from plr.protos.model.mapping import Assignment

MAX_LATENCIES = 4096
"""Pairs (interface, server) in one report, counted separately for each service and size class that they carried."""


MAX_PATH_REPORTS = 4096
"""Paths (interface, server) in one report."""


MAX_JOINTS = 1024
"""Pairs of paths in one report: 16 services, each over 8 interfaces in turn to a few servers. Same for interfaces."""


MAX_GOODBYES = 64
"""Servers in one report that said goodbye."""


MAX_PENALTIES = 1024
"""Servers in one report whose answers could not be delivered."""


@dataclass(frozen=True, slots=True)
class LatencyReport:
    """Times of requests of one service and size class over one interface to one server since the last report.

    The histograms count a time once it is complete. `missed` counts how many of `requests` missed the service's
    deadline, which is known once that has passed.
    """

    interface: InterfaceName
    server: NodeName
    service: ServiceName
    size_class: int
    """See `plr.protos.base.size_class`."""
    network: Histogram
    """Time from sending to the answer, without the processing; lost are requests that the server never had whole."""
    called_off: Histogram
    """Times when copies were called off before the server had them: the network takes longer than that."""
    processing: Histogram
    """The server's share of the time; lost are requests that it had but did not answer."""
    requests: int = 0
    missed: int = 0


@dataclass(frozen=True, slots=True)
class PathReport:
    """State of one path, and its round-trip times since the last report."""

    interface: InterfaceName
    server: NodeName
    up: bool
    rtt: Histogram
    datagrams_sent: int = 0
    datagrams_lost: int = 0


@dataclass(frozen=True, slots=True)
class OutcomeReport:
    """Outcomes of the requests for one service since the last report."""

    service: ServiceName
    ok: int = 0
    deadline_missed: int = 0
    failed: int = 0


@dataclass(frozen=True, slots=True)
class JointReport:
    """Requests sent over two paths at once since the last report, and how many missed the deadline on both."""

    service: ServiceName
    first: Assignment
    second: Assignment
    requests: int
    both_missed: int


@dataclass(frozen=True, slots=True)
class InterfaceJointReport:
    """Requests that went over two interfaces at once since the last report, and how many missed the deadline on both.

    An interface over which no path is up counts as missed. On which one alone a request missed is only known for full
    `races`, in which no copy is called off before the deadline.
    """

    service: ServiceName
    first: InterfaceName
    second: InterfaceName
    server: NodeName | None
    """Server of both copies; None for all other requests."""
    requests: int
    both_missed: int
    races: int
    only_first_missed: int
    only_second_missed: int


@dataclass(frozen=True, slots=True)
class PenaltyReport:
    """A server whose answers could not be delivered: whatever the mapping says, others are preferred."""

    server: NodeName
    left_s: float
    """How much longer the penalty lasts."""
    bad_answers: int = 1
    """Bad answers that it is penalised for; those of two minutes ago count half."""


@dataclass(frozen=True, slots=True)
class Report:
    """Everything a robot sidecar measured since its last report."""

    latencies: tuple[LatencyReport, ...] = ()
    paths: tuple[PathReport, ...] = ()
    outcomes: tuple[OutcomeReport, ...] = ()
    joints: tuple[JointReport, ...] = ()
    interface_joints: tuple[InterfaceJointReport, ...] = ()
    penalties: tuple[PenaltyReport, ...] = ()
    """All penalties in force."""
    goodbyes: tuple[NodeName, ...] = ()
    """Servers that said goodbye to this robot and are still listed, or were until its last report."""
    changes_only: bool = False
    """Whether it covers only paths that went up or down, and no other measurement."""
    continues: bool = False
    """Whether this is a further part of a report, which holds no penalties."""
    more: bool = False
    """Whether further parts of the report follow."""
    servers_before: frozenset[NodeName] = frozenset()
    """Servers of the paths in the earlier parts."""
