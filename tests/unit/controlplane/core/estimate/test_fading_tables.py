"""What is not reported any more is forgotten, however many names come and go."""

from __future__ import annotations

import pytest

from plr.controlplane.core.control.control import ControlCore
from plr.controlplane.core.control.events import Settings
from plr.controlplane.core.estimate.estimator import Estimator
from plr.controlplane.core.estimate.fading import FORGET_S, forget_after_s
from plr.controlplane.core.estimate.processing import ComputeTimes
from plr.controlplane.core.publish.messages import CloseReason
from plr.controlplane.core.registry.registry import Refusal
from plr.protos.model.ids import InterfaceName, NodeName, Role, ServiceName
from plr.protos.model.members import CandidateSet, ServiceSet
from plr.protos.model.report import OutcomeReport, Report
from tests.support.samples import PLAN, histogram, interfaces, latency, offer, path, registration, use

pytestmark = pytest.mark.audit("ops-24h")

ROBOT, WLAN = NodeName("robot"), InterfaceName("wlan0")


def report(server: str) -> Report:
    return Report(
        (latency("wlan0", server, histogram(0.02, 0.03), processing=histogram(0.01)),),
        (path("wlan0", server, rtt=histogram(0.02)),),
        (OutcomeReport(PLAN, ok=2),),
    )


def test_it_is_kept_for_an_hour_and_longer_where_it_fades_slowly() -> None:
    assert forget_after_s(60.0) == FORGET_S
    assert forget_after_s(600.0) == 18_000.0


def test_paths_to_servers_that_never_come_back_are_forgotten() -> None:
    estimator = Estimator(half_life_s=60.0)
    for hour in range(50):
        for minute in range(3):
            estimator.merge(ROBOT, report(f"cloud-{hour}"), hour * 3600.0 + minute * 60.0)
    assert {state.server for state in estimator.paths(ROBOT)} <= {"cloud-48", "cloud-49"}
    tables = estimator._robots[ROBOT]
    assert {server for _, server, _ in tables.trials} <= {"cloud-48", "cloud-49"}
    assert len(tables.network) <= 4
    assert estimator._histograms == len(tables.network)
    assert estimator.dropped == 0


def test_robots_that_never_come_back_are_forgotten_also_those_without_histograms() -> None:
    estimator = Estimator(half_life_s=60.0)
    for number in range(100):
        name = NodeName(f"robot-{number}")
        estimator.merge(name, report("cloud"), number * 600.0)
        estimator.merge(name, Report(outcomes=(OutcomeReport(ServiceName("/other"), ok=1),)), number * 600.0)
        estimator.forget_paths(name)
    assert set(estimator._robots) == {f"robot-{number}" for number in range(93, 100)}
    assert estimator._histograms == sum(len(tables.network) for tables in estimator._robots.values())


def test_who_is_away_for_less_than_an_hour_finds_its_past() -> None:
    estimator = Estimator(half_life_s=60.0)
    estimator.merge(ROBOT, report("cloud"), 0.0)
    estimator.merge(NodeName("other"), report("cloud"), FORGET_S - 1.0)
    assert estimator.path_up(ROBOT, WLAN, NodeName("cloud"))
    estimator.merge(NodeName("other"), report("cloud"), FORGET_S + 1.0)
    assert estimator.path_up(ROBOT, WLAN, NodeName("cloud")) is None


def test_servers_that_never_come_back_count_for_no_usual_times() -> None:
    compute = ComputeTimes(60.0)
    for number in range(50):
        compute.merge(ROBOT, NodeName(f"cloud-{number}"), PLAN, histogram(0.01, times=5), number * 600.0)
    assert len(compute._servers) == 7
    assert len(compute._services[PLAN].servers) == 7
    assert len(compute._kept) == 7
    assert compute.dropped == 0


def test_a_server_that_is_gone_keeps_no_robots() -> None:
    """Its set has all of them as they were then, a kilobyte each, and 4,096 that are gone are remembered."""
    core = ControlCore(Settings(warm_up_s=0.0), version_epoch=1, now=0.0)
    for name, role in (("robot", Role.ROBOT), ("cloud", Role.CLOUD)):
        stream = core.register(registration(name, role), 0.0)
        assert not isinstance(stream, Refusal)
        core.receive(stream, CandidateSet(interfaces("eth0")), 0.0)
        core.receive(stream, ServiceSet((offer(),)) if role is Role.CLOUD else ServiceSet((), (use(),)), 0.0)
    core.handle_timer(1.0)
    cloud = NodeName("cloud")
    assert core._publisher[cloud].peers.sent is not None
    core.end_stream(cloud, CloseReason.CERTIFICATE_ENDED, 1.0)
    core.handle_timer(100.0)
    assert core.registry.get(cloud) is None
    snapshots = core._publisher._gone[cloud]
    assert snapshots.peers.sent is None
    assert snapshots.known_names == {"robot"}
