"""NewReno where `test_congestion.py` and `test_outages.py` have the model: it fills a link, backs off and recovers.

It is not for use: it takes each loss for congestion, and the last test shows what that costs.
"""

from __future__ import annotations

import pytest

from lab.simulated.mesh import Mesh, rule
from tests.sim.bottleneck import Bottleneck, OurFlow, Tcp
from tests.sim.test_mesh import mapped

MBIT = 1e6 / 8
SIZE = 120_000


def goodput(flow: OurFlow | Tcp, seconds: float) -> float:
    """Bytes a second that arrive in this time from now on."""
    before = flow.delivered
    flow.net.run(flow.net.now + seconds)
    return (flow.delivered - before) / seconds


@pytest.mark.parametrize("rtt_s", [0.010, 0.100])
@pytest.mark.parametrize("rate", [2 * MBIT, 20 * MBIT, 100 * MBIT])
def test_bulk_fills_a_path_that_loses_nothing_by_itself(rate: float, rtt_s: float) -> None:
    net = Bottleneck(rate, rtt_s, max(rate * rtt_s, 30_000))
    flow = OurFlow(net, "new-reno")
    net.at(0.01, flow.watch)
    net.run(3.0)
    assert goodput(flow, 5.0) > 0.9 * rate
    assert net.dropped, "it found the end of the buffer"


def test_it_backs_off_where_the_rate_falls_and_finds_it_again_where_it_rises() -> None:
    rate, rtt_s = 20 * MBIT, 0.040
    net = Bottleneck(rate, rtt_s, rate * rtt_s)
    flow = OurFlow(net, "new-reno")
    net.at(0.01, flow.watch)
    net.run(5.0)
    before = flow.control.window
    net.rate, net.buffer = rate / 10, rate / 10 * rtt_s
    net.run(10.0)
    assert flow.control.window < before / 4
    assert goodput(flow, 2.0) > 0.8 * net.rate
    net.rate, net.buffer = rate, rate * rtt_s
    net.run(net.now + 10.0)
    assert goodput(flow, 2.0) > 0.9 * rate


@pytest.mark.parametrize("buffer", [0.5, 2.0])
def test_it_shares_as_reno_does(buffer: float) -> None:
    rate, rtt_s = 20 * MBIT, 0.040
    net = Bottleneck(rate, rtt_s, buffer * rate * rtt_s)
    ours, rival = OurFlow(net, "new-reno"), Tcp(net, cubic=False)
    net.at(0.01, ours.watch)
    net.at(0.14, rival.watch)
    net.run(15.0)
    before = ours.delivered, rival.delivered
    net.run(60.0)
    assert 0.4 < (ours.delivered - before[0]) / (rival.delivered - before[1]) < 2.5


@pytest.mark.parametrize("seed", range(3))
def test_requests_go_on_after_an_outage_over_a_path_that_loses_some(seed: int) -> None:
    mesh = Mesh(seed)
    mesh.controller = "new-reno"
    robot = mesh.robot("wlan0", rules=(rule(lifetime_s=60.0),))
    mesh.cloud("cloud-a")
    up, down = mesh.both_ways("robot.wlan0", "cloud-a.eth0")
    up.bytes_per_s, up.loss = 20 * MBIT, 0.005
    mesh.push_views()
    mesh.run(1.0)
    mapped(mesh, robot, ("wlan0", "cloud-a"))

    def ask(seconds: float) -> list[float]:
        """The latencies of requests that come in this time."""
        asked = []
        for _ in range(round(seconds / 0.2)):
            asked.append(robot.submit(bytes(SIZE)))
            mesh.run(0.2)
        taken = {answer.request_id: answer.elapsed_s for answer in robot.responses()}
        return [taken.get(request, 60.0) for request in asked]

    ask(3.0)
    assert max(ask(3.0)[:-1]) < 1.0
    up.cut = down.cut = True
    mesh.run(5.0)
    up.cut = down.cut = False
    ask(3.0)
    assert max(ask(3.0)[:-1]) < 1.0


def test_a_loss_at_random_costs_it_what_it_costs_reno_and_the_model_next_to_nothing() -> None:
    rate, rtt_s = 20 * MBIT, 0.050

    def bulk(make: str) -> float:
        net = Bottleneck(rate, rtt_s, 2 * rate * rtt_s, loss=0.02)
        flow = Tcp(net, cubic=False) if make == "tcp" else OurFlow(net, make)
        net.at(0.01, flow.watch)
        net.run(3.0)
        return goodput(flow, 10.0)

    reno, new_reno, model = bulk("tcp"), bulk("new-reno"), bulk("model")
    assert 0.5 < new_reno / reno < 2.0
    assert new_reno < 0.3 * model
