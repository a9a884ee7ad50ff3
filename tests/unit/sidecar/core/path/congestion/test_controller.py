"""What a path relies on, whatever controller it has."""

from __future__ import annotations

import random

import pytest

from plr.sidecar.core.path.congestion.choice import CONTROLLERS
from plr.sidecar.core.path.congestion.controller import MAX_WINDOW_BYTES, CongestionController, RateSample
from plr.sidecar.core.path.congestion.rtt import RttEstimator
from plr.sidecar.core.path.congestion.units import DATAGRAM_BYTES

RTT_S = 0.05


@pytest.fixture(params=sorted(CONTROLLERS))
def control(request: pytest.FixtureRequest) -> CongestionController:
    return CONTROLLERS[request.param]()


def test_an_unknown_path_sends_a_first_window_without_pacing(control: CongestionController) -> None:
    assert control.pacing_rate is None
    assert control.next_release(0) is None
    first = control.budget(0.0, 0)
    assert 10 * DATAGRAM_BYTES <= first <= control.window
    control.on_sent(0.0, first, first)
    assert control.budget(0.0, int(control.window) + 1) == 0


def test_a_full_window_lets_nothing_leave_but_two_datagrams_after_a_probe_timeout(
    control: CongestionController,
) -> None:
    full = int(control.window) + 1
    control.on_sent(0.0, full, full)
    control.on_probe_timeout(0.5)
    assert control.budget(0.5, full) == 2 * DATAGRAM_BYTES
    control.on_sent(0.5, DATAGRAM_BYTES, full + DATAGRAM_BYTES)
    assert control.budget(0.5, full + DATAGRAM_BYTES) == 0


def test_an_acknowledgement_begins_pacing_and_the_release_is_when_more_may_leave(
    control: CongestionController,
) -> None:
    rtt = RttEstimator()
    control.on_sent(0.0, 10 * DATAGRAM_BYTES, 10 * DATAGRAM_BYTES)
    for step in range(1, 11):
        at = RTT_S + step * 0.001
        rtt.sample(at, at)
        control.on_acked(RateSample(DATAGRAM_BYTES, 0.0, at, (10 - step) * DATAGRAM_BYTES), rtt, at)
    assert control.pacing_rate is not None
    now, in_flight = at, 0
    while (budget := control.budget(now, in_flight)) and in_flight + budget < control.window:
        in_flight += budget
        control.on_sent(now, budget, in_flight)
    release = control.next_release(in_flight)
    if release is not None and not budget:
        assert release > now
        assert control.budget(release, in_flight) >= DATAGRAM_BYTES
    assert control.next_release(int(control.window) + 1) is None


def test_it_reports_no_policer_where_nothing_was_lost(control: CongestionController) -> None:
    assert not control.take_policed()


@pytest.mark.parametrize("seed", range(20))
def test_whatever_happens_some_may_be_in_flight_and_not_too_much(control: CongestionController, seed: int) -> None:
    rng, rtt, now, in_flight = random.Random(seed), RttEstimator(), 0.0, 0
    sent: list[tuple[float, int]] = []
    for _ in range(2000):
        now += rng.choice((0.0, 0.0001, 0.005, 0.3))
        match rng.randrange(8):
            case 0 | 1 | 2 if budget := control.budget(now, in_flight):
                assert budget >= DATAGRAM_BYTES
                in_flight += budget
                sent.append((now, budget))
                control.on_sent(now, budget, in_flight)
            case 3 if sent:
                at, size = sent.pop(0)
                in_flight -= size
                rtt.sample(now - at, now)
                control.on_acked(RateSample(size, at, max(now - at, 1e-6), in_flight), rtt, now)
            case 4 if sent:
                at, size = sent.pop(0)
                in_flight -= size
                control.on_lost(size, at, in_flight, now)
                if rng.random() < 0.1:
                    control.on_spurious(size)
            case 5:
                control.ran_dry()
            case 6 if sent:
                control.on_probe_timeout(now)
            case 7 if rng.random() < 0.05:
                control.on_path_down()
                sent.clear()
                in_flight = 0
                control.on_path_up(now)
        assert DATAGRAM_BYTES <= control.window <= MAX_WINDOW_BYTES
        assert control.pacing_rate is None or control.pacing_rate > 0
