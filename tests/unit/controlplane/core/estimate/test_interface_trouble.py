from __future__ import annotations

import pytest

from plr.controlplane.core.estimate.interface_trouble import InterfaceTrouble
from plr.controlplane.core.estimate.posterior import Estimate
from plr.protos.model.ids import InterfaceName, NodeName

WLAN = InterfaceName("wlan0")
A, B = NodeName("cloud-a"), NodeName("cloud-b")


def moved(expected: float, met_expected: float, met_found: float) -> Estimate:
    trouble = InterfaceTrouble()
    trouble.note(WLAN, A, 100.0, Estimate.of(met_expected, 10.0), Estimate.of(met_found, 10.0))
    return trouble.moved(Estimate.of(expected, 10.0), WLAN, B)


def test_what_one_path_meets_beyond_what_was_expected_is_expected_of_another() -> None:
    assert moved(0.01, 0.01, 0.5).mean == pytest.approx(0.5)
    assert moved(0.01, 0.5, 0.01).mean == pytest.approx(0.01), "never for the better"


def test_however_bad_it_is_it_stays_an_estimate() -> None:
    worst = moved(1.0 - 1e-15, 1e-15, 1.0 - 1e-15)
    assert 0.0 < worst.hits < worst.misses
