"""One line of a kind per period, and an honest count of the rest."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from plr.sidecar.ros.log_limit import MAX_KINDS, LimitedLog

if TYPE_CHECKING:
    import pytest

LOGGER = logging.getLogger("test_log_limit")


def test_the_first_at_once_then_one_per_period(caplog: pytest.LogCaptureFixture) -> None:
    limited = LimitedLog(LOGGER, period_s=5.0)
    for step in range(100):
        limited.log(logging.WARNING, ("lost", "/a"), 1.0 + step * 0.1, "%s is lost", "/a")
    limited.log(logging.WARNING, ("lost", "/b"), 1.0, "%s is lost", "/b")
    assert [record.getMessage() for record in caplog.records] == [
        "/a is lost",
        "/a is lost (and 49 more like this in the last 5 s)",
        "/b is lost",
    ]


def test_it_remembers_a_bounded_number_of_kinds(caplog: pytest.LogCaptureFixture) -> None:
    limited = LimitedLog(LOGGER)
    for number in range(3 * MAX_KINDS):
        limited.log(logging.WARNING, ("lost", str(number)), number * 0.001, "%d", number)
    assert len(caplog.records) == 3 * MAX_KINDS
    assert len(limited._kinds) == MAX_KINDS
