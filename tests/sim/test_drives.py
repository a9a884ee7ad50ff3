"""Redundancy modes on a made-up drive: rates that come and go, requests that fill the slower path."""

from __future__ import annotations

import pytest

from bench.drives.simulation import drive
from bench.evaluation.scenario import Scenario, read_scenarios
from plr.protos.model.redundancy_mode import RedundancyMode
from plr.sidecar.core.rules.budget import Budget


@pytest.fixture
def scenario() -> Scenario:
    (found,) = [one for one in read_scenarios([]) if one.name == "drive-2"]
    return found.shortened(30.0)


def test_adaptive_avoids_what_replicate_avoids_for_a_fraction_of_its_bytes(scenario: Scenario) -> None:
    single, adaptive, replicate = (
        drive(scenario, mode) for mode in (RedundancyMode.SINGLE, RedundancyMode.ADAPTIVE, RedundancyMode.REPLICATE)
    )
    assert single.misses - replicate.misses >= 3, "there is something to avoid"
    assert adaptive.misses <= replicate.misses
    assert adaptive.sent <= 1.25 * single.sent
    assert replicate.sent > 1.4 * single.sent


def test_sharing_avoids_more_than_replicate_for_fewer_bytes(scenario: Scenario) -> None:
    share, replicate = (drive(scenario, mode) for mode in (RedundancyMode.SHARE, RedundancyMode.REPLICATE))
    assert share.misses <= replicate.misses
    assert share.outcome.figures().mean_ms < replicate.outcome.figures().mean_ms
    assert share.sent < replicate.sent


def test_adaptive_keeps_its_budget(scenario: Scenario) -> None:
    run = drive(scenario, RedundancyMode.ADAPTIVE, budget=Budget("*", extra_load=0.05))
    assert 0.03 * run.copies.first < run.copies.extra <= 2 * 0.05 * run.copies.first, (
        "each of two interfaces may spend a twentieth"
    )
