"""What one stream may send: more than any honest sidecar does, and no more."""

from __future__ import annotations

import pytest

from plr.controlplane.serve.stream_limits import (
    ENTRIES_PER_TOKEN,
    MAX_STREAM_MESSAGE_BYTES,
    MAX_STREAMS_PER_NAME,
    MESSAGES_BURST,
    MESSAGES_PER_S,
    MemberRates,
    StreamCount,
    announced_entries,
)
from plr.protos.convert.reports import report_entries
from plr.protos.model.ids import NodeName
from plr.protos.model.members import CandidateSet, ServiceSet
from plr.protos.model.report import OutcomeReport, PenaltyReport, Report
from tests.support.samples import PLAN, interfaces, offer


def test_a_sidecar_that_does_what_it_is_told_is_never_too_fast() -> None:
    for interval_s in (0.05, 0.5, 60.0):
        rates = MemberRates(report_interval_s=interval_s)
        for tick in range(2000):
            now = tick * 0.05
            # A heartbeat as often as the session may, and a report as often as told.
            assert rates.take("a", 2, now)
            if now % interval_s < 0.05:
                assert rates.take("a", 20_000, now)


def test_who_sends_without_pause_is_too_fast() -> None:
    rates = MemberRates(report_interval_s=0.5)
    sent = sum(rates.take("a", 10, second / 1000) for second in range(10_000))
    assert sent <= MESSAGES_BURST + 10 * (MESSAGES_PER_S + 4) + 1


def test_large_messages_count_by_their_size() -> None:
    rates = MemberRates(report_interval_s=0.5)
    assert rates.take("a", MAX_STREAM_MESSAGE_BYTES, 0.0)
    assert not rates.take("a", MAX_STREAM_MESSAGE_BYTES, 0.0)


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


@pytest.mark.audit("ops-16")
def test_another_stream_of_a_member_does_not_renew_its_rate_and_others_have_their_own() -> None:
    rates = MemberRates(report_interval_s=0.5)
    while rates.take("a", 10, 0.0):
        pass
    assert not rates.take("a", 10, 0.001), "whatever stream it comes by"
    assert rates.take("b", 10, 0.001)
    assert rates.take("a", 10, 1.0)


@pytest.mark.audit("ops-16")
def test_announcements_count_by_what_they_announce() -> None:
    small = CandidateSet(interfaces("wlan0", "wwan0"))
    large = CandidateSet(interfaces(*(f"wlan{number}" for number in range(224))))
    many = ServiceSet(tuple(offer(f"/service_{number}") for number in range(1024)), unmet=(PLAN,))
    assert [announced_entries(each) for each in (small, large, many, Report())] == [2, 224, 1025, 0]
    rates = MemberRates(report_interval_s=0.5)
    assert all(rates.take_entries("a", announced_entries(small), 0.0) for _ in range(10_000))
    seconds = 100
    taken = sum(rates.take_entries("a", 1025, tick / 10) for tick in range(10 * seconds))
    assert taken <= (MESSAGES_BURST + seconds * (MESSAGES_PER_S + 4.0)) / (1025 / ENTRIES_PER_TOKEN)
    assert taken >= 1
