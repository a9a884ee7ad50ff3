from __future__ import annotations

from protos.model import OutcomeReport
from sidecar.core.link_events import PathMeasured
from sidecar.core.measurements import Measurements
from sidecar.core.path_id import PathState
from sidecar.core.routes import Routes
from tests.unit.sidecar.core.builders import ECHO, WLAN, WWAN, A, path


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
