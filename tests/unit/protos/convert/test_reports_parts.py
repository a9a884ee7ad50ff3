"""A long report in parts tells what it tells as a whole."""

from __future__ import annotations

import pytest

from plr.controlplane.core.estimate.estimator import Estimator
from plr.protos.base.errors import DecodeError
from plr.protos.convert import parse_in_parts, parse_sidecar_message, sidecar_message_to_proto
from plr.protos.convert.reports import PART_ENTRIES
from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
from plr.protos.model.report import MAX_PATH_REPORTS, PenaltyReport, Report
from plr.protos.model.stream import Heartbeat
from plr.protos.plr.v1 import control_pb2
from tests.support.samples import histogram, latency, path

ROBOT, SERVER, PLAN = NodeName("robot"), NodeName("a"), ServiceName("/plan")
NAMES = [f"if{number:03d}" for number in range(3 * PART_ENTRIES + 1)]
LONG = Report(
    latencies=tuple(latency(name, "a", histogram(0.02, times=9)) for name in NAMES),
    paths=tuple(path(name, "a") for name in NAMES),
    penalties=(PenaltyReport(SERVER, 5.0, 3),),
)


def parts_of(report: Report) -> list[Report]:
    found = list(parse_in_parts(sidecar_message_to_proto(report).SerializeToString()))
    assert all(isinstance(part, Report) for part in found)
    return [part for part in found if isinstance(part, Report)]


@pytest.mark.audit("ops-20")
def test_the_parts_are_short_and_together_the_whole() -> None:
    parts = parts_of(LONG)
    assert max(len(part.latencies) + len(part.paths) for part in parts) == PART_ENTRIES
    assert sum((part.latencies for part in parts), ()) == LONG.latencies
    assert sum((part.paths for part in parts), ()) == LONG.paths
    assert [part.continues for part in parts] == [False] + [True] * (len(parts) - 1)
    assert list(parse_in_parts(control_pb2.SidecarMessage(heartbeat=control_pb2.Heartbeat()).SerializeToString())) == [
        Heartbeat()
    ]


@pytest.mark.audit("ops-20")
@pytest.mark.parametrize("changes_only", [False, True])
def test_each_part_says_whether_there_is_more_than_changes(changes_only: bool) -> None:
    parts = parts_of(Report(paths=LONG.paths, changes_only=changes_only))
    assert {part.changes_only for part in parts} == {changes_only}


@pytest.mark.audit("ops-20")
def test_parts_teach_what_the_whole_teaches() -> None:
    whole, parted = Estimator(half_life_s=60.0), Estimator(half_life_s=60.0)
    for now in (0.0, 1.0):
        whole.merge(ROBOT, LONG, now)
        for part in parts_of(LONG):
            parted.merge(ROBOT, part, now)
    for name in map(InterfaceName, NAMES):
        estimates = [one.estimate(ROBOT, name, SERVER, PLAN, 0.05, 2.0) for one in (whole, parted)]
        assert estimates[0].mean == pytest.approx(estimates[1].mean)
    assert whole.penalties(ROBOT, 2.0) == parted.penalties(ROBOT, 2.0)
    parted.merge(ROBOT, parts_of(Report())[0], 2.0)
    assert not parted.penalties(ROBOT, 2.0), "what is in force no more"


@pytest.mark.audit("ops-20")
def test_what_is_no_report_is_refused_in_parts_too() -> None:
    one = sidecar_message_to_proto(Report(paths=(path("wlan0", "a"),))).report.paths[0]
    too_many = control_pb2.SidecarMessage(report=control_pb2.Report(paths=[one] * (MAX_PATH_REPORTS + 1)))
    bad = sidecar_message_to_proto(LONG)
    bad.report.paths[-1].interface = "no name"
    for data in (too_many.SerializeToString(), bad.SerializeToString(), b"\xff"):
        with pytest.raises(DecodeError) as parted:
            list(parse_in_parts(data))
        with pytest.raises(DecodeError) as whole:
            parse_sidecar_message(data)
        assert str(parted.value) == str(whole.value)
