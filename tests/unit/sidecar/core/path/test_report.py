from __future__ import annotations

import pytest

from plr.sidecar.core.path.congestion.model_controller import ModelController
from plr.sidecar.core.path.recovery import Recovery
from plr.sidecar.core.path.report import MAX_RTT_SAMPLES, PathReport
from plr.sidecar.core.wire.frame import AckFrame
from tests.support.builders import path

PATH = path()


@pytest.fixture
def recovery() -> Recovery:
    return Recovery(0)


def send(recovery: Recovery, count: int) -> int:
    """Send datagrams that elicit an acknowledgement; return the number of the last."""
    for _ in range(count):
        number = recovery.take_numbers()
        recovery.on_finished_sent(number, 1.0, 100, (1,))
    return number


def test_a_report_says_what_is_new_and_nothing_is_none(recovery: Recovery) -> None:
    report, control = PathReport(), ModelController()
    assert report.take(PATH, recovery, control) is None
    last = send(recovery, 4)
    recovery.on_ack(AckFrame(((last, last),), 0.0), 1.1)
    recovery.detect_lost(1.1)
    report.note_rtt(0.1)
    measured = report.take(PATH, recovery, control)
    assert measured is not None
    assert measured.path is PATH
    assert measured.rtts_s == (0.1,)
    assert (measured.sent, measured.lost, measured.arrived) == (4, 1, 1)
    assert not measured.policed
    assert report.take(PATH, recovery, control) is None
    send(recovery, 2)
    measured = report.take(PATH, recovery, control)
    assert measured is not None
    assert (measured.sent, measured.lost, measured.arrived, measured.missed) == (2, 0, 0, 0)


def test_that_a_policer_was_found_is_reported_once(recovery: Recovery) -> None:
    report, control = PathReport(), ModelController()
    control.policer.was_found = True
    assert report.take(PATH, recovery, control) is None, "it waits for something to report"
    found = []
    for _ in range(2):
        report.note_rtt(0.1)
        measured = report.take(PATH, recovery, control)
        assert measured is not None
        found.append(measured.policed)
    assert found == [True, False]


def test_round_trips_are_capped(recovery: Recovery) -> None:
    report = PathReport()
    for _ in range(2 * MAX_RTT_SAMPLES):
        report.note_rtt(0.1)
    measured = report.take(PATH, recovery, ModelController())
    assert measured is not None
    assert len(measured.rtts_s) == MAX_RTT_SAMPLES
