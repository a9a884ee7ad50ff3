from __future__ import annotations

import itertools
import math
import random
from dataclasses import dataclass, field

import pytest

from bench.drives.oracles import Causal, causal, clairvoyant_misses
from bench.evaluation import oracle
from bench.evaluation.oracle import OVERHEAD, OraclePath
from bench.evaluation.scenario import Scenario, Traffic
from lab.profile import LinkProfile
from lab.traces import Trace, TraceStep

DELAY_MS = 20.0
DOWN = LinkProfile(delay_ms=DELAY_MS, rate_kbps=50_000)


@dataclass(frozen=True, slots=True)
class MadeUp(Scenario):
    """A scenario over given rates, one value (kilobit/s) a second."""

    rates: dict[str, tuple[float, ...]] = field(default_factory=dict)

    def trace(self) -> Trace:
        return Trace(
            self.name,
            {
                name: tuple(
                    TraceStep(float(at), LinkProfile(delay_ms=DELAY_MS, rate_kbps=rate), DOWN)
                    for at, rate in enumerate(rates)
                )
                for name, rates in self.rates.items()
            },
        )


def made_up(a: tuple[float, ...], b: tuple[float, ...], rate_hz: float = 5.0, duration_s: float = 5.0) -> MadeUp:
    traffic = Traffic(request_bytes=120_000, answer_bytes=1_000, rate_hz=rate_hz, deadline_ms=1_000, compute_ms=20)
    return MadeUp("made-up", "A", "made up", duration_s, traffic, rates={"a": a, "b": b})


def random_scenario(seed: int, requests: int) -> MadeUp:
    rng = random.Random(seed)
    a, b = (tuple(rng.choice((0.0, 300.0, 800.0, 1500.0, 4000.0)) for _ in range(12)) for _ in range(2))
    return made_up(a, b, rate_hz=4.0, duration_s=requests / 4.0)


def fewest_misses_of_whole_requests(scenario: Scenario) -> int:
    """Try every choice: each request over a, over b, or given up."""
    traffic, size = scenario.traffic, scenario.traffic.request_bytes * OVERHEAD
    fewest = scenario.count
    for choice in itertools.product((0, 1, None), repeat=scenario.count):
        paths = [OraclePath(scenario.trace().path(name), traffic) for name in ("a", "b")]
        missed = 0
        for number, place in enumerate(choice):
            due = number / traffic.rate_hz
            if place is None:
                missed += 1
                continue
            path = paths[place]
            path.free_s = path.end_of(max(path.free_s, due), size)
            if math.isinf(path.free_s) or path.answered(path.free_s) > due + traffic.deadline_ms / 1e3:
                break
        else:
            fewest = min(fewest, missed)
    return fewest


@pytest.mark.parametrize("seed", range(12))
def test_the_clairvoyant_finds_the_best_of_all_choices(seed: int) -> None:
    scenario = random_scenario(seed, requests=5)
    assert clairvoyant_misses(scenario) == fewest_misses_of_whole_requests(scenario)


def test_the_choices_differ() -> None:
    """The random scenarios above are worth trying: some requests miss, some do not."""
    found = {clairvoyant_misses(random_scenario(seed, requests=5)) for seed in range(12)}
    assert len(found) >= 3


@pytest.mark.parametrize("seed", range(20))
def test_who_shares_and_knows_all_misses_no_more(seed: int) -> None:
    scenario = random_scenario(seed, requests=12)
    shared = round(oracle.compute(scenario).figures().misses)
    assert shared <= clairvoyant_misses(scenario)
    for kind in Causal:
        if kind is not Causal.WHOLE:
            assert shared <= round(causal(scenario, kind).figures().misses)


def test_shared_requests_take_what_both_paths_give() -> None:
    scenario = made_up((6_000.0,) * 10, (3_000.0,) * 10, rate_hz=1.0, duration_s=4.0)
    bits = 120_000 * OVERHEAD * 8
    after_s = 2 * DELAY_MS / 1e3 + 0.020
    shared = causal(scenario, Causal.SHARED).figures()
    whole = causal(scenario, Causal.WHOLE).figures()
    assert shared.mean_ms / 1e3 == pytest.approx(bits / 9e6 + after_s, abs=0.02)
    assert whole.mean_ms / 1e3 == pytest.approx(bits / 6e6 + after_s, abs=0.02)


def test_repair_answers_what_a_path_that_goes_dark_has_taken() -> None:
    """Path b dies in the middle of the second request. Path a needs about 0.5 s for a whole one."""
    scenario = made_up((2_400.0,) * 10, (2_400.0, 0.0, *(0.0,) * 8), rate_hz=1.25, duration_s=3.2)
    shared, repaired = (causal(scenario, kind).figures() for kind in (Causal.SHARED, Causal.REPAIR))
    assert shared.misses >= 1
    assert repaired.misses == 0
    assert (repaired.bytes_per_request or 0.0) > (shared.bytes_per_request or 0.0)


def test_one_copy_costs_no_more_than_the_request() -> None:
    run = causal(made_up((6_000.0,) * 10, (3_000.0,) * 10), Causal.SHARED).figures()
    assert run.bytes_per_request == pytest.approx(120_000 * OVERHEAD, rel=0.001)
