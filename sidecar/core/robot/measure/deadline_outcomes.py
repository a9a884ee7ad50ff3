"""Which copies of a request missed its deadline, each by itself and two together: what the mapping is chosen by.

To be free of bias, which requests count is settled when they are sent, without regard to what becomes of them. A full
race counts for each of its copies and for every pair of them. A request with two copies to two servers always counts
for the pair: of a loser that was called off nobody knows how long it would have taken, but that not both have missed.
With more copies, or a single server (which may be hedged), that is known only by chance. Copies sent later, in trouble,
started late and count for nothing; if one of them won, the paths of those before it were not up, and they count as
missed. What a server refused says nothing of paths.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

from protos.model.mapping import Assignment
from sidecar.core.robot.measure.interface_outcomes import interface_outcomes
from sidecar.core.robot.request.request import CopyState

if TYPE_CHECKING:
    from protos.model.ids import InterfaceName, NodeName
    from sidecar.core.robot.measure.measurements import Measurements
    from sidecar.core.robot.request.request import Copy, Request


def measure_outcomes(request: Request, measurements: Measurements) -> None:
    """Count, once, what missed: when the deadline is over or every copy has ended."""
    if request.outcomes_measured:
        return
    request.outcomes_measured = True
    for interfaces, outcome in interface_outcomes(request):
        measurements.judged_interfaces(interfaces, outcome)
    copies = request.started_together()
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
