"""What one stream may send: more than any honest sidecar does, and no more."""

from __future__ import annotations

import pytest

from plr.controlplane.serve.stream_limits import (
    MAX_STREAM_MESSAGE_BYTES,
    MAX_STREAMS_PER_NAME,
    MESSAGES_BURST,
    MESSAGES_PER_S,
    StreamCount,
    StreamRate,
)
from plr.protos.convert.reports import report_entries
from plr.protos.model.ids import NodeName
from plr.protos.model.report import OutcomeReport, PenaltyReport, Report
from tests.support.samples import PLAN


def test_a_sidecar_that_does_what_it_is_told_is_never_too_fast() -> None:
    for interval_s in (0.05, 0.5, 60.0):
        rate = StreamRate(report_interval_s=interval_s, now=0.0)
        for tick in range(2000):
            now = tick * 0.05
            # A heartbeat as often as the session may, and a report as often as told.
            assert rate.take(2, now)
            if now % interval_s < 0.05:
                assert rate.take(20_000, now)


def test_who_sends_without_pause_is_too_fast() -> None:
    rate = StreamRate(report_interval_s=0.5, now=0.0)
    sent = sum(rate.take(10, second / 1000) for second in range(10_000))
    assert sent <= MESSAGES_BURST + 10 * (MESSAGES_PER_S + 4) + 1


def test_large_messages_count_by_their_size() -> None:
    rate = StreamRate(report_interval_s=0.5, now=0.0)
    assert rate.take(MAX_STREAM_MESSAGE_BYTES, 0.0)
    assert not rate.take(MAX_STREAM_MESSAGE_BYTES, 0.0)


def test_streams_are_counted_by_name_and_forgotten_when_they_end() -> None:
    streams = StreamCount()
    assert [streams.enter("a") for _ in range(MAX_STREAMS_PER_NAME + 1)] == [True] * MAX_STREAMS_PER_NAME + [False]
    assert streams.enter("b")
    streams.leave("a")
    assert streams.enter("a")
    assert not streams.enter("a")


@pytest.mark.audit("ops-16")
def test_whatever_a_report_is_made_of_counts() -> None:
    server = NodeName("a")
    outcome = OutcomeReport(PLAN, 1, 0, 0)
    assert report_entries(Report(outcomes=(outcome,) * 3)) == 3
    assert report_entries(Report(penalties=(PenaltyReport(server, 5.0, 3),), goodbyes=(server, server))) == 3
