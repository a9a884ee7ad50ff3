"""Chooses which of a robot's many interfaces a service's mapping may use.

A request goes out in a handful of copies, however many interfaces there are, and the number of choices grows
exponentially with them: with ten, a single robot's would hold up the mappings of all others.
"""

from __future__ import annotations

import itertools
from collections import Counter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from plr.controlplane.core.estimate.posterior import Estimate
    from plr.controlplane.core.problem.problem import Block
    from plr.controlplane.core.registry.registry import Sidecar
    from plr.protos.model.ids import InterfaceName, NodeName
    from plr.protos.model.members import ServiceUse

MAX_PLANNED = 8
"""Interfaces of one robot in one mapping: the maximum number of copies a robot sends of a request."""

STAYS = 0.5
"""Factor on the miss probability of an interface taken before, so that no two take turns by chance."""


def most_promising(
    robot: Sidecar,
    use: ServiceUse,
    interfaces: tuple[InterfaceName, ...],
    estimates: Mapping[tuple[InterfaceName, NodeName], Estimate],
    before: Block | None,
) -> tuple[InterfaceName, ...]:
    """Return up to `MAX_PLANNED` of these interfaces, in their order.

    Take in turn the one that misses least, one of each carrier first, and, for a service to be cheap, the cheapest.
    """
    if len(interfaces) <= MAX_PLANNED:
        return interfaces
    had = before.interfaces if before is not None else ()
    least = dict.fromkeys(interfaces, 1.0)
    for (interface, _), estimate in estimates.items():
        least[interface] = min(least[interface], estimate.mean * (STAYS if interface in had else 1.0))
    labels = {label.interface: label for label in robot.labels}
    best_first = sorted(interfaces, key=lambda interface: least[interface])
    behind: Counter[str] = Counter()
    turn: dict[InterfaceName, int] = {}
    for interface in best_first:
        carrier = labels[interface].carrier if interface in labels else ""
        turn[interface] = behind[carrier] if carrier else 0
        behind[carrier] += 1
    rankings = [sorted(best_first, key=lambda interface: turn[interface])]
    if use.target_miss:
        rankings.append(
            sorted(best_first, key=lambda interface: labels[interface].cost_per_request if interface in labels else 1.0)
        )
    order = dict.fromkeys(itertools.chain.from_iterable(zip(*rankings, strict=True)))
    taken = set(itertools.islice(order, MAX_PLANNED))
    return tuple(interface for interface in interfaces if interface in taken)
