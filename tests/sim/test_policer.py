"""A policer on the path: its token rate is found, and kept to; loss at random is not taken for one."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import pytest

from lab.simulated.mesh import Mesh, rule
from tests.sim.bottleneck import Bottleneck, OurFlow, Policed

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.model.ids import Address
    from plr.sidecar.core.base.values import ExecutionId

MBIT = 1e6 / 8
REQUEST_BYTES = 180_000
LEARNING_S = 10.0
"""After the first datagram that is dropped."""
START_BYTES, START_BUCKETS, START_S = 350e3, 2.5, 0.1
"""Dropped at most until then: start-up doubles as long as the bucket lasts, and learns a round trip later that it is
empty. This much, and so many times the bucket, and what the tokens allow in so long."""


class Outcome(NamedTuple):
    loss: float
    """Bytes the policer dropped over bytes sent."""
    goodput: float
    """Over the token rate, or over what is asked for where that is less."""


def ask(flow: OurFlow, net: Policed, period_s: float) -> None:
    assert flow.want is not None
    flow.want += REQUEST_BYTES
    flow.pump()
    net.at(net.now + period_s, lambda: ask(flow, net, period_s))


def flow_over(net: Policed, load: float | None = None) -> OurFlow:
    """A bulk sender; with `load`, requests that make up this share of the token rate."""
    flow = OurFlow(net)
    if load is not None:
        flow.want = 0
        net.at(0.05, lambda: ask(flow, net, REQUEST_BYTES / (load * net.token_rate)))
    net.at(0.01, flow.watch)
    return flow


def learn(net: Policed) -> None:
    while net.first_drop_at is None and net.now < 60.0:
        net.run(net.now + 0.5)
    net.run(net.now + LEARNING_S)


def measure(net: Policed, flow: OurFlow, seconds: float, load: float | None = None) -> Outcome:
    before = net.offered, net.policed, flow.delivered
    net.run(net.now + seconds)
    offered, policed, delivered = net.offered - before[0], net.policed - before[1], flow.delivered - before[2]
    asked = net.token_rate * min(1.0, load or 1.0)
    return Outcome(policed / max(offered, 1), delivered / seconds / asked)


@pytest.mark.audit("dp-9")
@pytest.mark.parametrize("load", [None, 1.5, 0.8], ids=["bulk", "overload", "requests"])
@pytest.mark.parametrize("bucket", [16e3, 64e3, 250e3, 1e6])
@pytest.mark.parametrize(("rate", "seconds"), [(0.5, 30.0), (2.0, 30.0), (10.0, 15.0), (50.0, 6.0)])
def test_hardly_anything_is_lost_at_nine_tenths_of_the_token_rate(
    rate: float, seconds: float, bucket: float, load: float | None
) -> None:
    net = Policed(rate * MBIT, 0.05, bucket)
    flow = flow_over(net, load)
    learn(net)
    assert net.policed < START_BYTES + START_BUCKETS * bucket + START_S * net.token_rate
    outcome = measure(net, flow, seconds, load)
    assert outcome.loss < 0.02
    assert outcome.goodput >= 0.9


@pytest.mark.audit("dp-9")
@pytest.mark.parametrize(
    ("rate", "bucket", "rtt_s", "full", "load", "seconds"),
    [(50.0, 16e3, 0.03, 2 / 3, None, 6.0), (1.0, 64e3, 0.08, 1.0, 0.8, 30.0)],
    ids=["bursts", "pauses"],
)
def test_bursts_above_the_bucket_and_pauses_that_fill_it(
    rate: float, bucket: float, rtt_s: float, full: float, load: float | None, seconds: float
) -> None:
    """The first rate found is much too low, then its bursts too large; or no train lasts for a measurement."""
    net = Policed(rate * MBIT, rtt_s, bucket)
    net.tokens = full * bucket
    flow = flow_over(net, load)
    learn(net)
    outcome = measure(net, flow, seconds, load)
    assert outcome.loss < 0.02
    assert outcome.goodput >= 0.9


@pytest.mark.audit("dp-9")
@pytest.mark.parametrize("rtt_s", [0.01, 0.2])
@pytest.mark.parametrize("rate", [2.0, 10.0])
def test_on_short_and_long_routes_alike(rate: float, rtt_s: float) -> None:
    net = Policed(rate * MBIT, rtt_s, 64e3)
    flow = flow_over(net)
    learn(net)
    outcome = measure(net, flow, 30.0)
    assert outcome.loss < 0.02
    assert outcome.goodput >= 0.9


@pytest.mark.audit("dp-9")
@pytest.mark.parametrize(("before", "after", "seconds"), [(10.0, 3.0, 5.0), (3.0, 10.0, 20.0)])
def test_a_token_rate_that_changes_is_found_again(before: float, after: float, seconds: float) -> None:
    net = Policed(before * MBIT, 0.05, 64e3)
    flow = flow_over(net)
    learn(net)
    net.token_rate = after * MBIT
    net.run(net.now + seconds)
    outcome = measure(net, flow, 15.0)
    assert outcome.loss < 0.02
    assert outcome.goodput >= 0.9


@pytest.mark.audit("dp-9")
def test_a_policer_on_a_radio_that_loses_some_besides() -> None:
    net = Policed(10 * MBIT, 0.05, 64e3, loss=0.01)
    flow = flow_over(net)
    learn(net)
    outcome = measure(net, flow, 20.0)
    assert outcome.loss < 0.02
    assert outcome.goodput >= 0.85


@pytest.mark.audit("dp-9")
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("loss", [0.02, 0.05, 0.1])
@pytest.mark.parametrize(("rate", "rtt_s"), [(2.0, 0.05), (20.0, 0.05), (20.0, 0.2), (100.0, 0.01)])
def test_loss_at_random_is_no_policer(rate: float, rtt_s: float, loss: float, seed: int) -> None:
    net = Bottleneck(rate * MBIT, rtt_s, 2 * rate * MBIT * rtt_s, loss, seed)
    flow = OurFlow(net)
    net.at(0.01, flow.watch)
    net.run(3.0)
    before, seconds = flow.delivered, 60.0 / rate + 3.0
    net.run(3.0 + seconds)
    assert (flow.delivered - before) / seconds > 0.88 * (1 - loss) * rate * MBIT


class Fading(Bottleneck):
    """A radio that is silent for `gap_s` of each second, from `since` on."""

    gap_s = 0.05
    since = 0.31

    def carry(self, size: int, arrived: Callable[[], None]) -> None:
        self.loss = 1.0 if (self.now + self.since) % 1.0 < self.gap_s else 0.0
        super().carry(size, arrived)


@pytest.mark.audit("dp-9")
@pytest.mark.parametrize(("rate", "rtt_s", "gap_s"), [(20.0, 0.04, 0.05), (20.0, 0.04, 0.03), (20.0, 0.1, 0.1)])
def test_a_radio_that_is_silent_for_moments_is_no_policer(rate: float, rtt_s: float, gap_s: float) -> None:
    """Much is lost before a trial and nothing in it; each rate tried after that was lower, without an end."""
    net = Fading(rate * MBIT, rtt_s, rate * MBIT)
    net.gap_s = gap_s
    flow = OurFlow(net)
    net.at(0.01, flow.watch)
    net.run(10.0)
    before = flow.delivered
    net.run(25.0)
    assert (flow.delivered - before) / 15.0 > 0.7 * (1 - gap_s) * rate * MBIT


def policed(mesh: Mesh, source: str, rate: float, bucket: float) -> Callable[[], int]:
    """Police what this interface sends; returns what tells how many datagrams were dropped."""
    tokens, filled_at, dropped = bucket, mesh.now, 0
    carry = mesh._carry

    def carry_policed(origin: Address, destination: Address, data: bytes) -> None:
        nonlocal tokens, filled_at, dropped
        if origin[0] == source:
            tokens, filled_at = min(bucket, tokens + (mesh.now - filled_at) * rate), mesh.now
            if tokens < len(data):
                dropped += 1
                return
            tokens -= len(data)
        carry(origin, destination, data)

    mesh._carry = carry_policed  # type: ignore[method-assign,assignment]
    return lambda: dropped


@pytest.mark.audit("dp-9")
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_requests_get_through_a_policer_and_no_repair_symbols_are_sent_for_what_it_dropped(seed: int) -> None:
    mesh, rate, size, hz, seconds = Mesh(seed), 10 * MBIT, 200_000, 12.5, 12.0
    robot = mesh.robot("wlan0", rules=(rule(deadline_s=2.0, lifetime_s=10.0),))
    cloud = mesh.cloud("cloud-a")
    complete = cloud.engine.cloud.complete

    def answer(execution: ExecutionId, payload: bytes, server_s: float, now: float) -> None:
        complete(execution, payload[:9], server_s, now)

    cloud.engine.cloud.complete = answer  # type: ignore[method-assign,assignment]  # an echo would be policed by nobody
    mesh.push_views()
    mesh.run(1.0)
    up, _ = mesh.both_ways("robot.wlan0", "cloud-a.eth0")
    up.bytes_per_s = 20 * rate
    dropped = policed(mesh, "robot.wlan0", rate, 64e3)
    (link,) = robot.links.values()
    for number in range(int(seconds * hz)):
        robot.submit(number.to_bytes(4, "big") + bytes(size))
        mesh.run(1 / hz)
    sent = link.stats.datagrams["sent", "data"] + link.stats.datagrams["sent", "repair"]
    assert dropped() < 0.02 * sent
    assert link.stats.datagrams["sent", "repair"] < 0.05 * sent
    assert len(robot.responses()) * size / seconds > 0.88 * rate
