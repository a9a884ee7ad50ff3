"""Over which two of the robot's interfaces requests missed their deadline together: what these have in common.

Paths that are down carry nothing, so of them no copy tells. Of interfaces that tells most: where both are without any
path at once, they are likely to share what failed. So an interface over which none was up when the request came counts
as missed, unless a copy was answered over it in time after all. Services that do not send over every interface anyway
are an exception: of them such requests would count only when something is down.

Which requests count is settled as in `deadline_outcomes`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

from protos.model.redundancy_mode import RedundancyMode
from protos.model.report import InterfaceJointReport
from sidecar.core.robot.request.request import CopyState

if TYPE_CHECKING:
    from collections.abc import Iterator

    from protos.model.ids import InterfaceName, NodeName, ServiceName
    from sidecar.core.robot.request.request import Request


@dataclass(frozen=True, slots=True)
class InterfacePair:
    """Two interfaces and, if both copies go to one server, that server."""

    service: ServiceName
    first: InterfaceName
    second: InterfaceName
    """After the first in the order of their names."""
    server: NodeName | None


@dataclass(frozen=True, slots=True)
class PairOutcome:
    """What became of one request."""

    first_missed: bool
    second_missed: bool
    raced: bool
    """It was chosen to be a full race. Else that one missed alone means nothing: the copy may have been called off."""


class JointCounts:
    """Of all requests over two interfaces since the last report."""

    __slots__ = ("both_missed", "only_first_missed", "only_second_missed", "races", "requests")

    def __init__(self) -> None:
        self.requests = self.both_missed = self.races = self.only_first_missed = self.only_second_missed = 0

    def add(self, outcome: PairOutcome) -> None:
        """Count a request."""
        self.requests += 1
        self.both_missed += outcome.first_missed and outcome.second_missed
        if outcome.raced:
            self.races += 1
            self.only_first_missed += outcome.first_missed and not outcome.second_missed
            self.only_second_missed += outcome.second_missed and not outcome.first_missed

    def report(self, pair: InterfacePair) -> InterfaceJointReport:
        """What the control plane is told."""
        return InterfaceJointReport(
            pair.service,
            pair.first,
            pair.second,
            pair.server,
            self.requests,
            self.both_missed,
            self.races,
            self.only_first_missed,
            self.only_second_missed,
        )


def interface_outcomes(request: Request) -> Iterator[tuple[InterfacePair, PairOutcome]]:
    """What a request tells whose deadline is over, or whose copies have all ended."""
    missed: dict[InterfaceName, bool] = {}
    servers: dict[InterfaceName, NodeName] = {}
    for copy in request.started_together():
        if copy.state is CopyState.REJECTED:
            return
        if copy.path.interface not in missed:
            missed[copy.path.interface] = not copy.in_time
            servers[copy.path.interface] = copy.path.peer
    if request.rule.redundancy is RedundancyMode.REPLICATE:
        for interface in request.dark:
            if interface not in missed:
                missed[interface] = not any(copy.in_time for copy in request.copies if copy.path.interface == interface)
    raced = request.is_race()
    to_one = len(servers) > 1 and len(set(servers.values())) == 1
    if not raced and (len(missed) != 2 or to_one):
        return
    for first, second in combinations(sorted(missed), 2):
        server = servers.get(first)
        both = server if server == servers.get(second) else None
        yield InterfacePair(request.service, first, second, both), PairOutcome(missed[first], missed[second], raced)
