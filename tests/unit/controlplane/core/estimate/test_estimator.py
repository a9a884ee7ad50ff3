"""What the estimator believes of a pair, from much, little and no evidence."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.core.estimate import estimator as estimator_module
from plr.controlplane.core.estimate import network as network_module
from plr.controlplane.core.estimate import processing as compute_module
from plr.controlplane.core.estimate.estimator import LIVE_S, Estimator
from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
from plr.protos.model.mapping import Assignment
from plr.protos.model.report import InterfaceJointReport, JointReport, LatencyReport, OutcomeReport, PathReport, Report
from tests.support.samples import PLAN, histogram, latency, path

if TYPE_CHECKING:
    from plr.controlplane.core.estimate.posterior import Estimate

ROBOT = NodeName("robot")
A, B = NodeName("cloud-a"), NodeName("cloud-b")
WLAN, WWAN = InterfaceName("wlan0"), InterfaceName("wwan0")
DEADLINE_S = 0.1


@pytest.fixture
def estimator() -> Estimator:
    return Estimator(half_life_s=60.0)


def miss(estimator: Estimator, server: NodeName = A, now: float = 0.0, interface: InterfaceName = WLAN) -> float:
    return believe(estimator, server, now, interface).mean


def believe(estimator: Estimator, server: NodeName = A, now: float = 0.0, interface: InterfaceName = WLAN) -> Estimate:
    return estimator.estimate(ROBOT, interface, server, PLAN, DEADLINE_S, now)


def test_a_pair_never_heard_of_is_a_coin_toss(estimator: Estimator) -> None:
    assert miss(estimator) == 0.5
    estimator.merge(ROBOT, Report(paths=(path("wlan0", "cloud-a"),)), 0.0)
    assert miss(estimator) == 0.5


def test_many_real_requests_decide_alone(estimator: Estimator) -> None:
    measured = histogram(0.05, times=900)
    measured.merge(histogram(0.2, times=60, lost=40))
    reported = Report(
        latencies=(latency("wlan0", "cloud-a", measured),),
        # The round trips alone would promise no miss at all.
        paths=(path("wlan0", "cloud-a", rtt=histogram(0.01, times=500)),),
    )
    estimator.merge(ROBOT, reported, 0.0)
    assert miss(estimator) == pytest.approx((100 + 5 * 0.005) / (1000 + 5), rel=0.01)


def test_no_requests_let_round_trips_and_processing_decide(estimator: Estimator) -> None:
    quick = Report(
        latencies=(latency("wwan0", "cloud-a", histogram(), processing=histogram(0.02, 0.08, times=50)),),
        paths=(path("wlan0", "cloud-a", rtt=histogram(0.04, times=200)),),
    )
    estimator.merge(ROBOT, quick, 0.0)
    # 40 ms there and back: 20 ms of processing makes it, 80 ms does not, so every other request misses.
    assert miss(estimator) == pytest.approx(0.5, abs=0.02)
    quicker = Report(
        latencies=(latency("wwan0", "cloud-b", histogram(), processing=histogram(0.02, times=100)),),
        paths=(path("wlan0", "cloud-b", rtt=histogram(0.04, times=200)),),
    )
    estimator.merge(ROBOT, quicker, 0.0)
    assert miss(estimator, B) < 0.01


def test_few_requests_are_blended_with_the_round_trips(estimator: Estimator) -> None:
    rtt = path("wlan0", "cloud-a", rtt=histogram(0.01, times=1000))
    elsewhere = latency("wwan0", "cloud-a", histogram(), processing=histogram(0.001, times=50))
    estimator.merge(ROBOT, Report((elsewhere,), (rtt,)), 0.0)
    unused = miss(estimator)
    estimator.merge(ROBOT, Report(latencies=(latency("wlan0", "cloud-a", histogram(0.2, times=10)),)), 0.0)
    few = miss(estimator)
    estimator.merge(ROBOT, Report(latencies=(latency("wlan0", "cloud-a", histogram(0.2, times=90)),)), 0.0)
    many = miss(estimator)
    assert unused < 0.01
    assert few == pytest.approx(10 / (10 + 5), abs=0.15)
    assert many > 0.94


@pytest.mark.parametrize(("processing_s", "interface_is_bad"), [(0.01, True), (0.5, False)], ids=["radio", "server"])
def test_sudden_misses_are_the_interfaces_unless_the_server_explains_them(
    estimator: Estimator, processing_s: float, interface_is_bad: bool
) -> None:
    def report(now: float, missed: int, processing_s: float) -> None:
        took, needed = histogram(0.05), histogram(processing_s)
        over_wlan = replace(latency("wlan0", "cloud-a", took, processing=needed), missed=missed)
        over_wwan = latency("wwan0", "cloud-b", histogram(), processing=histogram(0.01))
        estimator.merge(ROBOT, Report((over_wlan, over_wwan), (path("wlan0", "cloud-b", rtt=histogram(0.02)),)), now)

    for second in range(30):
        report(float(second), 0, 0.01)
    assert miss(estimator, B, 30.0) < 0.05
    for second in range(30, 40):
        report(float(second), 1, processing_s)
    assert miss(estimator, A, 40.0) > 0.5
    assert (miss(estimator, B, 40.0) > 0.5) == interface_is_bad


def test_while_a_server_answers_oddly_its_misses_are_not_the_interfaces(estimator: Estimator) -> None:
    """From its many answers to others it is known too well for a few odd ones to explain the misses."""
    network = histogram(0.02, times=5)
    to_others = Report((latency("wlan0", "cloud-a", network, processing=histogram(0.01, times=100)),))
    usual = latency("wlan0", "cloud-a", network, processing=histogram(0.01, times=5))
    of_b = latency("wwan0", "cloud-b", histogram(), processing=histogram(0.01))
    near_b = path("wlan0", "cloud-b", rtt=histogram(0.02))
    for second in range(30):
        estimator.merge(NodeName("other"), to_others, float(second))
        estimator.merge(ROBOT, Report((usual, of_b), (near_b,)), float(second))
    known = miss(estimator, A, 29.9), miss(estimator, B, 29.9)
    odd = replace(latency("wlan0", "cloud-a", network, processing=histogram(0.5, times=5)), missed=5)
    estimator.merge(ROBOT, Report((odd,), (near_b,)), 30.0)
    assert miss(estimator, A, 30.0) > 2 * known[0]
    assert miss(estimator, B, 30.0) == pytest.approx(known[1], rel=0.1)


def test_a_servers_last_answers_are_odd_until_it_answers_as_usual() -> None:
    times = compute_module.ComputeTimes(half_life_s=60.0)
    found = []
    for second, took in enumerate([0.01] * 30 + [0.5] + [0.01] * 5):
        times.merge(ROBOT, A, PLAN, histogram(took), float(second))
        found.append(times.is_odd(A, PLAN))
    assert found[20:31] == [False] * 10 + [True]
    assert not found[-1]


def test_loss_costs_a_round_trip(estimator: Estimator) -> None:
    lossy = PathReport(WLAN, A, up=True, rtt=histogram(0.06, times=400), datagrams_sent=100, datagrams_lost=20)
    estimator.merge(ROBOT, Report(paths=(lossy,)), 0.0)
    assert miss(estimator) == pytest.approx(0.2, abs=0.01)
    worse = PathReport(WLAN, B, up=True, rtt=histogram(0.06, times=300, lost=100))
    estimator.merge(ROBOT, Report(paths=(worse,)), 0.0)
    assert miss(estimator, B) == pytest.approx(0.25, abs=0.01)


def test_old_evidence_fades_back_to_doubt(estimator: Estimator) -> None:
    estimator.merge(ROBOT, Report(latencies=(latency("wlan0", "cloud-a", histogram(0.01, times=600)),)), 0.0)
    fresh, hour_later = miss(estimator), miss(estimator, now=3600.0)
    assert fresh < 0.001
    assert hour_later == pytest.approx(0.5)
    assert believe(estimator).weight > 100.0
    assert believe(estimator, now=3600.0).weight == pytest.approx(1.0)


def test_misses_count_when_the_deadline_is_over_though_the_latency_is_not_known_yet(estimator: Estimator) -> None:
    judged = LatencyReport(WLAN, A, PLAN, 0, histogram(), histogram(), histogram(), requests=95, missed=50)
    estimator.merge(ROBOT, Report(latencies=(judged,)), 0.0)
    assert miss(estimator) == pytest.approx(50.5 / 96, rel=0.01)


def together(requests: int, both_missed: int, *, second: str = B) -> JointReport:
    return JointReport(PLAN, Assignment(WLAN, A), Assignment(WWAN, NodeName(second)), requests, both_missed)


def both_miss(estimator: Estimator, product: float, now: float = 0.0) -> float:
    return estimator.both_miss(ROBOT, PLAN, Assignment(WLAN, A), Assignment(WWAN, B), product, now).mean


def test_paths_fail_independently_until_seen_to_fail_together(estimator: Estimator) -> None:
    assert both_miss(estimator, 0.01) == pytest.approx(0.01)
    estimator.merge(ROBOT, Report(joints=(together(20, 2),)), 0.0)
    assert both_miss(estimator, 0.01) == pytest.approx((2 + 20 * 0.01) / 40, abs=0.02)
    estimator.merge(ROBOT, Report(joints=(together(2000, 200),)), 0.0)
    assert both_miss(estimator, 0.01) == pytest.approx(0.1, rel=0.02)
    assert both_miss(estimator, 0.01, now=3600.0) == pytest.approx(0.01)
    assert estimator.both_miss(ROBOT, PLAN, Assignment(WLAN, B), Assignment(WWAN, A), 0.01, 0.0).mean == 0.01


def shared(
    requests: int, both_missed: int, *, server: NodeName | None = None, over: str = WWAN
) -> InterfaceJointReport:
    alone = requests // 2, 1, 0
    return InterfaceJointReport(PLAN, WLAN, InterfaceName(over), server, requests, both_missed, *alone)


def test_what_two_interfaces_have_in_common_is_remembered_for_minutes(estimator: Estimator) -> None:
    estimator.merge(ROBOT, Report(interface_joints=(shared(20, 2),)), 0.0)
    estimator.merge(ROBOT, Report(interface_joints=(shared(20, 4), shared(5, 5, server=B))), 120.0)
    two, one = estimator.common_misses(ROBOT, PLAN, 120.0)
    kept = 0.5**0.2
    assert two[:3] == (WLAN, WWAN, None)
    assert (two[3].requests, two[3].both_missed) == pytest.approx((20 * kept + 20, 2 * kept + 4))
    assert one[:3] == (WLAN, WWAN, B)
    assert not list(estimator.common_misses(ROBOT, ServiceName("/other"), 120.0))


def test_going_up_or_down_is_news(estimator: Estimator) -> None:
    assert estimator.path_up(ROBOT, WLAN, A) is None
    assert estimator.merge(ROBOT, Report(paths=(path("wlan0", "cloud-a"),)), 0.0)
    assert not estimator.merge(ROBOT, Report(paths=(path("wlan0", "cloud-a"),)), 1.0)
    assert estimator.path_up(ROBOT, WLAN, A) is True
    assert estimator.merge(ROBOT, Report(paths=(path("wlan0", "cloud-a", up=False),)), 2.0)
    assert estimator.path_up(ROBOT, WLAN, A) is False
    assert [report.up for report in estimator.paths(ROBOT)] == [False]
    estimator.forget_paths(ROBOT)
    assert estimator.path_up(ROBOT, WLAN, A) is None


@pytest.mark.audit("ops-12")
def test_what_an_interface_never_reached_tells_nothing_of_it_once_it_reached_others(estimator: Estimator) -> None:
    """The carrier of a site leads to the site's own server alone; one that leads nowhere at all is dark."""

    def seen() -> dict[tuple[str, str], bool]:
        views = estimator.path_views(NodeName("robot"))
        return {(view.interface, view.server): view.up for view in views if view.leads_there}

    estimator.merge(
        NodeName("robot"),
        Report(paths=(path("wlan0", "edge"), path("wlan0", "far", up=False), path("wwan0", "far", up=False))),
        0.0,
    )
    assert seen() == {("wlan0", "edge"): True, ("wwan0", "far"): False}
    estimator.merge(NodeName("robot"), Report(paths=(path("wlan0", "edge", up=False),)), 1.0)
    assert seen() == {("wlan0", "edge"): False, ("wwan0", "far"): False}
    estimator.merge(NodeName("robot"), Report(paths=(path("wlan0", "far"),)), 2.0)
    assert seen()["wlan0", "far"]


def test_observed_misses(estimator: Estimator) -> None:
    assert estimator.observed_miss_ratio(ROBOT, PLAN, 0.0) is None
    estimator.merge(ROBOT, Report(outcomes=(OutcomeReport(PLAN, ok=90, deadline_missed=8, failed=2),)), 0.0)
    assert estimator.observed_miss_ratio(ROBOT, PLAN, 0.0) == pytest.approx(0.1)
    assert estimator.observed_miss_ratio(ROBOT, PLAN, 3600.0) is None


def test_tables_are_bounded_and_evictions_counted(estimator: Estimator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimator_module, "MAX_PAIRS_PER_ROBOT", 4)
    monkeypatch.setattr(network_module, "MAX_PATHS_PER_ROBOT", 4)
    monkeypatch.setattr(network_module, "MAX_CELLS", 4)
    monkeypatch.setattr(estimator_module, "MAX_OUTCOMES_PER_ROBOT", 4)
    monkeypatch.setattr(compute_module, "MAX_PROCESSING", 4)
    monkeypatch.setattr(estimator_module, "MAX_JOINTS_PER_ROBOT", 4)
    monkeypatch.setattr(estimator_module, "MAX_FATES_PER_ROBOT", 4)
    for number in range(6):
        measured = histogram(0.01)
        estimator.merge(
            ROBOT,
            Report(
                latencies=(latency("wlan0", f"cloud-{number}", measured, processing=measured),),
                paths=(path("wlan0", f"cloud-{number}"),),
                outcomes=(OutcomeReport(ServiceName(f"/service_{number}"), ok=1),),
                joints=(together(1, 0, second=f"cloud-{number}"),),
                interface_joints=(shared(4, 0, over=f"wwan{number}"),),
            ),
            float(number),
        )
    # Two of each, and three of what follows first copies: it is of the latencies' service as well.
    assert estimator.dropped == 7 * 2 + 3
    assert estimator.path_up(ROBOT, WLAN, NodeName("cloud-1")) is None
    assert estimator.path_up(ROBOT, WLAN, NodeName("cloud-5")) is True


@pytest.mark.audit("ops-17")
def test_of_a_full_table_silent_robots_are_forgotten_the_longest_silent_first(
    estimator: Estimator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimator_module, "MAX_HISTOGRAMS", 3)
    for number, name in enumerate(("one", "two", "three")):
        estimator.merge(NodeName(name), Report(paths=(path("wlan0", "cloud-a"),)), float(number))
    estimator.merge(NodeName("one"), Report(), 50.0)
    now = 2.0 + LIVE_S
    estimator.merge(NodeName("one"), Report(paths=(path("wwan0", "cloud-a"),)), now)
    assert estimator.path_up(NodeName("two"), WLAN, A) is None
    assert estimator.path_up(NodeName("one"), InterfaceName("wwan0"), A) is True
    assert estimator.path_up(NodeName("three"), WLAN, A) is True
    assert estimator.dropped == 1


@pytest.mark.audit("ops-17")
def test_a_full_table_forgets_nobody_in_turn(estimator: Estimator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimator_module, "MAX_HISTOGRAMS", 40)
    robots = [NodeName(f"robot-{number}") for number in range(8)]
    servers = [f"cloud-{number}" for number in range(20)]
    for turn in range(5):
        # One of them reports on more than all the others together.
        for number, robot in enumerate(robots):
            told = servers if number == 0 else servers[:3]
            estimator.merge(robot, Report(paths=tuple(path("wlan0", server) for server in told)), float(turn))
    for robot in robots:
        assert estimator.path_up(robot, WLAN, NodeName("cloud-2")) is True
    assert estimator._histograms == sum(len(tables.network) for tables in estimator._robots.values()) <= 2 * 40
    # A newcomer gets its share.
    estimator.merge(NodeName("new"), Report(paths=tuple(path("wlan0", server) for server in servers)), 5.0)
    assert estimator.path_up(NodeName("new"), WLAN, NodeName("cloud-3")) is True
    assert estimator.path_up(NodeName("new"), WLAN, NodeName("cloud-4")) is None
    assert estimator.dropped
