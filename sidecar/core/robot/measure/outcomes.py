"""Counts which copies of a request missed its deadline: each by itself, and two together.

To avoid bias, which requests count is settled when they are sent, regardless of their outcome. A full race counts for
each of its copies and for every pair of them. A request with two copies to two servers always counts for the pair: how
long a called-off loser would have taken is unknown, but not both have missed. With more copies, or a single server
(which may be hedged), that is known only by chance. Copies sent later, in trouble, started late and do not count; if
one of them won, the paths of those before it were not up, and they count as missed. A copy that a server refused tells
nothing about paths.

Paths that are down carry no copy, so no copy measures them. Two interfaces that have no path at the same time probably
share what failed. So an interface over which no path was up when the request came counts as missed, unless a copy was
answered over it in time after all. Services that do not send over every interface are an exception: such requests would
count only while something is down.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

from plr.protos.model.mapping import Assignment
from plr.protos.model.redundancy_mode import RedundancyMode
from plr.sidecar.core.robot.measure.measurements import InterfacePair, PairOutcome
from plr.sidecar.core.robot.request.request import CopyState

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from plr.protos.model.ids import InterfaceName, NodeName
    from plr.sidecar.core.robot.measure.measurements import Measurements
    from plr.sidecar.core.robot.request.request import Copy, Request


def interface_outcomes(request: Request, copies: Iterable[Copy]) -> Iterator[tuple[InterfacePair, PairOutcome]]:
    """Yield the outcomes per pair of interfaces of a request whose deadline is over or whose copies have all ended.

    `copies` are those that started together.
    """
    missed: dict[InterfaceName, bool] = {}
    servers: dict[InterfaceName, NodeName] = {}
    for copy in copies:
        if copy.state is CopyState.REJECTED:
            return
        if copy.path.interface not in missed:
            missed[copy.path.interface] = not copy.in_time
            servers[copy.path.interface] = copy.path.peer
    if request.rule.redundancy is RedundancyMode.REPLICATE:
        for interface in request.dark:
            if interface not in missed:
                missed[interface] = not any(copy.in_time for copy in request.copies if copy.path.interface == interface)
    raced = request.races
    to_one = len(servers) > 1 and len(set(servers.values())) == 1
    if not raced and (len(missed) != 2 or to_one):
        return
    for first, second in combinations(sorted(missed), 2):
        server = servers.get(first)
        both = server if server == servers.get(second) else None
        yield InterfacePair(request.service, first, second, both), PairOutcome(missed[first], missed[second], raced)


def measure_outcomes(request: Request, measurements: Measurements) -> None:
    """Count what missed, once, when the deadline is over or every copy has ended."""
    if request.outcomes_measured:
        return
    request.outcomes_measured = True
    copies = request.started_together()
    for interfaces, outcome in interface_outcomes(request, copies):
        measurements.judged_interfaces(interfaces, outcome)
    accepted = [copy for copy in copies if copy.state is not CopyState.REJECTED]
    if request.observed:
        for copy in accepted:
            measurements.judged(request.carried(copy), missed=not copy.in_time)
    elif len(copies) != 2 or copies[0].path.peer == copies[1].path.peer:
        return
    if len(accepted) < len(copies):
        return
    for one, other in combinations(copies, 2):
        first, second = sorted((_assignment(one), _assignment(other)))
        if first == second:
            continue
        both_missed = not (one.in_time or other.in_time)
        measurements.judged_together(request.service, Assignment(*first), Assignment(*second), both_missed=both_missed)


def _assignment(copy: Copy) -> tuple[InterfaceName, NodeName]:
    return copy.path.interface, copy.path.peer
