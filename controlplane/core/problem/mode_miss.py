"""Estimates how likely a request misses its deadline in the way its service sends copies (docs/use/redundancy.md).

The mapping is chosen as if every pair in it carried a copy at once. That is what `replicate` does. `share` counts as
`replicate`: its paths carry parts of one copy, and in spare time each repeats what the others carry. The other modes
miss more. This module says how much, for what the operator is told. With first pair f and second pair s:

    single     epsilon_f
    others     epsilon_f q, where q is the probability that what follows a first copy that misses comes too late as well

Before anything is known, q is 1 for `backup`, and where a budget may keep the second copy back. For `hedge` and
`adaptive` it is L_s lift_fs, at least `TOGETHER`; L_s is the probability that a copy over s, sent later by the delay,
misses what is left of the deadline. The outcomes of earlier requests move it (`late_fate`). Only the robot knows which
pair a request goes over first: each counts by the requests that it carried recently.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plr.controlplane.core.problem.objectives import PROBABILITY_FLOOR, joint_miss
from plr.protos.model.redundancy_mode import RedundancyMode

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from plr.controlplane.core.problem.plan import BlockPlan
    from plr.controlplane.core.problem.problem import Block, Choice, PairIndex
    from plr.protos.model.ids import InterfaceName, NodeName
    from plr.protos.model.members import ServiceUse

    Pair = tuple[InterfaceName, NodeName]

DELAYS = (1 / 16, 1 / 8, 1 / 4, 1 / 2)
"""Parts of the deadline after which a second copy is assumed to leave: the next of these, so that it is not promised
too early. None leaves later than at the last."""

LEAST_CARRIED = 1.0
"""With fewer requests it is unknown which pair goes first, and the worst one stands for it."""

UNTRIED_REQUESTS, UNTRIED_MISSES = 10.0, 0.5
"""The robot's prior belief about a pair: a hardly used pair ranks behind a good one."""


@dataclass(frozen=True, slots=True)
class PairTiming:
    """What is known of a pair besides its epsilon, if not all copies are sent at once."""

    carried: float
    """Requests of the service that it carried recently."""
    delay: int = len(DELAYS) - 1
    """Index in DELAYS of the time after which a hedge leaves if this pair goes first."""
    late: tuple[float, ...] = ()
    """For each of DELAYS: how likely a copy over it that leaves this much later misses; empty if unknown."""


NO_TIMING = PairTiming(0.0)

TOGETHER = 0.25
"""Minimum share of the missing first copies for which the second one is believed to miss as well ..."""

TOGETHER_MISSES = 1.0
"""... and the worth of that belief in independent misses of first copies."""


@dataclass(frozen=True, slots=True)
class Sending:
    """What is known of a service's copies if not all are sent at once."""

    timings: Mapping[Pair, PairTiming]
    first_missed: float = 0.0
    """First copies that missed recently ..."""
    all_missed: float = 0.0
    """... and requests of which all copies missed; both as independent ones."""


NO_SENDING = Sending({})


def is_timed(use: ServiceUse) -> bool:
    """Return whether the service's prediction takes more than the epsilons."""
    return not use.redundancy.uses_every_path or use.budgeted


def asked_times(deadline_s: float) -> NDArray[np.float64]:
    """Return the times for which `pair_timing` wants to know how likely an answer takes longer."""
    delays = deadline_s * np.array(DELAYS)
    return np.concatenate(([deadline_s], delays, deadline_s - delays))


def pair_timing(
    carried: float,
    epsilon: float,
    slower: NDArray[np.float64] | None,
    quantile: float,
) -> PairTiming:
    """Derive the timing from the pair's probabilities of taking longer than each of `asked_times`."""
    if slower is None:
        return PairTiming(carried)
    in_all, after, left = slower[0], slower[1 : 1 + len(DELAYS)], slower[1 + len(DELAYS) :]
    soon = np.flatnonzero(after <= 1.0 - quantile)
    # The parts tell how much a later start costs, the requests that ran how much is missed anyway.
    late = np.clip(epsilon + np.maximum(0.0, left - in_all), epsilon, 1.0)
    return PairTiming(carried, int(soon[0]) if soon.size else len(DELAYS) - 1, tuple(late.tolist()))


def predicted_miss(use: ServiceUse, planned: BlockPlan, sending: Sending) -> float:
    """Return the miss probability to report for a planned mapping."""
    if planned.block is None:
        return planned.predicted_miss
    return miss_of(use, planned.block, planned.choice, sending)


def miss_of(use: ServiceUse, block: Block, choice: Choice, sending: Sending) -> float:
    """Return the probability that a request misses with this choice and the service's way to send copies."""
    at_once = joint_miss(block, choice)
    paths = [(i, j) for i, j in enumerate(choice) if j is not None]
    if not is_timed(use) or len(paths) < 2:
        return at_once
    timings = sending.timings
    of = {path: timings.get((block.interfaces[path[0]], block.servers[path[1]]), NO_TIMING) for path in paths}
    carried = sum(timing.carried for timing in of.values())
    each = {path: _from(path, of, use, block, sending) for path in paths}
    if carried < LEAST_CARRIED:
        return max(at_once, *each.values())
    return max(at_once, sum(of[path].carried / carried * miss for path, miss in each.items()))


def _from(
    first: PairIndex, of: Mapping[PairIndex, PairTiming], use: ServiceUse, block: Block, sending: Sending
) -> float:
    """Return the same for requests that go over this pair first."""
    alone = _epsilon(block, first)
    if not use.redundancy.helps:
        return alone
    believed = _second_misses(first, of, use, block)
    missed = TOGETHER_MISSES * believed + sending.all_missed
    return alone * missed / (TOGETHER_MISSES + sending.first_missed)


def _second_misses(first: PairIndex, of: Mapping[PairIndex, PairTiming], use: ServiceUse, block: Block) -> float:
    """Return how likely no other copy is in time when the first one is not, before outcomes tell."""
    if not use.redundancy.sends_late or use.budgeted:
        return 1.0
    second = min((path for path in of if path != first), key=lambda path: _rank(of[path], _epsilon(block, path)))
    delay = of[first].delay if use.redundancy is RedundancyMode.HEDGE else len(DELAYS) - 1
    late = of[second].late[delay] if of[second].late else 1.0
    lift = block.lifts.get((min(first, second), max(first, second)), 1.0)
    return min(1.0, max(late * lift, TOGETHER))


def _rank(timing: PairTiming, epsilon: float) -> float:
    return (timing.carried * epsilon + UNTRIED_MISSES) / (timing.carried + UNTRIED_REQUESTS)


def _epsilon(block: Block, path: PairIndex) -> float:
    return max(block.epsilon[path[0]][path[1]] or 0.0, PROBABILITY_FLOOR)
