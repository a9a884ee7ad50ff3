from __future__ import annotations

import random

from plr.sidecar.core.control.backoff import Backoff


class TopOfRange(random.Random):
    """Draws the largest value each time, which shows the bounds."""

    def uniform(self, a: float, b: float) -> float:
        return b


def test_the_bound_doubles_up_to_the_largest_and_starts_over_after_a_reset() -> None:
    backoff = Backoff(TopOfRange(), first_s=0.2, max_s=1.0)
    assert [backoff.next_delay_s() for _ in range(5)] == [0.2, 0.4, 0.8, 1.0, 1.0]
    backoff.reset()
    assert backoff.next_delay_s() == 0.2
    assert backoff.next_delay_s(refused=True) == 1.0


def test_who_is_refused_again_and_again_asks_ever_less_whatever_the_fleet_may() -> None:
    backoff = Backoff(TopOfRange(), first_s=0.2, max_s=10.0)
    backoff.set_max(1.0)
    assert [backoff.next_delay_s(refused=True) for _ in range(6)] == [1.0, 2.0, 4.0, 8.0, 10.0, 10.0]
    assert backoff.next_delay_s() == 1.0, "as soon as it is no longer refused"


def test_delays_fill_their_range_so_that_a_fleet_spreads() -> None:
    first = [Backoff(random.Random(seed), first_s=0.2, max_s=10.0).next_delay_s() for seed in range(400)]
    assert all(0.0 <= delay <= 0.2 for delay in first)
    quarters = [sum(low <= delay < low + 0.05 for delay in first) for low in (0.0, 0.05, 0.1, 0.15)]
    assert min(quarters) > 60


def test_the_same_seed_gives_the_same_delays() -> None:
    first, second = (Backoff(random.Random(7), first_s=0.2, max_s=10.0) for _ in range(2))
    assert [first.next_delay_s() for _ in range(9)] == [second.next_delay_s() for _ in range(9)]
