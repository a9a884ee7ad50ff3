"""How fast each pair answers at present."""

from __future__ import annotations

import pytest

from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.robot.dispatch import pair_history
from plr.sidecar.core.robot.dispatch.pair_history import FADE_S, PathPaces
from plr.sidecar.core.seam.stats import EngineStats
from plr.sidecar.core.transfer.routes import Routes
from tests.support.builders import ECHO, WLAN, WWAN, A, B, path

WLAN_A, WWAN_B = path(WLAN, A), path(WWAN, B)


@pytest.fixture
def paces() -> PathPaces:
    routes = Routes()
    for known, rtt_s in ((WLAN_A, 0.010), (WWAN_B, 0.040)):
        routes.set_state(known, PathState.UP)
        routes.set_rtt(known, rtt_s)
    return PathPaces(routes, EngineStats())


def test_nothing_is_known_at_first(paces: PathPaces) -> None:
    assert paces.expected_s(ECHO, WLAN_A, 0.0) is None
    assert paces.processing_s(ECHO, WLAN_A) == 0.0


def test_a_slow_answer_counts_at_once_and_fades(paces: PathPaces) -> None:
    for number in range(50):
        paces.answered(ECHO, WLAN_A, 0.1, 0.02, number / 10)
    assert paces.expected_s(ECHO, WLAN_A, 5.0) == pytest.approx(0.1)
    assert paces.processing_s(ECHO, WLAN_A) == pytest.approx(0.02)
    paces.answered(ECHO, WLAN_A, 0.9, 0.02, 5.0)
    present, later = (paces.expected_s(ECHO, WLAN_A, now) for now in (5.0, 5.0 + 4 * FADE_S))
    assert present == pytest.approx(0.5, abs=0.03)
    assert later == pytest.approx(0.17, abs=0.03)


def test_what_is_awaited_for_longer_makes_the_pair_slow(paces: PathPaces) -> None:
    paces.answered(ECHO, WLAN_A, 0.1, 0.0, 0.0)
    paces.takes_at_least(ECHO, WLAN_A, 0.05, 0.1)
    assert paces.expected_s(ECHO, WLAN_A, 0.1) == pytest.approx(0.1)
    paces.takes_at_least(ECHO, WLAN_A, 0.7, 0.1)
    assert paces.expected_s(ECHO, WLAN_A, 0.1) == pytest.approx(0.7)


def test_a_pair_never_tried_is_taken_for_as_fast_as_another(paces: PathPaces) -> None:
    paces.answered(ECHO, WLAN_A, 0.1, 0.0, 0.0)
    assert paces.expected_s(ECHO, WWAN_B, 0.0) == pytest.approx(0.1 + 0.030), "the round trip is that much longer"


def test_pairs_are_forgotten_in_order(paces: PathPaces, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pair_history, "MAX_PACES", 1)
    paces.answered(ECHO, WLAN_A, 0.1, 0.02, 0.0)
    paces.answered(ECHO, WWAN_B, 0.2, 0.03, 0.0)
    assert paces.processing_s(ECHO, WLAN_A) == 0.0
    assert paces._stats.dropped == {"path_paces_full": 1}
