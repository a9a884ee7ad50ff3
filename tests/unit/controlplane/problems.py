"""Random assignment problems, and their best plan by trying every choice."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

from controlplane.core.plan import Price, price
from controlplane.core.problem import Block, BlockKey, Choice, FleetKey, Problem, is_valid
from protos.model import InterfaceName, NodeName, ServiceName

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
) -> Block:
    return Block(
        key=BlockKey(NodeName(robot), service),
        interfaces=tuple(InterfaceName(f"if{i}") for i in range(len(epsilon))),
        servers=tuple(NodeName(f"cloud-{j}") for j in range(len(epsilon[0]))),
        epsilon=tuple(tuple(row) for row in epsilon),
        capacity=capacity,
        idempotent=idempotent,
    )


def random_problem(rng: random.Random, *, max_choices: int = 30_000) -> Problem:
    """A few robots, interfaces and servers: some paths missing, some servers limited over all robots."""
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
            blocks.append(block(epsilon, robot=f"robot-{robot}", capacity=capacity, idempotent=idempotent))
        limits = {
            FleetKey(NodeName(f"cloud-{j}"), PLAN): rng.randint(1, 3) for j in range(servers) if rng.random() < 0.4
        }
        problem = Problem(tuple(blocks), limits)
        if count_choices(problem) <= max_choices:
            return problem


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


def best_price(problem: Problem) -> Price:
    """The least price of all valid choices."""
    keys = [part.key for part in problem.blocks]
    every = itertools.product(*(list(valid_choices(part)) for part in problem.blocks))
    return min(price(problem, dict(zip(keys, choices, strict=True))) for choices in every)


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
