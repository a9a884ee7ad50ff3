"""What is told of a target that no mapping meets."""

from __future__ import annotations

import pytest

from controlplane.core.problem import Target
from controlplane.core.shortfall import shortfall
from tests.unit.controlplane.problems import block


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
