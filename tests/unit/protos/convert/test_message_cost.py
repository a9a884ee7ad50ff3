"""Messages that would become far more than their bytes are refused before they are parsed."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plr.protos.base.errors import DecodeError, UnknownKindError
from plr.protos.base.histogram import BUCKETS
from plr.protos.convert import message_cost, parse_sidecar_message, sidecar_message_to_proto
from plr.protos.convert.message_cost import CHEAP_BYTES, SPARE_FIELDS, check_cost
from plr.protos.model.report import MAX_LATENCIES, MAX_PATH_REPORTS, Report
from plr.protos.model.stream import Heartbeat, SidecarMessage
from plr.protos.plr.v1 import control_pb2, types_pb2
from tests.support.samples import histogram, latency, path
from tests.unit.protos.message_strategies import sidecar_messages

pytestmark = pytest.mark.audit("ops-16")

BLOAT = 20_000


def bloated() -> dict[str, control_pb2.SidecarMessage]:
    """Messages of 40 kB of empty elements, by kind."""
    services = control_pb2.Services(uses=[types_pb2.ServiceUse()] * BLOAT)
    candidates = control_pb2.Candidates(candidates=[types_pb2.Candidate()] * BLOAT)
    report = control_pb2.Report(joints=[control_pb2.JointReport()] * BLOAT)
    return {
        "services": control_pb2.SidecarMessage(services=services),
        "candidates": control_pb2.SidecarMessage(candidates=candidates),
        "report": control_pb2.SidecarMessage(report=report),
        "revocations": control_pb2.SidecarMessage(
            revocations=control_pb2.Revocations(lists=[control_pb2.HeldList()] * BLOAT)
        ),
    }


@pytest.mark.parametrize("kind", list(bloated()))
def test_what_is_bloated_is_never_parsed(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    data = bloated()[kind].SerializeToString()

    class Parser:
        @staticmethod
        def FromString(_: bytes) -> None:  # protobuf's name
            raise AssertionError("parsed")

    monkeypatch.setattr("plr.protos.convert.control.control_pb2.SidecarMessage", Parser)
    with pytest.raises(DecodeError, match=f"^{kind} has more than [0-9]+ elements$"):
        parse_sidecar_message(data)


def test_lists_as_long_as_they_may_be_are_taken() -> None:
    empty = histogram()
    longest = Report(
        latencies=(latency("if0", "a", empty),) * MAX_LATENCIES, paths=(path("if0", "a"),) * MAX_PATH_REPORTS
    )
    found = parse_sidecar_message(sidecar_message_to_proto(longest).SerializeToString())
    assert isinstance(found, Report)
    assert (len(found.latencies), len(found.paths)) == (MAX_LATENCIES, MAX_PATH_REPORTS)


@given(message=sidecar_messages)
def test_what_a_sidecar_says_is_no_costlier_than_it_may_be(message: SidecarMessage) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(message_cost, "CHEAP_BYTES", 0)
        check_cost(sidecar_message_to_proto(message).SerializeToString())


@given(data=st.binary(max_size=300))
def test_no_bytes_raise_anything_else(data: bytes) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(message_cost, "CHEAP_BYTES", 0)
        with contextlib.suppress(DecodeError):
            check_cost(data)


def test_of_what_a_newer_sidecar_says_the_size_does_not_matter() -> None:
    unknown = b"\xaa\x06" + b"\xa0\x8d\x06" + bytes(100_000)  # field 101, 100,000 bytes
    with pytest.raises(UnknownKindError):
        parse_sidecar_message(unknown)
    heartbeat = control_pb2.SidecarMessage(heartbeat=control_pb2.Heartbeat()).SerializeToString()
    assert parse_sidecar_message(heartbeat + unknown) == Heartbeat()


def test_two_kinds_and_many_fields_and_cut_bytes_are_refused() -> None:
    heartbeat = control_pb2.SidecarMessage(heartbeat=control_pb2.Heartbeat()).SerializeToString()
    unknown = b"\xaa\x06\x02hi"
    for data, text in (
        (heartbeat * CHEAP_BYTES, "two kinds, heartbeat and heartbeat"),
        (unknown * (SPARE_FIELDS + 1), f"more than {SPARE_FIELDS} fields"),
        (bloated()["report"].SerializeToString()[:-1], "do not fit"),
        (b"\xab\x06" * CHEAP_BYTES, "do not fit"),
    ):
        with pytest.raises(DecodeError, match=text):
            check_cost(data)


def test_a_histogram_of_more_buckets_than_there_are_is_refused() -> None:
    report = sidecar_message_to_proto(Report(paths=(path("if0", "a"),)))
    report.report.paths[0].rtt.index.extend([0] * (BUCKETS + 1))
    with pytest.raises(DecodeError, match=f"index has {BUCKETS + 1} elements"):
        parse_sidecar_message(report.SerializeToString())
