"""What is predicted of pairs that carried nothing yet, beside what they turn out to do: networks drawn at random."""

from __future__ import annotations

import random
from dataclasses import dataclass, field

import pytest
from scipy.stats import beta

from plr.controlplane.core.estimate.estimator import Estimator
from plr.protos.base.histogram import Histogram
from plr.protos.base.size_class import size_class
from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
from plr.protos.model.report import LatencyReport, PathReport, Report

ROBOT, OTHER_ROBOT = NodeName("robot"), NodeName("other")
DETECT, SEGMENT = ServiceName("/detect"), ServiceName("/segment")
WLAN, WWAN = InterfaceName("wlan0"), InterfaceName("wwan0")
A, B, C = NodeName("cloud-a"), NodeName("cloud-b"), NodeName("cloud-c")
IMAGE_BYTES = 120_000
PROBE_BYTES = 100
DEADLINE_S = 0.25
REQUESTS = 200
PROBES = 200


@dataclass
class World:
    """A robot's access networks, ways to servers, and what these need. The times of one request are drawn apart."""

    rng: random.Random
    rates: dict[InterfaceName, float] = field(default_factory=dict)
    """Bytes a second, before their ups and downs."""
    ways_s: dict[NodeName, float] = field(default_factory=dict)
    needs_s: dict[NodeName, float] = field(default_factory=dict)
    spread: float = 0.4

    @classmethod
    def drawn(cls, seed: int) -> World:
        rng = random.Random(seed)
        return cls(
            rng,
            {interface: rng.uniform(0.8e6, 4e6) for interface in (WLAN, WWAN)},
            {server: rng.uniform(0.01, 0.06) for server in (A, B, C)},
            {server: rng.uniform(0.01, 0.08) for server in (A, B, C)},
        )

    def network(self, interface: InterfaceName, server: NodeName, size: int) -> float:
        rate = self.rates[interface] * self.rng.lognormvariate(0.0, self.spread)
        return size / rate + self.ways_s[server] * self.rng.lognormvariate(0.0, 0.1)

    def processing(self, server: NodeName) -> float:
        return self.needs_s[server] * self.rng.lognormvariate(0.0, 0.25)

    def miss(self, interface: InterfaceName, server: NodeName) -> float:
        """What share of requests misses the deadline."""
        took = [self.network(interface, server, IMAGE_BYTES) + self.processing(server) for _ in range(2000)]
        return sum(value > DEADLINE_S for value in took) / len(took)

    def requests(
        self, interface: InterfaceName, server: NodeName, service: ServiceName = DETECT, count: int = REQUESTS
    ) -> Report:
        network, processing = Histogram(), Histogram()
        missed = 0
        for _ in range(count):
            times = self.network(interface, server, IMAGE_BYTES), self.processing(server)
            network.record(times[0])
            processing.record(times[1])
            missed += sum(times) > DEADLINE_S
        of_class = size_class(IMAGE_BYTES)
        return Report(
            (LatencyReport(interface, server, service, of_class, network, Histogram(), processing, count, missed),)
        )

    def probes(self, interface: InterfaceName, server: NodeName) -> Report:
        rtt = Histogram()
        rtt.record_many([self.network(interface, server, PROBE_BYTES) for _ in range(PROBES)])
        return Report(paths=(PathReport(interface, server, True, rtt),))


@pytest.fixture
def estimator() -> Estimator:
    return Estimator(half_life_s=60.0)


def mean(estimator: Estimator, interface: InterfaceName, server: NodeName, service: ServiceName = DETECT) -> float:
    return estimator.estimate(ROBOT, interface, server, service, DEADLINE_S, 0.0).mean


def test_stated_intervals_hold_what_untried_pairs_turn_out_to_do() -> None:
    inside, far = 0, []
    worlds = range(60)
    for seed in worlds:
        world, estimator = World.drawn(seed), Estimator(half_life_s=60.0)
        for interface in (WLAN, WWAN):
            for server in (A, B, C):
                estimator.merge(ROBOT, world.probes(interface, server), 0.0)
        estimator.merge(ROBOT, world.requests(WLAN, A), 0.0)
        estimator.merge(ROBOT, world.requests(WWAN, B), 0.0)
        found = estimator.estimate(ROBOT, WLAN, B, DETECT, DEADLINE_S, 0.0)
        true = world.miss(WLAN, B)
        low, high = beta.ppf((0.05, 0.95), found.misses, found.hits)
        # No interval of a probability that may well be 0 or 1 gets to its ends.
        inside += low - 0.02 <= true <= high + 0.02
        far.append(abs(found.mean - true))
        assert 0.0 < found.mean < 1.0
    assert inside >= 0.85 * len(worlds)
    assert sum(far) / len(far) < 0.06


def test_services_of_one_size_share_what_is_known_of_the_network(estimator: Estimator) -> None:
    world = World.drawn(1)
    world.rates[WLAN], world.rates[WWAN] = 0.3e6, 6e6
    estimator.merge(ROBOT, world.requests(WLAN, A), 0.0)
    estimator.merge(ROBOT, world.requests(WWAN, B, SEGMENT), 0.0)
    found = estimator.estimate(ROBOT, WLAN, A, SEGMENT, DEADLINE_S, 0.0)
    assert found.mean > 0.9, "120 kB take 0.4 s there, whichever service they are for"
    assert mean(estimator, WWAN, B, DETECT) < 0.1
    estimator.merge(OTHER_ROBOT, world.requests(WWAN, A, SEGMENT), 0.0)
    estimator.merge(ROBOT, world.requests(WWAN, C, SEGMENT, count=20), 0.0)
    again = estimator.estimate(ROBOT, WLAN, A, SEGMENT, DEADLINE_S, 0.0)
    assert again.weight > 2.0 * found.weight, "now it is known what the server needs for it"


def test_a_slow_server_is_known_to_robots_that_never_asked_it(estimator: Estimator) -> None:
    world = World.drawn(2)
    world.rates = dict.fromkeys((WLAN, WWAN), 6e6)
    world.needs_s = {A: 0.02, B: 0.4, C: 0.02}
    for server in (A, B, C):
        estimator.merge(ROBOT, world.probes(WLAN, server), 0.0)
    estimator.merge(ROBOT, world.requests(WLAN, A), 0.0)
    assert mean(estimator, WLAN, B) < 0.2, "nobody has asked it: as quick as the others, but in doubt"
    assert estimator.estimate(ROBOT, WLAN, B, DETECT, DEADLINE_S, 0.0).weight < 5.0
    estimator.merge(OTHER_ROBOT, world.requests(WWAN, B), 0.0)
    assert mean(estimator, WLAN, B) > 0.9
    assert 0.3 < mean(estimator, WLAN, C) < 0.7, "like the one or like the other"


def test_a_new_server_is_thought_to_need_what_others_need(estimator: Estimator) -> None:
    world = World.drawn(3)
    world.rates = dict.fromkeys((WLAN, WWAN), 6e6)
    world.needs_s = dict.fromkeys((A, B, C), 0.5)
    for server in (A, B):
        estimator.merge(ROBOT, world.probes(WLAN, server), 0.0)
    estimator.merge(ROBOT, world.requests(WLAN, A), 0.0)
    assert mean(estimator, WLAN, B) > 0.9


def test_the_access_network_counts_for_servers_never_asked(estimator: Estimator) -> None:
    world = World.drawn(4)
    world.rates = {WLAN: 0.3e6, WWAN: 6e6}
    world.needs_s = dict.fromkeys((A, B, C), 0.02)
    for interface in (WLAN, WWAN):
        for server in (A, B, C):
            estimator.merge(ROBOT, world.probes(interface, server), 0.0)
    estimator.merge(ROBOT, world.requests(WLAN, A), 0.0)
    estimator.merge(ROBOT, world.requests(WWAN, B), 0.0)
    assert mean(estimator, WLAN, B) > 0.9
    assert mean(estimator, WLAN, C) > 0.8
    assert mean(estimator, WWAN, A) < 0.1


def test_a_path_never_probed_is_guessed_from_its_ends_and_in_doubt(estimator: Estimator) -> None:
    world = World.drawn(5)
    world.rates = dict.fromkeys((WLAN, WWAN), 6e6)
    world.needs_s = dict.fromkeys((A, B, C), 0.02)
    world.ways_s = {A: 0.01, B: 0.6, C: 0.01}
    for interface, server in ((WLAN, A), (WWAN, A), (WWAN, B), (WWAN, C)):
        estimator.merge(ROBOT, world.probes(interface, server), 0.0)
    estimator.merge(ROBOT, world.requests(WLAN, A), 0.0)
    far, near = (estimator.estimate(ROBOT, WLAN, server, DETECT, DEADLINE_S, 0.0) for server in (B, C))
    assert far.mean > 0.7, "far away over the other interface, so over this one too"
    assert 0.05 < near.mean < 0.35
    assert near.weight < 3.0


def test_untried_pairs_neither_win_nor_are_banned(estimator: Estimator) -> None:
    world = World.drawn(6)
    world.rates = dict.fromkeys((WLAN, WWAN), 6e6)
    world.needs_s = dict.fromkeys((A, B, C), 0.02)
    world.ways_s = dict.fromkeys((A, B, C), 0.02)
    for server in (A, B):
        estimator.merge(ROBOT, world.probes(WLAN, server), 0.0)
    estimator.merge(ROBOT, world.requests(WLAN, A, count=2000), 0.0)
    tried, untried = (estimator.estimate(ROBOT, WLAN, server, DETECT, DEADLINE_S, 0.0) for server in (A, B))
    assert tried.mean < untried.mean < 0.2
    assert untried.weight < 0.1 * tried.weight
