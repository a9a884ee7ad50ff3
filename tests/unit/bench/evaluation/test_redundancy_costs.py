"""What redundancy costs and avoids, from the records of runs."""

from __future__ import annotations

import pytest

from bench.evaluation.outcome import Outcome, Request, figures_by_window
from bench.evaluation.redundancy_costs import ModeCost, mode_costs


def outcome(scenario: str, contender: str, misses: int, megabytes: int = 0, *, void: bool = False) -> Outcome:
    requests = tuple(Request(float(n), float(n), n + (2.0 if n < misses else 0.1)) for n in range(100))
    sent = {"wan-a": megabytes * 1_000_000} if megabytes else {}
    return Outcome(scenario, "A", contender, 1000.0, requests, sent, ("late",) if void else ())


def costs_of(runs: list[Outcome]) -> dict[str, ModeCost]:
    return mode_costs(figures_by_window(runs))


def window(name: str, *, direct: tuple[int, int], single: int, adaptive: int, replicate: int) -> list[Outcome]:
    return [
        outcome(name, "direct-a", direct[0]),
        outcome(name, "direct-b", direct[1]),
        outcome(name, "plr-single", single, 10),
        outcome(name, "plr-adaptive", adaptive, 11),
        outcome(name, "plr-replicate", replicate, 20),
    ]


def test_misses_avoided_and_bytes_over_all_windows() -> None:
    runs = window("one", direct=(40, 20), single=15, adaptive=1, replicate=0)
    runs += window("two", direct=(10, 30), single=10, adaptive=10, replicate=10)
    costs = costs_of(runs)
    assert list(costs) == ["plr-single", "plr-adaptive", "plr-replicate"]
    adaptive = costs["plr-adaptive"]
    assert adaptive.windows == 2
    assert adaptive.miss_ratio == pytest.approx(11 / 200)
    assert adaptive.bytes_per_request == pytest.approx(110_000)
    assert adaptive.avoided == pytest.approx(19 / 20)
    assert adaptive.extra_bytes == pytest.approx(0.1)
    assert costs["plr-replicate"].avoided == 1.0
    assert costs["plr-single"].extra_bytes == 0.0


def test_a_window_counts_when_everything_ran_and_nothing_was_disturbed() -> None:
    runs = window("one", direct=(40, 20), single=15, adaptive=1, replicate=0)
    assert costs_of(runs[1:]) == {}
    assert costs_of([*runs[:-1], outcome("one", "plr-replicate", 0, 20, void=True)]) == {}


def test_nothing_to_avoid() -> None:
    costs = costs_of(window("one", direct=(0, 0), single=0, adaptive=0, replicate=0))
    assert costs["plr-adaptive"].avoided is None
