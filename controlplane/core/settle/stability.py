"""Decides which parts of a new plan are worth changing the running one.

Blocks whose choice differs are judged together if one needs the room that another leaves, and otherwise each on its
own. An unforced change has to win by enough, and more surely than by chance; no service of a robot has more than a few
of them in a minute. Every change carries its reason.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter, deque
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from plr.controlplane.core.problem.costs import block_cost, charge
from plr.controlplane.core.problem.domains import violations
from plr.controlplane.core.problem.objectives import joint_miss, objective_cost
from plr.controlplane.core.problem.plan import choice_of, make_plan
from plr.controlplane.core.problem.problem import Objective, block_excess, limits_used
from plr.controlplane.core.settle.certainty import probability_better, probability_met

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from plr.controlplane.core.problem.plan import BlockPlan, Plan
    from plr.controlplane.core.problem.problem import Block, BlockKey, Choice, FleetKey, Problem

IMPROVEMENT_SHARE = 0.1
IMPROVEMENT_MIN = 0.002
"""Minimum that a change saves of its blocks' sum of miss probabilities, as a share and absolute: less is noise of the
reports, and a change itself costs the requests in flight a detour."""

IMPROVEMENT_LOG = -math.log(1 - IMPROVEMENT_SHARE)
"""The same share for sums of logarithms, for each block that changes."""

IMPROVEMENT_MIN_ALL_MISS = 1e-4
"""Minimum it saves there of the expected number of missed requests, one of each block: products are smaller."""

SURE_ENOUGH = 0.7
"""Minimum probability that the new choice is better. On recorded networks 0.9 halves the changes that 0.5 makes, but
misses a twentieth more deadlines, as a path that became bad is kept too long; 0.7 costs a hundredth."""

MAX_MOVES = 4
CHANGE_WINDOW_S = 60.0
"""Maximum moves of a robot's service to something better in this window. What died, or has no room, is left at once."""

HOPELESS = 0.5
"""A path expected to miss more often than this counts as dead if another one over the same interface is clearly better.
So do all paths if every copy misses this often: no number of changes keeps a robot there."""

CLEARLY = 0.8
"""Maximum share of another path's misses at which a path is clearly better."""

TROUBLE = 1e-3
"""No path is trusted to miss less often when a gain is weighed: one that has not missed for minutes may go dark now,
and then the others matter."""

MAX_NAMED = 3
"""Servers, interfaces or paths that a reason names."""


class _Difference(NamedTuple):
    """A block whose new choice is not its running one."""

    block: Block
    new: Choice
    old: Choice | None
    """None if it is no longer valid."""
    load: Mapping[FleetKey, int]
    """Change in the block's interfaces under each limit over all robots with the new choice."""


class Stability:
    """Decides which changes are made. Times are monotonic seconds."""

    def __init__(self) -> None:
        self._changed: dict[BlockKey, deque[float]] = {}

    def settle(self, problem: Problem, new: Plan, running: Plan, now: float) -> Plan:
        """Take the worthwhile parts of the new plan, which answers this problem; keep the rest of the running one.

        A change is made if the running choice is no longer valid (a path or a server of it is gone, an interface came),
        if it removes some excess over the capacities, or if it saves enough at today's epsilons, and surely.
        """
        old = {block.key: choice_of(block, running.blocks.get(block.key)) for block in problem.blocks}
        choices = {key: choice for key, choice in old.items() if choice is not None}
        why: dict[BlockKey, str] = {}
        self._changed = {key: times for key, times in self._changed.items() if key in old}
        differences = _differences(problem, new, old)
        load: Counter[FleetKey] = Counter()
        if differences:
            for block in problem.blocks:
                if block.key in choices:
                    load.update(limits_used(problem, block, choices[block.key]))
        for together in _linked(problem, differences, load):
            if not self._is_made(problem, together, load, now):
                continue
            for difference in together:
                key = difference.block.key
                choices[key] = difference.new
                if key in running.blocks:
                    why[key] = _reason(difference, running.blocks[key], alone=len(together) == 1)
                    self._changed.setdefault(key, deque(maxlen=MAX_MOVES)).append(now)
        plan = make_plan(problem, choices, bound=new.bound, unproven=new.unproven, before=running.blocks)
        return replace(plan, blocks={key: _said(block, running, why) for key, block in plan.blocks.items()})

    def _is_made(
        self, problem: Problem, together: Sequence[_Difference], load: Mapping[FleetKey, int], now: float
    ) -> bool:
        if any(difference.old is None for difference in together):
            return True
        more = _more_excess(problem, together, load)
        if more:
            return more < 0
        spent = any(self._is_spent(difference, now) for difference in together)
        return not spent and _is_worth_it(problem.objective, together)

    def _is_spent(self, difference: _Difference, now: float) -> bool:
        if _leaves_hopeless(difference):
            return False
        times = self._changed.get(difference.block.key, ())
        return sum(now - time < CHANGE_WINDOW_S for time in times) >= MAX_MOVES


def _leaves_hopeless(difference: _Difference) -> bool:
    block, new, old = difference.block, difference.new, difference.old
    if old is None or joint_miss(block, old) > HOPELESS:
        return True
    for epsilons, server, left in zip(block.epsilon, new, old, strict=True):
        then = epsilons[left] if left is not None else None
        now = epsilons[server] if server is not None else None
        if then is not None and now is not None and then > HOPELESS and now < CLEARLY * then:
            return True
    return False


def _differences(problem: Problem, new: Plan, old: Mapping[BlockKey, Choice | None]) -> list[_Difference]:
    found: list[_Difference] = []
    for block in problem.blocks:
        choice = choice_of(block, new.blocks.get(block.key))
        if choice is None:
            raise ValueError("the plan does not fit the problem")
        before = old[block.key]
        if choice != before:
            change = Counter(limits_used(problem, block, choice))
            change.subtract(limits_used(problem, block, before) if before is not None else [])
            load = {key: count for key, count in change.items() if count}
            found.append(_Difference(_with_kept_lifts(block, choice, before), choice, before, load))
    return found


def _with_kept_lifts(block: Block, new: Choice, old: Choice | None) -> Block:
    """Keep the lift of two interfaces that were found to fail together, whichever servers they are mapped to.

    Otherwise a change would win by something nobody has measured: paths that have carried no common request are taken
    to be independent. Copies to one server may have failed together because of it; nothing of these is kept.
    """
    if old is None or not block.lifts:
        return block
    kept = {}
    for (i, left), (k, also_left) in itertools.combinations(enumerate(old), 2):
        if left is None or also_left is None or left == also_left:
            continue
        taken, also_taken = new[i], new[k]
        if taken is None or also_taken is None:
            continue
        lift = block.lifts.get(((i, left), (k, also_left)), 1.0)
        pair = (i, taken), (k, also_taken)
        if lift > block.lifts.get(pair, 1.0):
            kept[pair] = lift
    return replace(block, lifts={**block.lifts, **kept}) if kept else block


def _said(block: BlockPlan, running: Plan, why: Mapping[BlockKey, str]) -> BlockPlan:
    """Return the block with the reason of its last change."""
    before = running.blocks.get(block.key)
    if block is before:
        return block
    return replace(block, why=why.get(block.key, before.why if before is not None else ""))


def _linked(
    problem: Problem, differences: Sequence[_Difference], load: Mapping[FleetKey, int]
) -> list[list[_Difference]]:
    """Group those that touch a limit which would be exceeded if all newcomers came and nobody left."""
    coming: Counter[FleetKey] = Counter()
    touching: dict[FleetKey, list[int]] = {}
    for number, difference in enumerate(differences):
        for key, count in difference.load.items():
            touching.setdefault(key, []).append(number)
            coming[key] += max(0, count)
    leader = list(range(len(differences)))

    def find(number: int) -> int:
        while leader[number] != number:
            leader[number] = number = leader[leader[number]]
        return number

    for key, numbers in touching.items():
        if load.get(key, 0) + coming[key] > problem.fleet_capacity[key]:
            for number in numbers[1:]:
                leader[find(number)] = find(numbers[0])
    groups: dict[int, list[_Difference]] = {}
    for number, difference in enumerate(differences):
        groups.setdefault(find(number), []).append(difference)
    return list(groups.values())


def _more_excess(problem: Problem, together: Sequence[_Difference], load: Mapping[FleetKey, int]) -> int:
    """Return by how many more interfaces capacities are exceeded with these changes."""
    more = 0
    change: Counter[FleetKey] = Counter()
    for difference in together:
        before = difference.old or ()
        more += block_excess(difference.block, difference.new) - block_excess(difference.block, before)
        change.update(difference.load)
    for key, count in change.items():
        over = load.get(key, 0) - problem.fleet_capacity[key]
        more += max(0, over + count) - max(0, over)
    return more


def _is_worth_it(objective: Objective, together: Sequence[_Difference]) -> bool:
    """Return whether these changes save enough at today's estimates, and surely enough."""
    pairs = [(difference.block, difference.new, difference.old or ()) for difference in together]
    bound = [pair for pair in pairs if pair[0].target is not None]
    free = [pair for pair in pairs if pair[0].target is None]
    if not all(_keeps_target(*pair) for pair in bound):
        return False
    return any(_suits_target(*pair) for pair in bound) or (bool(free) and _saves_misses(objective, free))


def _keeps_target(block: Block, new: Choice, old: Choice) -> bool:
    return probability_met(block, new) >= min(probability_met(block, old), SURE_ENOUGH)


def _suits_target(block: Block, new: Choice, old: Choice) -> bool:
    """Return whether the old choice likely misses the target and the new one is better, or the new one is cheaper.

    A target that one choice just meets and the other just misses is no reason to go back and forth.
    """
    if block.target is None or block_cost(Objective.JOINT, block, new) >= block_cost(Objective.JOINT, block, old):
        return False
    if probability_met(block, old) < 1 - SURE_ENOUGH or violations(block, new) < violations(block, old):
        return True
    return charge(block.target, new) <= (1 - IMPROVEMENT_SHARE) * charge(block.target, old)


def _saves_misses(objective: Objective, pairs: Sequence[tuple[Block, Choice, Choice]]) -> bool:
    shared = sum(violations(block, new) - violations(block, old) for block, new, old in pairs)
    if shared:
        return shared < 0
    then = sum(objective_cost(objective, block, old) for block, _, old in pairs)
    saved = then - sum(objective_cost(objective, block, new) for block, new, _ in pairs)
    if objective is Objective.SUM:
        enough = saved > max(IMPROVEMENT_MIN, IMPROVEMENT_SHARE * then)
    else:
        fewer = sum(_missed_in_trouble(block, old) - _missed_in_trouble(block, new) for block, new, old in pairs)
        enough = saved > IMPROVEMENT_LOG * len(pairs) and fewer > IMPROVEMENT_MIN_ALL_MISS
    return enough and probability_better(objective, pairs) > SURE_ENOUGH


def _missed_in_trouble(block: Block, choice: Choice) -> float:
    epsilon = tuple(tuple(max(e, TROUBLE) if e is not None else None for e in row) for row in block.epsilon)
    return joint_miss(replace(block, epsilon=epsilon), choice)


def _reason(difference: _Difference, before: BlockPlan, *, alone: bool) -> str:
    """Return why a choice changes from that of `before`; `alone`: no other block changes with it."""
    block, old, new = difference.block, difference.old, difference.new
    if old is None:
        return f"moved because {_what_came_or_went(block, before)}"
    if block.target is not None:
        paid, pays = (charge(block.target, choice) for choice in (old, new))
        if pays < paid:
            return f"moved because a request cost {paid:.3g}, now {pays:.3g}"
    then, now = (joint_miss(block, choice) for choice in (old, new))
    if then > now:
        return f"moved because all copies would have missed with probability {then:.2g}, now {now:.2g}"
    if violations(block, new) < violations(block, old):
        return "moved so that its copies share less: no region, carrier or server beyond its capacity"
    if not alone:
        return "moved, although it gains nothing, because another service gains more from the server that it leaves"
    if difference.load:
        return "moved off a server that had more requests than its capacity for all robots"
    return f"moved because its copies one by one miss less, although all together miss with probability {now:.2g}"


def _what_came_or_went(block: Block, before: BlockPlan) -> str:
    """Return why the choice of `before` does not fit the block any more."""
    servers = {server for _, server in before.assignments if server not in block.servers}
    if servers:
        return f"{_some(servers)} left, or no longer offers the service to this robot"
    used = {interface for interface, _ in before.assignments}
    if dark := used.difference(block.interfaces):
        return f"no path over {_some(dark)} is up any more"
    down = {
        f"{interface} to {server}"
        for interface, server in before.assignments
        if block.epsilon[block.interfaces.index(interface)][block.servers.index(server)] is None
    }
    if down:
        return f"{_some(down)} is down"
    if came := set(block.interfaces).difference(used):
        return f"{_some(came)} can carry requests now"
    return "what the service may use has changed"


def _some(names: Collection[str]) -> str:
    shown = sorted(names)
    return " and ".join(shown[:MAX_NAMED]) + (f" and {len(shown) - MAX_NAMED} more" if len(shown) > MAX_NAMED else "")
