from __future__ import annotations

from typing import TYPE_CHECKING

from protos.model import Assignment, JointReport, OutcomeReport
from sidecar.core import measurements as measurements_module
from sidecar.core.link_events import PathMeasured
from sidecar.core.measurements import Measurements
from sidecar.core.path_id import PathState
from sidecar.core.routes import Routes
from tests.unit.sidecar.core.builders import ECHO, WLAN, WWAN, A, B, path

if TYPE_CHECKING:
    import pytest


def test_latencies_are_kept_by_interface_server_and_service_with_what_was_lost() -> None:
    measurements = Measurements()
    measurements.answered(path(WLAN), ECHO, 0.050, 0.010)
    measurements.answered(path(WLAN), ECHO, 0.060, 0.010)
    measurements.lost(path(WLAN), ECHO)
    measurements.lost(path(WWAN), ECHO)
    wlan, wwan = measurements.take(Routes(), []).latencies
    assert (wlan.interface, wlan.server, wlan.service) == (WLAN, A, ECHO)
    assert (sum(wlan.latency.counts), wlan.latency.lost, sum(wlan.processing.counts)) == (2, 1, 2)
    assert (sum(wwan.latency.counts), wwan.latency.lost, sum(wwan.processing.counts)) == (0, 1, 0)


def test_a_report_is_taken_once() -> None:
    measurements = Measurements()
    measurements.answered(path(), ECHO, 0.1, 0.1)
    measurements.outcome(ECHO, "ok")
    assert measurements.take(Routes(), []).latencies
    empty = measurements.take(Routes(), [])
    assert (empty.latencies, empty.paths, empty.outcomes) == ((), (), ())


def test_paths_between_the_same_two_are_one_report_and_the_unmeasured_are_told_too() -> None:
    routes, measurements = Routes(), Measurements()
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


def test_outcomes_are_counted_and_a_rejection_is_a_failure() -> None:
    measurements = Measurements()
    for outcome in ("ok", "ok", "deadline_missed", "failed", "rejected"):
        measurements.outcome(ECHO, outcome)
    assert measurements.take(Routes(), []).outcomes == (OutcomeReport(ECHO, ok=2, deadline_missed=1, failed=2),)


def test_joint_outcomes_are_counted_by_pair_of_paths_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measurements_module, "MAX_JOINTS", 1)
    measurements = Measurements()
    first, second = Assignment(WLAN, A), Assignment(WWAN, B)
    for missed in (True, False, False):
        assert measurements.judged_together(ECHO, first, second, both_missed=missed)
    assert not measurements.judged_together(ECHO, first, Assignment(WWAN, A), both_missed=True)
    assert measurements.take(Routes(), []).joints == (JointReport(ECHO, first, second, 3, 1),)
    assert measurements.take(Routes(), []).joints == ()


def test_what_is_judged_at_the_deadline_is_told_before_its_latency_is_known() -> None:
    measurements = Measurements()
    measurements.judged(path(WLAN), ECHO, missed=True)
    measurements.judged(path(WLAN), ECHO, missed=False)
    (early,) = measurements.take(Routes(), []).latencies
    assert (early.requests, early.missed, early.latency.total) == (2, 1, 0)
    measurements.lost(path(WLAN), ECHO)
    (late,) = measurements.take(Routes(), []).latencies
    assert (late.requests, late.missed, late.latency.lost) == (0, 0, 1)
