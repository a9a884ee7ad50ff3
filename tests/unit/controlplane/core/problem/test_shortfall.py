"""What is said about a target that no mapping meets."""

from __future__ import annotations

import random
import re
from dataclasses import replace

import pytest

from plr.controlplane.core.problem.objectives import PROBABILITY_FLOOR, joint_miss
from plr.controlplane.core.problem.problem import Objective, Target
from plr.controlplane.core.problem.shortfall import shortfall
from plr.protos.model.ids import InterfaceName, NodeName
from plr.protos.model.members import Copies
from tests.unit.controlplane.problems import block, random_problem, valid_choices


@pytest.mark.parametrize(
    ("target", "said"),
    [
        (0.004, ""),
        (0.003, "up to 2 times too often; a server of its own for if1, as good as cloud-0 and failing independently"),
        (1e-4, "up to 50 times too often; one more carrier as good as if0, failing independently"),
        (1e-5, "up to 500 times too often; 2 more carriers as good as if0"),
        (1e-20, "not even 8 more carriers as good as if0"),
    ],
)
def test_the_least_that_would_meet_the_target(target: float, said: str) -> None:
    charges = ((1.0, 1.0), (1.0, 1.0))
    part = block([[0.02, 0.2], [0.1, 0.2]], target=Target(target, charges))
    found = shortfall(part, (0, 1))
    assert said in found
    assert bool(found) == bool(said)


def test_without_a_target_nothing_is_told() -> None:
    assert shortfall(block([[0.5]]), (0,)) == ""


def test_what_is_told_holds() -> None:
    """The block with what it lacks meets the target, whatever it is short of."""
    rng = random.Random(61)
    told = 0
    for _ in range(400):
        part = random_problem(rng, Objective.JOINT, limited=False, ruled=True).blocks[0]
        part = replace(part, target=part.target or Target(0.01, ((1.0,) * len(part.servers),) * len(part.interfaces)))
        choice = rng.choice(list(valid_choices(part)))
        text = shortfall(part, choice)
        server = re.search(r"a server of its own for (\S+), as good as (\S+) and", text)
        carriers = re.search(r"(one|\d) more carriers? as good as (\S+), failing .* would meet it", text)
        if server is not None:
            i, j = part.interfaces.index(InterfaceName(server[1])), part.servers.index(NodeName(server[2]))
            others = tuple(None if k == i else other for k, other in enumerate(choice))
            reached = joint_miss(part, others) * max(part.epsilon[i][j] or 0.0, PROBABILITY_FLOOR)
        elif carriers is not None:
            row = part.epsilon[part.interfaces.index(InterfaceName(carriers[2]))]
            count = 1 if carriers[1] == "one" else int(carriers[1])
            open_to = [j for j in range(len(row)) if part.idempotent or j in choice]
            reached = joint_miss(part, choice) * min(row[j] or 1.0 for j in open_to) ** count
        else:
            assert not text or "not even" in text
            continue
        told += 1
        assert part.target is not None
        assert joint_miss(part, choice) > part.target.miss
        assert reached <= part.target.miss * (1 + 1e-6)
    assert told > 50


def test_what_is_not_idempotent_is_not_told_to_take_a_second_server() -> None:
    part = block([[0.02, 0.9], [0.1, 0.9]], idempotent=False, target=Target(1e-3, ((1.0, 1.0), (1.0, 1.0))))
    assert "one more carrier as good as if0, failing independently, would meet it" in shortfall(part, (0, 0))
    limited = replace(part, copies=Copies(2, 2))
    assert "failing independently and with as many more copies, would meet it" in shortfall(limited, (0, 0))
