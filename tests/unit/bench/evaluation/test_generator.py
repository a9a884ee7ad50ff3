"""The generator's traces have the statistics that its parameters state, and are the same for the same seed."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from bench.evaluation.generator import generate, generate_kind
from bench.evaluation.kinds import KINDS, Kind
from bench.evaluation.trace_statistics import PathStatistics, measure, stated

if TYPE_CHECKING:
    from lab import Trace

STEPS = 40_000
"""Enough for hundreds of times the longest memory."""


def endless(name: str) -> Kind:
    """A kind of the generator without what belongs to single windows."""
    return replace(KINDS[name], blackouts=(), step_s=1.0)


def long_trace(kind: Kind) -> Trace:
    return generate_kind(kind, "long", STEPS * kind.step_s)


def paths(name: str) -> tuple[list[tuple[PathStatistics, PathStatistics]], float, float]:
    """(measured, stated) of each path of a kind, and of both the lift."""
    kind = endless(name)
    found, said = measure([long_trace(kind)]), stated(kind)
    return [(found.a, said.a), (found.b, said.b)], found.low_lift, said.low_lift


@pytest.mark.parametrize("name", ["drive", "satellite", "two_wifi"])
def test_rates_outages_and_joint_dead_zones_are_those_stated(name: str) -> None:
    singles, lift, stated_lift = paths(name)
    for found, said in singles:
        assert found.rates_kbps[1:] == pytest.approx(said.rates_kbps[1:], rel=0.2)
        assert found.low_share == pytest.approx(said.low_share, abs=0.04)
        assert found.outage_share == pytest.approx(said.outage_share, rel=0.3)
        assert found.outage_s == pytest.approx(said.outage_s, rel=0.2)
    assert lift == pytest.approx(stated_lift, rel=0.2)


@pytest.mark.parametrize("name", ["drive", "handover", "one_operator"])
def test_memory_and_correlation_of_the_rates_are_those_stated(name: str) -> None:
    kind = replace(endless(name), dead_every_s=math.inf)
    kind = replace(kind, a=replace(kind.a, outage_every_s=math.inf), b=replace(kind.b, outage_every_s=math.inf))
    found, said = measure([long_trace(kind)]), stated(kind)
    assert found.a.autocorrelation == pytest.approx(said.a.autocorrelation, abs=0.08)
    assert found.b.autocorrelation == pytest.approx(said.b.autocorrelation, abs=0.08)
    assert found.spearman == pytest.approx(said.spearman, abs=0.08)


def test_kinds_are_as_the_published_traces() -> None:
    drive, same = stated(KINDS["drive"]), stated(KINDS["one_operator"])
    assert 0.0 <= drive.spearman <= 0.25
    assert 1.5 <= drive.low_lift <= 4.0
    assert same.spearman > 0.8
    assert stated(KINDS["satellite"]).low_lift == pytest.approx(1.0)


@pytest.mark.parametrize("name", KINDS)
def test_a_window_is_the_same_for_the_same_seed_and_has_its_blackouts(name: str) -> None:
    trace = generate(name, 7, 20.0)
    assert trace == generate(name, 7, 20.0)
    assert trace != generate(name, 8, 20.0)
    assert trace.duration_s == pytest.approx(20.0)
    for blackout in KINDS[name].blackouts:
        middle = (blackout.begin + blackout.end) / 2 * 20.0
        for path in blackout.paths:
            (step,) = (step for step in trace.path(path) if step.at_s <= middle < step.at_s + KINDS[name].step_s)
            assert step.up.rate_kbps == step.down.rate_kbps == 0.0
