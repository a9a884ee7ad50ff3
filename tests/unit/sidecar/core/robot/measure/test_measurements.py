from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest

from plr.protos.convert import parse_sidecar_message, sidecar_message_to_proto
from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
from plr.protos.model.mapping import Assignment
from plr.protos.model.report import MAX_PATH_REPORTS, InterfaceJointReport, JointReport, OutcomeReport
from plr.sidecar.core.base.report_scope import ReportScope
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.robot.measure import measurements as measurements_module
from plr.sidecar.core.robot.measure.measurements import InterfacePair, Measurements, PairOutcome
from plr.sidecar.core.robot.request.request import Carried
from plr.sidecar.core.seam.links import PathMeasured
from plr.sidecar.core.transfer.routes import Routes
from tests.support.builders import ECHO, WLAN, WWAN, A, B, path

ON_WLAN, ON_WWAN = Carried(WLAN, A, ECHO, 0), Carried(WWAN, A, ECHO, 3)


@pytest.fixture
def measurements() -> Measurements:
    return Measurements(Counter())


def test_the_networks_share_is_kept_apart_from_the_servers(measurements: Measurements) -> None:
    measurements.answered(ON_WLAN, 0.050, 0.010, 0)
    measurements.answered(ON_WLAN, 0.030, 0.040, 0)
    measurements.called_off(ON_WLAN, 0.1)
    measurements.lost(ON_WWAN, delivered=False)
    measurements.lost(ON_WWAN, delivered=True)
    wlan, wwan = measurements.take(Routes(), []).latencies
    assert (wlan.interface, wlan.server, wlan.service, wlan.size_class) == (WLAN, A, ECHO, 0)
    assert wlan.network.quantile(1.0) == pytest.approx(0.040, rel=0.02)
    assert wlan.network.quantile(0.5) < 1e-4, "a server that claims more than all of it"
    assert wlan.processing.mean() == pytest.approx(0.025, rel=0.02)
    assert (wlan.called_off.answered, wlan.network.lost) == (1, 0)
    assert (wwan.network.lost, wwan.processing.lost, wwan.network.answered, wwan.size_class) == (1, 1, 0, 3)


def test_the_size_of_the_last_answer_counts_as_well(measurements: Measurements) -> None:
    assert measurements.size_class(ECHO, 1000) == 0
    measurements.answered(ON_WLAN, 0.1, 0.0, 50_000)
    assert measurements.size_class(ECHO, 1000) == 3
    measurements.take(Routes(), [])
    assert measurements.size_class(ECHO, 1000) == 3
    assert measurements.size_class(ServiceName("/other"), 1000) == 0


def test_what_a_report_has_no_room_for_is_left_out_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measurements_module, "MAX_LATENCIES", 1)
    dropped: Counter[str] = Counter()
    measurements = Measurements(dropped)
    measurements.judged(ON_WLAN, missed=True)
    measurements.judged(ON_WWAN, missed=True)
    measurements.judged(ON_WLAN, missed=True)
    assert [report.requests for report in measurements.take(Routes(), []).latencies] == [2]
    assert dropped == {"latencies_full": 1}


def test_a_report_is_taken_once(measurements: Measurements) -> None:
    measurements.judged(ON_WLAN, missed=False)
    measurements.outcome(ECHO, "ok")
    assert measurements.take(Routes(), []).latencies
    empty = measurements.take(Routes(), [])
    assert (empty.latencies, empty.paths, empty.outcomes) == ((), (), ())


def test_paths_between_the_same_two_are_one_report_and_the_unmeasured_are_told_too(measurements: Measurements) -> None:
    routes = Routes()
    for known, state in (
        (path(WLAN), PathState.DOWN),
        (path(WLAN, A, 1), PathState.UP),
        (path(WWAN), PathState.UNSTABLE),
    ):
        routes.set_state(known, state)
    measurements.path(PathMeasured(path(WLAN), 0.1, (0.1, 0.2), 10, 1))
    measurements.path(PathMeasured(path(WLAN, A, 1), 0.1, (0.1,), 5, 2))
    wlan, wwan = measurements.take(routes, [A]).paths
    assert (wlan.interface, wlan.up, sum(wlan.rtt.counts), wlan.datagrams_sent, wlan.datagrams_lost) == (
        WLAN, True, 3, 15, 3,
    )  # fmt: skip
    assert (wwan.interface, wwan.up, wwan.datagrams_sent) == (WWAN, False, 0)


@pytest.mark.audit("ops-20")
def test_changes_are_told_without_the_rest_which_is_told_later(measurements: Measurements) -> None:
    routes, gone = Routes(), path(WLAN, NodeName("gone"))
    for known in (path(WLAN), path(WLAN, A, 1), path(WWAN)):
        routes.set_state(known, PathState.UP)
        measurements.path(PathMeasured(known, 0.1, (0.1,), 10, 1))
    assert measurements.take_urgency() is None
    routes.set_state(path(WLAN), PathState.DOWN)
    measurements.note_path_change(path(WLAN))
    measurements.note_path_change(gone)
    measurements.answered(ON_WWAN, 0.1, 0.0, 0)
    assert measurements.take_urgency() is ReportScope.CHANGES
    assert measurements.take_urgency() is None
    measurements.outcome(ECHO, "deadline_missed")
    assert measurements.take_urgency() is ReportScope.ALL
    told = measurements.take_changes(routes)
    assert told.changes_only
    assert told.latencies == ()
    assert told.outcomes == ()
    (wlan,) = told.paths
    assert (wlan.interface, wlan.up, wlan.datagrams_sent) == (WLAN, True, 20), "another path between the two is up"
    assert measurements.take_changes(routes).paths == ()
    assert measurements.take_urgency() is None, "the whole report was asked for"
    rest = measurements.take(routes, [A])
    assert [(one.interface, one.datagrams_sent) for one in rest.paths] == [(WLAN, 0), (WWAN, 10)]
    assert len(rest.latencies) == len(rest.outcomes) == 1
    measurements.note_path_change(path(WWAN))
    measurements.take(routes, [A])
    assert measurements.take_urgency() is None, "told by the whole report"


def test_outcomes_are_counted_and_a_rejection_is_a_failure(measurements: Measurements) -> None:
    for outcome in ("ok", "ok", "deadline_missed", "failed", "rejected"):
        measurements.outcome(ECHO, outcome)
    assert measurements.take(Routes(), []).outcomes == (OutcomeReport(ECHO, ok=2, deadline_missed=1, failed=2),)


def test_joint_outcomes_are_counted_by_pair_of_paths_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measurements_module, "MAX_JOINTS", 1)
    dropped: Counter[str] = Counter()
    measurements = Measurements(dropped)
    first, second = Assignment(WLAN, A), Assignment(WWAN, B)
    for missed in (True, False, False):
        measurements.judged_together(ECHO, first, second, both_missed=missed)
    assert not dropped
    measurements.judged_together(ECHO, first, Assignment(WWAN, A), both_missed=True)
    assert dropped == {"joint_outcomes_full": 1}
    assert measurements.take(Routes(), []).joints == (JointReport(ECHO, first, second, 3, 1),)
    assert measurements.take(Routes(), []).joints == ()


def test_outcomes_by_pair_of_interfaces_are_counted_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measurements_module, "MAX_JOINTS", 1)
    dropped: Counter[str] = Counter()
    measurements = Measurements(dropped)
    pair = InterfacePair(ECHO, WLAN, WWAN, None)
    for missed in ((True, True), (True, False), (True, False), (False, True), (False, False)):
        for raced in (True, False):
            measurements.judged_interfaces(pair, PairOutcome(*missed, raced))
    assert not dropped
    measurements.judged_interfaces(replace(pair, server=A), PairOutcome(True, True, True))
    assert dropped == {"joint_outcomes_full": 1}
    told = InterfaceJointReport(ECHO, WLAN, WWAN, None, 10, 2, 5, 2, 1)
    assert measurements.take(Routes(), []).interface_joints == (told,)
    assert measurements.take(Routes(), []).interface_joints == ()


def test_paths_that_one_report_has_no_room_for_are_told_by_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measurements_module, "MAX_PATH_REPORTS", 4)
    dropped: Counter[str] = Counter()
    measurements, routes = Measurements(dropped), Routes()
    servers = [NodeName(f"cloud-{number}") for number in range(3)]
    pairs = {(nic, server) for nic in (WLAN, WWAN) for server in servers}

    def told(known: list[NodeName]) -> set[tuple[InterfaceName, NodeName]]:
        paths = measurements.take(routes, known).paths
        found = {(report.interface, report.server) for report in paths}
        assert len(found) == len(paths) <= 4, "none twice"
        return found

    for nic, server in pairs:
        routes.set_state(path(nic, server), PathState.UP)
    assert len(told(servers[:2])) == 4
    assert not dropped
    turns = [told(servers) for _ in range(3)]
    assert dropped == {"path_reports_full": 3 * 2}
    assert turns[0] | turns[1] == pairs
    assert Counter(pair for turn in turns for pair in turn) == dict.fromkeys(pairs, 2)
    # Fewer now: where the last turn ended does not exist any more.
    routes.forget_peer(servers[2])
    routes.set_state(path("eth0", servers[0]), PathState.UP)
    assert len(told(servers[:2]) | told(servers[:2])) == 5


def test_a_report_of_the_most_paths_is_one_that_the_control_plane_takes() -> None:
    measurements, routes = Measurements(Counter()), Routes()
    servers = [NodeName(f"cloud-{number}") for number in range(MAX_PATH_REPORTS // 2 + 1)]
    for server in servers:
        for nic in (WLAN, WWAN):
            routes.set_state(path(nic, server), PathState.UP)
    report = measurements.take(routes, servers)
    assert parse_sidecar_message(sidecar_message_to_proto(report).SerializeToString()) == report


def test_what_is_judged_at_the_deadline_is_told_before_its_times_are_known(measurements: Measurements) -> None:
    measurements.judged(ON_WLAN, missed=True)
    measurements.judged(ON_WLAN, missed=False)
    (early,) = measurements.take(Routes(), []).latencies
    assert (early.requests, early.missed, early.network.total) == (2, 1, 0)
    measurements.lost(ON_WLAN, delivered=False)
    (late,) = measurements.take(Routes(), []).latencies
    assert (late.requests, late.missed, late.network.lost) == (0, 0, 1)


@pytest.mark.audit("ops-18")
def test_a_missed_deadline_is_urgent_once_for_each_report(measurements: Measurements) -> None:
    measurements.outcome(ECHO, "ok")
    assert measurements.take_urgency() is None
    measurements.outcome(ECHO, "deadline_missed")
    assert measurements.take_urgency() is ReportScope.ALL
    measurements.outcome(ECHO, "deadline_missed")
    assert measurements.take_urgency() is None
    measurements.take(Routes(), [])
    assert measurements.take_urgency() is None
    measurements.outcome(ECHO, "deadline_missed")
    assert measurements.take_urgency() is ReportScope.ALL
