"""What a robot measured since its last report.

Frozen values, without IO and without protobuf. Times are seconds (float), probabilities in [0, 1], unless a name says
otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from protos.base.histogram import Histogram
    from protos.model.ids import InterfaceName, NodeName, ServiceName
    from protos.model.mapping import Assignment

MAX_LATENCIES = 4096
"""Pairs (interface, server) in one report, counted anew for each service and size class that they carried."""


MAX_PATHS = 4096
"""Paths (interface, server) in one report."""


MAX_JOINTS = 1024
"""Pairs of paths in one report: 16 services, each over 8 interfaces in turn to a few servers. As many of interfaces."""


MAX_GOODBYES = 64
"""Servers in one report that said goodbye."""


MAX_PENALTIES = 1024
"""Servers in one report whose answers could not be delivered."""


@dataclass(frozen=True, slots=True)
class LatencyReport:
    """What requests of one service and size class took over one interface to one server since the last report.

    Beside the histograms, which know a time when it is over: how many of `requests` missed the service's deadline,
    known when that is over.
    """

    interface: InterfaceName
    server: NodeName
    service: ServiceName
    size_class: int
    """See `protos.base.size_class`."""
    network: Histogram
    """From sending to the answer, without the processing; lost is what the server never had whole."""
    called_off: Histogram
    """When copies were called off that the server did not have yet: the network takes longer than that."""
    processing: Histogram
    """The server's share; lost is what it had and did not answer."""
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
    """What became of the requests for one service since the last report."""

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

    An interface over which no path is up counts as missed. Which one alone a request missed is known of full `races`
    only, in which no copy is called off before the deadline.
    """

    service: ServiceName
    first: InterfaceName
    second: InterfaceName
    server: NodeName | None
    """Of both copies; None for all other requests."""
    requests: int
    both_missed: int
    races: int
    only_first_missed: int
    only_second_missed: int


@dataclass(frozen=True, slots=True)
class PenaltyReport:
    """A server whose answers could not be delivered: whatever the mapping says, others go before it."""

    server: NodeName
    left_s: float
    """For how long yet."""
    bad_answers: int = 1
    """That it is penalised for; half of what lies two minutes back."""


@dataclass(frozen=True, slots=True)
class Report:
    """Everything a robot sidecar measured since its last report."""

    latencies: tuple[LatencyReport, ...] = ()
    paths: tuple[PathReport, ...] = ()
    outcomes: tuple[OutcomeReport, ...] = ()
    joints: tuple[JointReport, ...] = ()
    interface_joints: tuple[InterfaceJointReport, ...] = ()
    penalties: tuple[PenaltyReport, ...] = ()
    """All that are in force."""
    goodbyes: tuple[NodeName, ...] = ()
    """Servers that said goodbye to this robot and are listed yet, or were until its last report."""
    changes_only: bool = False
    """Whether it tells of no other paths than those that went up or down, and of nothing else that was measured."""
    continues: bool = False
    """Whether this is a further part of a report, which says nothing of penalties."""
    more: bool = False
    """Whether further parts of the report follow."""
    servers_before: frozenset[NodeName] = frozenset()
    """Servers of the paths in the parts before this one."""
