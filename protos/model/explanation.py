"""Why a robot's service goes where it goes, as the control plane tells it to the operator. Times are seconds.

Samples fade, so what the control plane keeps of them are weights, not counts: histograms here count thousandths of a
sample (`SAMPLE`), and numbers of requests are floats.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from protos.base.histogram import Histogram
    from protos.model.fleet_events import Why
    from protos.model.ids import InterfaceName, NodeName, ServiceName, Version
    from protos.model.mapping import Assignment, ServiceMapping
    from protos.model.status import ResourceStatus

SAMPLE = 1000
"""What one sample that has not faded counts in a histogram."""


@dataclass(frozen=True, slots=True)
class Belief:
    """What is believed of a probability: its expectation, and the ends of the interval that holds it with 90 %."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class PairExplanation:
    """What is known of requests over one interface to one server."""

    path: Assignment
    chosen: bool
    up: bool | None
    """Whether the path was up when last reported; None if it never was reported."""
    miss: Belief | None
    """Its probability to miss the deadline as the matcher took it; None if it was no candidate."""
    requests: float
    """Requests whose outcome on this very pair is remembered."""
    probes: float
    rtt: Histogram
    network: Histogram
    """What the network took of requests of the service's sizes, whichever service they were for."""
    compute: Histogram
    """What the server needed for the service, whoever asked."""
    carrier: str = ""
    """Whose network the interface uses; empty if nobody said."""
    region: str = ""
    """Where the server stands; empty if nobody said."""
    barred: bool = False
    """The operator's path rules keep mappings from it."""
    witnesses: int = 0
    """Robots that said what the server needs."""
    busiest_witness: NodeName | None = None
    """Whose word counts for most; None without witnesses."""
    busiest_share: float = 0.0
    """For what share of all."""
    penalty_s: float = 0.0
    """The robot asks others in place of this server for so long yet, ..."""
    bad_answers: int = 0
    """... for so many answers that could not be delivered."""


class Correlation(enum.Enum):
    """Whether two interfaces miss together."""

    TOGETHER = "fail together"
    LIKELY = "seem to fail together, but too little was seen to be sure"
    INDEPENDENT = "no sign that one failing says anything of the other"


@dataclass(frozen=True, slots=True)
class JointExplanation:
    """What became of requests that went over two interfaces at once."""

    first: InterfaceName
    second: InterfaceName
    server: NodeName | None
    """Of both copies; None for those to two servers, whichever these were."""
    requests: float
    first_missed: float
    """Of these requests; estimated, above 0."""
    second_missed: float
    both_missed: float
    correlation: Correlation
    shared: tuple[str, ...] = ()
    """What the two have in common, in words."""

    @property
    def expected(self) -> float:
        """How many requests would have missed on both if the interfaces failed independently."""
        return self.first_missed * self.second_missed / self.requests

    @property
    def lift(self) -> float:
        """How many times as often as by chance both missed."""
        return self.both_missed / self.expected


class AlternativeKind(enum.Enum):
    """What is asked about another mapping."""

    OTHER = "other"
    """The best ones that are not in force."""
    ALONE = "alone"
    """One interface alone, to the server that suits it best."""
    WITHOUT = "without"
    """All interfaces, without one server."""


@dataclass(frozen=True, slots=True)
class Alternative:
    """Another mapping, and what it would give."""

    kind: AlternativeKind
    assignments: tuple[Assignment, ...]
    """None if there is no such mapping."""
    predicted_miss: float
    without: NodeName | None = None
    note: str = ""
    """What speaks against it, in words."""
    charge: float | None = None
    """What a request would cost with all its copies; None unless the service is to be cheap."""


@dataclass(frozen=True, slots=True)
class MappingChange:
    """A mapping that was sent."""

    age_s: float
    version: Version
    mapping: ServiceMapping


@dataclass(frozen=True, slots=True)
class Explanation:
    """Why a robot's requests for a service go where they go."""

    robot: NodeName
    service: ServiceName
    deadline_s: float
    idempotent: bool
    objective: str
    """What the matcher minimises, a value of the configuration key `objective`."""
    sync: ResourceStatus
    """How far the robot follows its mapping, of all its services."""
    mapping: ServiceMapping | None = None
    """As last sent; None if nothing was."""
    predicted_miss: float | None = None
    """What is predicted now; `mapping` has what was predicted when it was sent. None if nothing is planned."""
    in_force_s: float | None = None
    """Since when requests go where they go; None if that is forgotten."""
    target_miss: float = 0.0
    """Above 0: the service goes where it is cheapest as long as it misses no more often."""
    charge: float | None = None
    """What a request costs with all its copies; None unless the service is to be cheap."""
    observed_miss: float | None = None
    """Share of recent requests that missed the deadline or failed; None without any."""
    pairs: tuple[PairExplanation, ...] = ()
    pairs_left_out: int = 0
    """Pairs that were too many to be told of."""
    joints: tuple[JointExplanation, ...] = ()
    alternatives: tuple[Alternative, ...] = ()
    changes: tuple[MappingChange, ...] = ()
    """The last ones, the newest first."""
    gone_s: float | None = None
    """Since when the robot is gone: all else is what was known last, as of then. None: it is there."""
    gone_why: Why | None = None
