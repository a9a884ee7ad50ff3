"""Random assignment problems, and their best plan by trying every choice."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import TYPE_CHECKING

from plr.controlplane.core.problem.costs import RULE_PRICE, TIE_PRICE
from plr.controlplane.core.problem.objectives import PROBABILITY_FLOOR
from plr.controlplane.core.problem.plan import PlanCost
from plr.controlplane.core.problem.problem import (
    Block,
    BlockKey,
    Choice,
    FleetKey,
    Objective,
    PairIndex,
    Problem,
    Target,
    block_excess,
    fleet_excess,
    is_valid,
)
from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
from plr.protos.model.members import AT_MOST_EVERY_INTERFACE, EVERY_INTERFACE, Copies

if TYPE_CHECKING:
    import random
    from collections.abc import Iterator

PLAN = ServiceName("/plan")


def block(
    epsilon: list[list[float | None]],
    *,
    robot: str = "robot",
    capacity: int = 1,
    idempotent: bool = True,
    service: ServiceName = PLAN,
    lifts: dict[tuple[PairIndex, PairIndex], float] | None = None,
    copies: Copies = EVERY_INTERFACE,
    regions: tuple[str, ...] = (),
    carriers: tuple[str, ...] = (),
    target: Target | None = None,
) -> Block:
    return Block(
        key=BlockKey(NodeName(robot), service),
        interfaces=tuple(InterfaceName(f"if{i}") for i in range(len(epsilon))),
        servers=tuple(NodeName(f"cloud-{j}") for j in range(len(epsilon[0]))),
        epsilon=tuple(tuple(row) for row in epsilon),
        capacity=capacity,
        idempotent=idempotent,
        lifts=lifts or {},
        copies=copies,
        regions=regions,
        carriers=carriers,
        target=target,
    )


def random_problem(
    rng: random.Random,
    objective: Objective = Objective.SUM,
    *,
    max_choices: int = 30_000,
    limited: bool = True,
    ruled: bool = False,
) -> Problem:
    """A few robots, interfaces and servers: some paths missing, some failing together, and, unless told otherwise,
    some servers limited over all robots. `ruled`: with failure domains, fewer copies and targets too."""
    while True:
        servers = rng.randint(1, 4)
        blocks = []
        for robot in range(rng.randint(1, 3)):
            idempotent = rng.random() < 0.75
            epsilon: list[list[float | None]] = []
            for _ in range(rng.randint(1, 3)):
                row: list[float | None] = [
                    None if rng.random() < 0.2 else rng.choice([rng.random(), rng.random() ** 6])
                    for _ in range(servers)
                ]
                if all(value is None for value in row):
                    row[rng.randrange(servers)] = rng.random()
                epsilon.append(row)
            capacity = rng.choice([0, 1, 1, 1, 2])
            lifts = random_lifts(rng, epsilon, rng.choice([0.0, 0.3, 1.0]))
            made = block(epsilon, robot=f"robot-{robot}", capacity=capacity, idempotent=idempotent, lifts=lifts)
            blocks.append(with_rules(rng, made) if ruled else made)
        limits = {
            FleetKey(NodeName(f"cloud-{j}"), PLAN): rng.randint(1, 3)
            for j in range(servers)
            if limited and rng.random() < 0.4
        }
        problem = Problem(tuple(blocks), limits, objective)
        if count_choices(problem) <= max_choices:
            return problem


def with_rules(rng: random.Random, part: Block) -> Block:
    """The block with labels, a wish for fewer copies, and a target, each only sometimes."""
    interfaces, servers = len(part.interfaces), len(part.servers)
    labels = ["", "north", "south"]
    charges = tuple(tuple(float(rng.randint(0, 9)) for _ in range(servers)) for _ in range(interfaces))
    number = rng.randint(1, 3)
    return replace(
        part,
        copies=rng.choice([EVERY_INTERFACE, EVERY_INTERFACE, AT_MOST_EVERY_INTERFACE, Copies(number, number)]),
        regions=rng.choice([(), tuple(rng.choice(labels) for _ in range(servers))]),
        carriers=rng.choice([(), tuple(rng.choice(labels) for _ in range(interfaces))]),
        target=rng.choice([None, Target(rng.choice([0.3, 0.1, 1e-3]), charges)]),
    )


def fleet(rng: random.Random, robots: int, interfaces: int, servers: int, objective: Objective, room: float) -> Problem:
    """Robots with good and bad carriers, servers near and far, of `room` times the capacity wanted."""
    far = [0.3 + rng.random() for _ in range(servers)]
    blocks = []
    for robot in range(robots):
        carriers = [10 ** rng.uniform(-3, -0.5) for _ in range(interfaces)]
        epsilon: list[list[float | None]] = [
            [min(0.99, carrier * distance * rng.uniform(0.3, 3)) for distance in far] for carrier in carriers
        ]
        blocks.append(block(epsilon, robot=f"robot-{robot}"))
    capacity = max(1, int(robots * interfaces * room / servers))
    limits = {FleetKey(NodeName(f"cloud-{j}"), PLAN): capacity for j in range(servers)}
    return Problem(tuple(blocks), limits, objective)


def random_lifts(
    rng: random.Random, epsilon: list[list[float | None]], share: float
) -> dict[tuple[PairIndex, PairIndex], float]:
    """Lifts of a share of all pairs of paths: below 1, far above, or 0."""
    paths = [(i, j) for i, row in enumerate(epsilon) for j, value in enumerate(row) if value is not None]
    return {
        (one, two): rng.choice([0.0, rng.random(), 1 + 3 * rng.random(), 100.0])
        for one, two in itertools.combinations(paths, 2)
        if one[0] != two[0] and rng.random() < share
    }


def count_choices(problem: Problem) -> int:
    count = 1
    for part in problem.blocks:
        count *= (len(part.servers) + 1) ** len(part.interfaces)
    return count


def valid_choices(part: Block) -> Iterator[Choice]:
    options = [None, *range(len(part.servers))]
    for choice in itertools.product(options, repeat=len(part.interfaces)):
        if is_valid(part, choice):
            yield choice


def all_miss(part: Block, choice: Choice) -> float:
    """P(all chosen paths miss) as the page on objectives defines it, written down once more."""
    paths = [(i, j) for i, j in enumerate(choice) if j is not None]
    epsilon = {(i, j): max(part.epsilon[i][j] or 0.0, PROBABILITY_FLOOR) for i, j in paths}
    pairs = {
        (one, two): epsilon[one] * epsilon[two] * max(part.lifts.get((one, two), 1.0), PROBABILITY_FLOOR)
        for one, two in itertools.combinations(paths, 2)
    }
    product = math.prod(epsilon.values())
    for (one, two), both in pairs.items():
        product *= both / (epsilon[one] * epsilon[two])
    return min([product, *epsilon.values(), *pairs.values()])


def sharing(part: Block, choice: Choice) -> int:
    """Copies that share a domain, as the page on them defines it, written down once more."""
    servers = [j for j in choice if j is not None]
    carriers = [part.carriers[i] for i, j in enumerate(choice) if j is not None and part.carriers]
    fitting = [j for number, j in enumerate(servers) if not part.capacity or servers[:number].count(j) < part.capacity]
    regions = [part.regions[j] for j in fitting if part.regions]
    every = part.copies.least in (0, *range(len(part.interfaces), 9))
    shared = 0 if every else sum(max(0, carriers.count(label) - 1) for label in set(carriers) - {""})
    if part.idempotent:
        shared += sum(max(0, regions.count(label) - 1) for label in set(regions) - {""})
        if part.target and part.capacity:
            shared += sum(max(0, servers.count(j) - part.capacity) for j in set(servers))
    return shared


def rank(objective: Objective, part: Block, choice: Choice) -> tuple[float, ...]:
    """What decides between a block's choices, in order."""
    if part.target is None:
        return (sharing(part, choice), plain_objective(objective, part, choice))
    miss = all_miss(part, choice)
    if miss <= part.target.miss * (1 + 1e-9):
        charge = sum(row[j] for row, j in zip(part.target.charges, choice, strict=True) if j is not None)
        return (0, sharing(part, choice), charge, math.log(miss))
    return (1, sharing(part, choice) + choice.count(None), math.log(miss / part.target.miss))


def plain_cost(objective: Objective, part: Block, choice: Choice) -> float:
    """What a block's choice costs, by the definition."""
    found = rank(objective, part, choice)
    if part.target is None:
        return RULE_PRICE * found[0] + found[1]
    if found[0]:
        # Of copies left out only those count that were wanted.
        unwanted = len(choice) - min(part.copies.most or len(choice), len(choice))
        return RULE_PRICE * (4 * len(choice) + found[1] - unwanted) + found[2]
    return RULE_PRICE * found[1] + found[2] / (sum(map(max, part.target.charges)) or 1.0) + TIE_PRICE * found[3]


def plain_objective(objective: Objective, part: Block, choice: Choice) -> float:
    """What the objective says of it, by the definition."""
    chosen = [part.epsilon[i][j] or 0.0 for i, j in enumerate(choice) if j is not None]
    match objective:
        case Objective.SUM:
            return sum(chosen) + choice.count(None)
        case Objective.PRODUCT:
            return sum(math.log(max(epsilon, PROBABILITY_FLOOR)) for epsilon in chosen)
        case Objective.JOINT:
            return math.log(all_miss(part, choice))


def best_price(problem: Problem) -> PlanCost:
    """The least price of all valid choices."""
    options = [
        [(choice, plain_cost(problem.objective, part, choice)) for choice in valid_choices(part)]
        for part in problem.blocks
    ]
    best = PlanCost(10**9, 0.0)
    for combination in itertools.product(*options):
        chosen = {part.key: choice for part, (choice, _) in zip(problem.blocks, combination, strict=True)}
        excess = sum(block_excess(part, chosen[part.key]) for part in problem.blocks)
        if excess <= best.excess:
            excess += sum(fleet_excess(problem, chosen).values())
            best = min(best, PlanCost(excess, sum(cost for _, cost in combination)))
    return best


def choices_of(
    problem: Problem, assignments: dict[BlockKey, tuple[tuple[InterfaceName, NodeName], ...]]
) -> dict[BlockKey, Choice]:
    """A plan's assignments as choices, to be priced independently of what the plan says of itself."""
    found: dict[BlockKey, Choice] = {}
    for part in problem.blocks:
        server_of = dict(assignments[part.key])
        found[part.key] = tuple(
            part.servers.index(server_of[name]) if name in server_of else None for name in part.interfaces
        )
    return found
