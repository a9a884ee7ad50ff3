"""A robot that lies in its reports: what it may not call it bears no witness to, and what it may it moves a little."""

from __future__ import annotations

import pytest

from plr.controlplane.cli.explanation_text import render
from plr.controlplane.core.control.events import Settings
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy
from plr.protos.base.histogram import MAX_COUNT, Histogram
from plr.protos.model.ids import InterfaceName, NodeName, Role, ServiceName
from plr.protos.model.mapping import Assignment
from plr.protos.model.members import CandidateSet, ServiceSet
from plr.protos.model.report import LatencyReport, Report
from tests.support.control_world import World
from tests.support.samples import histogram, interfaces, latency, offer, registration, use

pytestmark = pytest.mark.audit("sec-10")

QUICK, SLOW = "cloud-a", "cloud-b"
NEEDS_S = {QUICK: 0.020, SLOW: 0.300}
"""The deadline is between the two."""
VICTIMS = 3


class Fleet:
    """Robots whose calls take what they take, and one whose reports say what it likes."""

    def __init__(self, *, permitted: bool) -> None:
        liars = CallRule(("evil",), ("/plan" if permitted else "/other",), ("*",))
        policy = Policy((CallRule(("victim*",), ("/plan",), ("*",)), liars), (OfferRule(("*",), ("*",)),))
        self.world = World(Settings(warm_up_s=0.0, policy=policy))
        for name in (QUICK, SLOW):
            cloud = self.world.join(registration(name, Role.CLOUD))
            self.world.say(cloud, CandidateSet(interfaces("eth0")))
            self.world.say(cloud, ServiceSet((offer("/plan"), offer("/other"))))
        self.victims = [self.world.robot(f"victim{number}", "wlan0") for number in range(VICTIMS)]
        self.evil = self.world.join(registration("evil", Role.ROBOT))
        self.world.say(self.evil, CandidateSet(interfaces("wlan0")))
        self.world.say(self.evil, ServiceSet((), (use("/plan" if permitted else "/other"),)))

    def call(self, seconds: int, rate: int = 10, lies: int = 0, every_s: int = 1) -> float:
        """So many seconds of calls; returns the share that missed."""
        missed = total = 0
        for second in range(seconds):
            if lies and second % every_s == 0:
                self.lie(lies)
            for victim in self.victims:
                self.world.all_up(victim, (QUICK, SLOW), "wlan0")
                server = victim.pairs().get("wlan0")
                if server is None:
                    continue
                late = rate if server == SLOW else 0
                missed, total = missed + late, total + rate
                took = histogram(NEEDS_S[server], times=rate)
                found = LatencyReport(
                    InterfaceName("wlan0"),
                    NodeName(server),
                    ServiceName("/plan"),
                    0,
                    histogram(0.010, times=rate),
                    Histogram(),
                    took,
                    requests=rate,
                    missed=late,
                )
                self.world.say(victim, Report(latencies=(found,)))
            self.world.run(1.0)
        return missed / total

    def lie(self, samples: int) -> None:
        """The quick server needs ages, and the slow one nothing."""
        ages, nothing = (Histogram.from_sparse([bucket], [samples], 0) for bucket in (341, 10))
        about = ((QUICK, ages), (SLOW, nothing))
        self.world.say(
            self.evil,
            Report(
                latencies=tuple(
                    latency("wlan0", server, Histogram(), processing=times, service="/plan") for server, times in about
                )
            ),
        )


@pytest.mark.parametrize("samples", [20, MAX_COUNT])
def test_who_may_not_call_a_service_moves_nobodys_mapping(samples: int) -> None:
    """Before: one report moved all of them, and every tenth second of it kept them away for half an hour."""
    fleet = Fleet(permitted=False)
    assert fleet.call(60) < 0.1
    assert fleet.call(120, lies=samples) == 0.0
    assert fleet.world.core.counters.report_entries_forbidden == 2 * 120
    assert fleet.evil.name not in fleet.world.core.estimator._robots or not list(
        fleet.world.core.estimator.paths(fleet.evil.name)
    )


@pytest.mark.parametrize("samples", [20, 1000, MAX_COUNT])
@pytest.mark.parametrize("every_s", [1, 30])
def test_who_may_call_it_costs_the_others_little(samples: int, every_s: int) -> None:
    fleet = Fleet(permitted=True)
    assert fleet.call(60) < 0.1
    share = fleet.call(180, lies=samples, every_s=every_s)
    assert share < 0.05


def test_lies_from_the_beginning_are_outvoted() -> None:
    fleet = Fleet(permitted=True)
    share = fleet.call(240, lies=MAX_COUNT)
    assert share < 0.2
    assert fleet.call(60, lies=MAX_COUNT) < 0.05


def test_explain_tells_who_counts_for_how_much() -> None:
    fleet = Fleet(permitted=True)
    fleet.call(60, lies=MAX_COUNT)
    found = fleet.world.core.explain(fleet.victims[0].name, ServiceName("/plan"), fleet.world.now)
    of_quick = next(pair for pair in found.pairs if pair.path.server == QUICK)
    assert of_quick.witnesses == VICTIMS + 1
    assert of_quick.busiest_share < 0.5
    assert f"cloud-a:  4 robots,  {of_quick.busiest_witness} counts for {of_quick.busiest_share:.0%}" in render(found)
    assert "cloud-b:  1 robot,   evil counts for 100%" in render(found)


def test_explain_does_not_tell_a_robot_that_it_is_its_own_witness() -> None:
    world = World()
    world.cloud("a")
    robot = world.robot()
    world.all_up(robot, ("a",))
    world.say(robot, Report(latencies=(latency("wlan0", "a", histogram(0.01), processing=histogram(0.01)),)))
    world.run(3.0)
    assert "who says" not in render(world.core.explain(robot.name, ServiceName("/plan"), world.now))


def test_a_server_that_changes_its_offers_evicts_nothing_of_another() -> None:
    fleet = Fleet(permitted=True)
    fleet.call(10)
    world, rogue = fleet.world, fleet.world.join(registration("rogue", Role.CLOUD))
    world.say(rogue, CandidateSet(interfaces("eth0")))
    evidence = world.core.estimator.evidence
    quick = Assignment(InterfaceName("wlan0"), NodeName(QUICK))
    known = evidence(NodeName("victim0"), quick, ServiceName("/plan"), world.now).compute.total
    lies = CallRule(("evil",), ("*",), ("rogue",))
    world.core.set_policy(Policy((lies,), (OfferRule(("*",), ("*",)),)), world.now)
    for change in range(10):
        names = [f"/evil{change}/{number}" for number in range(1024)]
        world.say(rogue, ServiceSet(tuple(offer(name) for name in names)))
        told = (latency("wlan0", "rogue", histogram(0.01), processing=histogram(0.01), service=name) for name in names)
        world.say(fleet.evil, Report(latencies=tuple(told)))
    left = evidence(NodeName("victim0"), quick, ServiceName("/plan"), world.now).compute.total
    assert left > 0.5 * known > 0
