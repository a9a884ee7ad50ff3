"""Says by how much a block misses its target, and what would meet it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from plr.controlplane.core.problem.costs import meets
from plr.controlplane.core.problem.objectives import PROBABILITY_FLOOR, joint_miss

if TYPE_CHECKING:
    from plr.controlplane.core.problem.problem import Block, Choice

MAX_CARRIERS = 8
"""More carriers than this are no advice."""

_STEPS = (1, 2, 5, 10)


def shortfall(block: Block, choice: Choice) -> str:
    """Return what to report of a choice that misses the block's target; empty if it does not, or there is none.

    Figures are rounded up to 1, 2 or 5 times a power of ten: the text must not change with every report.
    """
    miss = joint_miss(block, choice)
    if block.target is None or meets(block.target, math.log(miss)):
        return ""
    target = block.target.miss
    remedy = _another_server(block, choice, target) or _more_carriers(block, choice, target / miss)
    return f"misses the target of {target:g} up to {_rounded_up(miss / target):g} times too often; {remedy}"


def _another_server(block: Block, choice: Choice, target: float) -> str:
    """Return whether one more server, for one of the interfaces that carry a copy, would do, as text. All copies of a
    service that is not idempotent go to one server, so one more would take its place."""
    if not block.idempotent:
        return ""
    found = []
    for i, server in enumerate(choice):
        if server is not None:
            epsilon, best = _best_server(block, i)
            others = tuple(None if k == i else other for k, other in enumerate(choice))
            found.append((joint_miss(block, others) * epsilon, i, best))
    miss, i, best = min(found)
    if miss > target:
        return ""
    name = block.interfaces[i]
    return f"a server of its own for {name}, as good as {block.servers[best]} and failing independently, would meet it"


def _more_carriers(block: Block, choice: Choice, factor: float) -> str:
    """Return how many more carriers would multiply the miss probability by `factor`, as text."""
    if block.idempotent:
        epsilon, i = min((_best_server(block, i)[0], i) for i in range(len(block.interfaces)))
    else:
        used = [(i, server) for i, server in enumerate(choice) if server is not None]
        epsilon, i = min((max(block.epsilon[i][server] or 0.0, PROBABILITY_FLOOR), i) for i, server in used)
    more = math.ceil(math.log(factor) / math.log(epsilon) - 1e-9) if epsilon < 1.0 else math.inf
    as_good = f"as good as {block.interfaces[i]}"
    if more > MAX_CARRIERS:
        return f"not even {MAX_CARRIERS} more carriers {as_good} would meet it"
    carriers = "one more carrier" if more == 1 else f"{more} more carriers"
    copies = " and with as many more copies" if block.copies.most else ""
    return f"{carriers} {as_good}, failing independently{copies}, would meet it"


def _best_server(block: Block, interface: int) -> tuple[float, int]:
    """Return its epsilon and its index."""
    row = block.epsilon[interface]
    return min((max(epsilon, PROBABILITY_FLOOR), j) for j, epsilon in enumerate(row) if epsilon is not None)


def _rounded_up(times: float) -> float:
    power = 10.0 ** math.floor(math.log10(times))
    return next(step * power for step in _STEPS if times <= step * power * (1 + 1e-9))
