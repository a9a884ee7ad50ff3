"""By how much a block misses its target, and what would meet it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from controlplane.core.costs import meets
from controlplane.core.objectives import PROBABILITY_FLOOR, joint_miss

if TYPE_CHECKING:
    from controlplane.core.problem import Block, Choice

MAX_CARRIERS = 8
"""Carriers more than this are no advice."""

_STEPS = (1, 2, 5, 10)


def shortfall(block: Block, choice: Choice) -> str:
    """What to tell of a choice that misses the block's target; empty if it does not, or there is none.

    Figures are rounded up to 1, 2 or 5 times a power of ten: the text must not change with every report.
    """
    miss = joint_miss(block, choice)
    if block.target is None or meets(block.target, math.log(miss)):
        return ""
    times = _rounded_up(miss / block.target.miss)
    remedy = _remedy(block, choice, miss, block.target.miss)
    return f"misses the target of {block.target.miss:g} up to {times:g} times too often; {remedy}"


def _remedy(block: Block, choice: Choice, miss: float, target: float) -> str:
    """The first that would do: another server, another carrier, several."""
    best = [
        min((max(epsilon, PROBABILITY_FLOOR), j) for j, epsilon in enumerate(row) if epsilon is not None)
        for row in block.epsilon
    ]
    found = []
    for i, (epsilon, j) in enumerate(best):
        others = tuple(None if k == i else server for k, server in enumerate(choice))
        if any(server is not None for server in others) or choice[i] is not None:
            found.append((joint_miss(block, others) * epsilon, i, j))
    with_server, i, j = min(found)
    if with_server <= target:
        name = block.interfaces[i]
        return f"a server of its own for {name}, as good as {block.servers[j]} and failing independently, would meet it"
    epsilon, i = min((epsilon, i) for i, (epsilon, _) in enumerate(best))
    more = math.ceil(math.log(target / miss) / math.log(epsilon) - 1e-9) if epsilon < 1.0 else math.inf
    if more > MAX_CARRIERS:
        return f"not even {MAX_CARRIERS} more carriers as good as {block.interfaces[i]} would meet it"
    carriers = "one more carrier" if more == 1 else f"{more} more carriers"
    return f"{carriers} as good as {block.interfaces[i]}, failing independently, would meet it"


def _rounded_up(times: float) -> float:
    power = 10.0 ** math.floor(math.log10(times))
    return next(step * power for step in _STEPS if times <= step * power * (1 + 1e-9))
