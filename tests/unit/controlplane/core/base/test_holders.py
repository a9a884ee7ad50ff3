"""Who holds most."""

from __future__ import annotations

import random
from collections import Counter

import pytest

from plr.controlplane.core.base.holders import Holders


@pytest.mark.parametrize("seed", range(5))
def test_the_greediest_holds_as_many_as_any(seed: int) -> None:
    rng = random.Random(seed)
    holders: Holders[str] = Holders()
    counts: Counter[str] = Counter()
    for _ in range(2000):
        owner = rng.choice("abcdef")
        if rng.random() < 0.6 or not counts[owner]:
            holders.add(owner)
            counts[owner] += 1
        else:
            holders.remove(owner)
            counts[owner] -= 1
        most = max(counts.values())
        if most:
            assert counts[holders.greediest()] == most
        assert all((name in holders) == (count > 0) for name, count in counts.items())
    for owner, count in counts.items():
        for _ in range(count):
            holders.remove(owner)
    with pytest.raises((KeyError, StopIteration)):
        holders.greediest()


def test_of_several_the_one_that_held_so_many_first_comes_first() -> None:
    holders: Holders[str] = Holders()
    for owner in "abab":
        holders.add(owner)
    assert holders.greediest() == "a"
    holders.remove("a")
    assert holders.greediest() == "b"
