"""The congestion controller at a simulated bottleneck: alone, with another of ours, and beside TCP."""

from __future__ import annotations

import pytest

from tests.sim.bottleneck import Bottleneck, OurFlow, Tcp

MBIT = 1e6 / 8


def share(rate: float, rtt_s: float, buffer: float, other: str, *, seconds: float = 45.0) -> float:
    """Our rate over the other's, after both have had time to settle; `buffer` in bandwidth-delay products."""
    net = Bottleneck(rate, rtt_s, buffer * rate * rtt_s)
    ours = OurFlow(net)
    rival = OurFlow(net) if other == "ours" else Tcp(net, cubic=other == "cubic")
    net.at(0.01, ours.watch)
    net.at(0.14, rival.watch)
    net.run(15.0)
    before = ours.delivered, rival.delivered
    net.run(15.0 + seconds)
    assert net.mean_queue_s(15.0) < buffer * rtt_s + 0.01
    return (ours.delivered - before[0]) / (rival.delivered - before[1])


@pytest.mark.parametrize("loss", [0.0, 0.02, 0.05])
@pytest.mark.parametrize("rtt_s", [0.010, 0.100])
@pytest.mark.parametrize(("rate", "seconds"), [(2 * MBIT, 8.0), (20 * MBIT, 5.0), (100 * MBIT, 2.5)])
def test_bulk_fills_the_path_whatever_it_loses_at_random(
    rate: float, seconds: float, rtt_s: float, loss: float
) -> None:
    net = Bottleneck(rate, rtt_s, max(2 * rate * rtt_s, 30_000), loss)
    flow = OurFlow(net)
    net.at(0.01, flow.watch)
    net.run(2.0)
    before = flow.delivered
    net.run(2.0 + seconds)
    assert (flow.delivered - before) / seconds >= 0.85 * rate
    assert net.mean_queue_s(2.0) < 0.25 * rtt_s + 0.012


@pytest.mark.parametrize("rtt_s", [0.020, 0.050, 0.100])
@pytest.mark.parametrize(("before", "after"), [(20e3, 2e6), (50e3, 1e6), (300e3, 2e6), (1e6, 6e6)])
def test_a_rate_that_rises_a_hundredfold_is_soon_used(before: float, after: float, rtt_s: float) -> None:
    net = Bottleneck(before, rtt_s, 1.2e6)
    flow = OurFlow(net)
    net.at(0.01, flow.watch)
    net.run(10.0)
    least_s = 4 * 1200 / before
    assert net.mean_queue_s(5.0) < max(least_s, 0.1 * rtt_s), "four datagrams are the least in flight"
    net.rate = after
    net.run(12.5)
    delivered = flow.delivered
    net.run(13.5)
    assert flow.delivered - delivered > 0.5 * after


@pytest.mark.parametrize("other", ["reno", "cubic"])
@pytest.mark.parametrize(
    ("rate", "rtt_s", "buffer"),
    [(20 * MBIT, 0.040, 0.5), (20 * MBIT, 0.040, 4.0), (5 * MBIT, 0.060, 0.5), (2 * MBIT, 0.050, 1.0)],
)
def test_tcp_and_we_leave_each_other_a_share(rate: float, rtt_s: float, buffer: float, other: str) -> None:
    assert 0.25 <= share(rate, rtt_s, buffer, other) <= 4.0


@pytest.mark.parametrize("buffer", [0.5, 4.0])
def test_two_of_ours_share_fairly(buffer: float) -> None:
    ratio = share(20 * MBIT, 0.040, buffer, "ours", seconds=30.0)
    assert (1 + ratio) ** 2 / (2 * (1 + ratio * ratio)) > 0.8  # Jain's index of two
