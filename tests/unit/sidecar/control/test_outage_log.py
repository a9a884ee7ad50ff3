from __future__ import annotations

import logging

import pytest

from plr.sidecar.control.outage_log import REPEATED_FAILURE_LOG_S, OutageLog

LOG = logging.getLogger("outage")


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    found = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    caplog.clear()
    return found


def test_a_long_outage_is_told_once_and_then_now_and_again(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    outage = OutageLog(LOG, "plr:1")
    outage.failed("reset", 0.1, 0.0, was_connected=True)
    outage.failed("refused", 0.2, 1.0, was_connected=False)
    assert [line.split(";")[0] for line in warnings(caplog)] == [
        "control plane plr:1 lost: reset",
        "control plane plr:1 not reached: refused",
    ]
    for second in range(2, int(REPEATED_FAILURE_LOG_S)):
        outage.failed("refused", 0.2, float(second), was_connected=False)
    assert warnings(caplog) == []
    outage.failed("refused", 0.2, 1.0 + REPEATED_FAILURE_LOG_S, was_connected=False)
    assert len(warnings(caplog)) == 1


def test_a_new_outage_is_told_at_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    outage = OutageLog(LOG, "plr:1")
    for now in (0.0, 1.0):
        outage.over("plr:1 over wlan0")
        outage.failed("reset", 0.1, now, was_connected=True)
        assert len(warnings(caplog)) == 1


@pytest.mark.audit("ops-3")
def test_a_certificate_that_grows_older_is_no_new_reason(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    outage = OutageLog(LOG, "plr:1")
    for second in range(int(REPEATED_FAILURE_LOG_S)):
        outage.failed(f"it expired {second} seconds ago", 0.2, float(second), was_connected=False)
    assert len(warnings(caplog)) == 1
    outage.failed("it was revoked 3 seconds ago", 0.2, 30.0, was_connected=False)
    assert len(warnings(caplog)) == 1
