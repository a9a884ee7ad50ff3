"""Explains to the operator why a robot's service is mapped as it is. Times are in seconds.

Samples fade, so the control plane keeps weights, not counts, of them: histograms here count thousandths of a sample
(`SAMPLE`), and numbers of requests are floats.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.base.histogram import Histogram
    from plr.protos.model.fleet_events import Why
    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName, Version
    from plr.protos.model.mapping import Assignment, ServiceMapping
    from plr.protos.model.redundancy_mode import RedundancyMode
    from plr.protos.model.status import ResourceStatus

SAMPLE = 1000
"""Weight of a sample that has not faded in a histogram."""


@dataclass(frozen=True, slots=True)
class Belief:
    """An estimate of a probability: its expectation and its 90 % interval."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class PairExplanation:
    """What is known about requests over one interface to one server."""

    path: Assignment
    chosen: bool
    up: bool | None
    """Whether the path was up when last reported; None if it never was reported."""
    miss: Belief | None
    """Probability of a missed deadline that the matcher used; None if the pair was no candidate."""
    requests: float
    """Requests whose outcome on exactly this pair is remembered."""
    probes: float
    rtt: Histogram
    network: Histogram
    """Network times of requests of the service's sizes, for any service."""
    compute: Histogram
    """Times that the server needed for the service, for any robot."""
    carrier: str = ""
    """Carrier whose network the interface uses; empty if unknown."""
    region: str = ""
    """Region of the server; empty if unknown."""
    barred: bool = False
    """Whether the operator's path rules forbid it in mappings."""
    witnesses: int = 0
    """Number of robots that reported the server's times."""
    busiest_witness: NodeName | None = None
    """The robot whose reports count most; None without witnesses."""
    busiest_share: float = 0.0
    """That robot's share of all reports."""
    penalty_s: float = 0.0
    """How much longer the robot prefers others to this server, ..."""
    bad_answers: int = 0
    """... because of this many answers that could not be delivered."""


class Correlation(enum.Enum):
    """Whether two interfaces miss together."""

    TOGETHER = "fail together"
    LIKELY = "seem to fail together, but too little was seen to be sure"
    INDEPENDENT = "no sign that one failing says anything of the other"


@dataclass(frozen=True, slots=True)
class JointExplanation:
    """Outcomes of requests that went over two interfaces at once."""

    first: InterfaceName
    second: InterfaceName
    server: NodeName | None
    """Server of both copies; None for requests to any two servers."""
    requests: float
    first_missed: float
    """Number of these requests; estimated, above 0."""
    second_missed: float
    both_missed: float
    correlation: Correlation
    shared: tuple[str, ...] = ()
    """What the two have in common, in words."""

    @property
    def expected(self) -> float:
        """Number of requests that would have missed on both if the interfaces failed independently."""
        return self.first_missed * self.second_missed / self.requests

    @property
    def lift(self) -> float:
        """Ratio of joint misses to those expected by chance."""
        return self.both_missed / self.expected


class AlternativeKind(enum.Enum):
    """Which alternatives to a mapping are considered."""

    OTHER = "other"
    """The best mappings that are not in force."""
    ALONE = "alone"
    """One interface alone, to the server that suits it best."""
    WITHOUT = "without"
    """All interfaces, without one server."""


@dataclass(frozen=True, slots=True)
class Alternative:
    """Another mapping, and its predicted result."""

    kind: AlternativeKind
    assignments: tuple[Assignment, ...]
    """Empty if there is no such mapping."""
    predicted_miss: float
    without: NodeName | None = None
    note: str = ""
    """Objections to it, in words."""
    cost_per_request: float | None = None
    """Cost of a request with all its copies; None unless the service is in mode cheapest."""


@dataclass(frozen=True, slots=True)
class MappingChange:
    """A mapping that was sent."""

    age_s: float
    version: Version
    mapping: ServiceMapping


@dataclass(frozen=True, slots=True)
class Explanation:
    """Why a robot's requests for a service are mapped as they are."""

    robot: NodeName
    service: ServiceName
    deadline_s: float
    idempotent: bool
    objective: str
    """What the matcher minimises, a value of the configuration key `objective`."""
    sync: ResourceStatus
    """How far the robot has applied its mapping, which covers all its services."""
    mapping: ServiceMapping | None = None
    """The mapping last sent; None if none was."""
    predicted_miss: float | None = None
    """Current prediction; `mapping` has the one from when it was sent. None if nothing is planned."""
    in_force_s: float | None = None
    """How long the current assignments have been in force; None if that is forgotten."""
    target_miss: float = 0.0
    """Above 0: the cheapest mapping that misses no more often is chosen."""
    cost_per_request: float | None = None
    """Cost of a request with all its copies; None unless the service is in mode cheapest."""
    observed_miss: float | None = None
    """Share of recent requests that missed the deadline or failed; None without any."""
    pairs: tuple[PairExplanation, ...] = ()
    pairs_left_out: int = 0
    """Number of pairs left out because there were too many."""
    joints: tuple[JointExplanation, ...] = ()
    alternatives: tuple[Alternative, ...] = ()
    changes: tuple[MappingChange, ...] = ()
    """The last mappings sent, newest first."""
    redundancy: RedundancyMode | None = None
    """How the robot sends copies of a request over the mapped pairs; None if the control plane does not say so."""
    gone_s: float | None = None
    """How long the robot has been gone; everything else is then as last known. None if it is not gone."""
    gone_why: Why | None = None
