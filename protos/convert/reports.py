"""Converts sidecars' measurements."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from plr.protos.base.errors import DecodeError
from plr.protos.base.size_class import SIZE_CLASSES
from plr.protos.convert.fields import (
    MAX_OUTCOMES,
    MAX_REPORTED_COUNT,
    at_most,
    check_length,
    duration,
    each,
    microseconds,
    unique,
)
from plr.protos.convert.mapping import assignment_from_proto, assignment_to_proto
from plr.protos.convert.types import histogram_from_proto, histogram_to_proto
from plr.protos.model.names import interface_name, node_name, service_name
from plr.protos.model.report import (
    MAX_GOODBYES,
    MAX_JOINTS,
    MAX_LATENCIES,
    MAX_PATH_REPORTS,
    MAX_PENALTIES,
    InterfaceJointReport,
    JointReport,
    LatencyReport,
    OutcomeReport,
    PathReport,
    PenaltyReport,
    Report,
)
from plr.protos.plr.v1 import control_pb2

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.protos.model.ids import NodeName

PART_ENTRIES = 32
"""Entries in one part; with their processing they take some 2 ms."""


def report_from_proto(message: control_pb2.Report) -> Report:
    """Check a report."""
    penalties = each(message.penalties, MAX_PENALTIES, "penalties", _penalty_from_proto)
    unique((penalty.server for penalty in penalties), "penalties")
    if len(message.goodbyes) > MAX_GOODBYES:
        raise DecodeError(f"goodbyes has {len(message.goodbyes)} elements, more than {MAX_GOODBYES}")
    return Report(
        latencies=each(message.latencies, MAX_LATENCIES, "latencies", _latency_from_proto),
        paths=each(message.paths, MAX_PATH_REPORTS, "paths", path_from_proto),
        outcomes=each(message.outcomes, MAX_OUTCOMES, "outcomes", _outcome_from_proto),
        joints=each(message.joints, MAX_JOINTS, "joints", _joint_from_proto),
        interface_joints=each(message.interface_joints, MAX_JOINTS, "interface_joints", _interface_joint_from_proto),
        penalties=penalties,
        goodbyes=tuple(node_name(server, "goodbyes") for server in message.goodbyes),
        changes_only=message.changes_only,
    )


def report_parts(message: control_pb2.Report) -> Iterator[Report]:
    """Check a report, some `PART_ENTRIES` entries at a time; together, the parts hold what the whole does.

    Raises DecodeError like `report_from_proto`, for lists that are too long first.
    """
    lists: tuple[tuple[str, int], ...] = (
        *(("outcomes", MAX_OUTCOMES), ("latencies", MAX_LATENCIES), ("joints", MAX_JOINTS)),
        *(("interface_joints", MAX_JOINTS), ("paths", MAX_PATH_REPORTS)),
    )
    for field, limit in lists:
        check_length(getattr(message, field), limit, field)
    changes_only = message.changes_only
    first = control_pb2.Report(penalties=message.penalties, goodbyes=message.goodbyes, changes_only=changes_only)
    part = report_from_proto(first)
    servers: frozenset[NodeName] = frozenset()
    for field, _ in lists:
        entries = getattr(message, field)
        for begin in range(0, len(entries), PART_ENTRIES):
            yield replace(part, more=True)
            servers |= {path.server for path in part.paths}
            part = report_from_proto(control_pb2.Report(**{field: entries[begin : begin + PART_ENTRIES]}))
            part = replace(part, changes_only=changes_only, continues=True, servers_before=servers)
    yield part


def report_entries(report: Report) -> int:
    """Return the number of entries that take time to read or merge."""
    lists = (report.latencies, report.paths, report.outcomes, report.joints, report.interface_joints, report.penalties)
    return sum(map(len, lists)) + len(report.goodbyes)


def report_to_proto(report: Report) -> control_pb2.Report:
    """Encode a report."""
    return control_pb2.Report(
        latencies=map(_latency_to_proto, report.latencies),
        paths=map(path_to_proto, report.paths),
        outcomes=map(_outcome_to_proto, report.outcomes),
        joints=map(_joint_to_proto, report.joints),
        interface_joints=map(_interface_joint_to_proto, report.interface_joints),
        penalties=map(_penalty_to_proto, report.penalties),
        goodbyes=report.goodbyes,
        changes_only=report.changes_only,
    )


def _latency_from_proto(message: control_pb2.LatencyReport) -> LatencyReport:
    requests = at_most(message.requests, MAX_REPORTED_COUNT, "requests")
    return LatencyReport(
        interface=interface_name(message.interface, "interface"),
        server=node_name(message.server, "server"),
        service=service_name(message.service, "service"),
        size_class=at_most(message.size_class, SIZE_CLASSES - 1, "size_class"),
        network=histogram_from_proto(message.network),
        called_off=histogram_from_proto(message.called_off),
        processing=histogram_from_proto(message.processing),
        requests=requests,
        missed=at_most(message.missed, requests, "missed"),
    )


def _latency_to_proto(latency: LatencyReport) -> control_pb2.LatencyReport:
    return control_pb2.LatencyReport(
        interface=latency.interface,
        server=latency.server,
        service=latency.service,
        size_class=latency.size_class,
        network=histogram_to_proto(latency.network),
        called_off=histogram_to_proto(latency.called_off),
        processing=histogram_to_proto(latency.processing),
        requests=latency.requests,
        missed=latency.missed,
    )


def path_from_proto(message: control_pb2.PathReport) -> PathReport:
    """Check a path report."""
    return PathReport(
        interface=interface_name(message.interface, "interface"),
        server=node_name(message.server, "server"),
        up=message.up,
        rtt=histogram_from_proto(message.rtt),
        datagrams_sent=at_most(message.datagrams_sent, MAX_REPORTED_COUNT, "datagrams_sent"),
        datagrams_lost=at_most(message.datagrams_lost, MAX_REPORTED_COUNT, "datagrams_lost"),
    )


def path_to_proto(path: PathReport) -> control_pb2.PathReport:
    """Encode a path report."""
    return control_pb2.PathReport(
        interface=path.interface,
        server=path.server,
        up=path.up,
        rtt=histogram_to_proto(path.rtt),
        datagrams_sent=path.datagrams_sent,
        datagrams_lost=path.datagrams_lost,
    )


def _outcome_from_proto(message: control_pb2.OutcomeReport) -> OutcomeReport:
    return OutcomeReport(
        service=service_name(message.service, "service"),
        ok=at_most(message.ok, MAX_REPORTED_COUNT, "ok"),
        deadline_missed=at_most(message.deadline_missed, MAX_REPORTED_COUNT, "deadline_missed"),
        failed=at_most(message.failed, MAX_REPORTED_COUNT, "failed"),
    )


def _outcome_to_proto(outcome: OutcomeReport) -> control_pb2.OutcomeReport:
    return control_pb2.OutcomeReport(
        service=outcome.service, ok=outcome.ok, deadline_missed=outcome.deadline_missed, failed=outcome.failed
    )


def _penalty_from_proto(message: control_pb2.PenaltyReport) -> PenaltyReport:
    return PenaltyReport(
        server=node_name(message.server, "server"),
        left_s=duration(message.left_us, "left_us", zero=True),
        bad_answers=at_most(message.bad_answers, MAX_REPORTED_COUNT, "bad_answers"),
    )


def _penalty_to_proto(penalty: PenaltyReport) -> control_pb2.PenaltyReport:
    return control_pb2.PenaltyReport(
        server=penalty.server, left_us=microseconds(penalty.left_s), bad_answers=penalty.bad_answers
    )


def _joint_from_proto(message: control_pb2.JointReport) -> JointReport:
    first, second = assignment_from_proto(message.first), assignment_from_proto(message.second)
    if not (first.interface, first.server) < (second.interface, second.server):
        raise DecodeError("joints: the first path does not come before the second")
    requests = at_most(message.requests, MAX_REPORTED_COUNT, "requests")
    return JointReport(
        service=service_name(message.service, "service"),
        first=first,
        second=second,
        requests=requests,
        both_missed=at_most(message.both_missed, requests, "both_missed"),
    )


def _joint_to_proto(joint: JointReport) -> control_pb2.JointReport:
    return control_pb2.JointReport(
        service=joint.service,
        first=assignment_to_proto(joint.first),
        second=assignment_to_proto(joint.second),
        requests=joint.requests,
        both_missed=joint.both_missed,
    )


def _interface_joint_from_proto(message: control_pb2.InterfaceJointReport) -> InterfaceJointReport:
    first, second = interface_name(message.first, "first"), interface_name(message.second, "second")
    if not first < second:
        raise DecodeError("interface_joints: the first interface does not come before the second")
    requests = at_most(message.requests, MAX_REPORTED_COUNT, "requests")
    both_missed = at_most(message.both_missed, requests, "both_missed")
    races = at_most(message.races, requests, "races")
    only_first_missed = at_most(message.only_first_missed, min(races, requests - both_missed), "only_first_missed")
    # No request is counted twice.
    most = min(races, requests - both_missed) - only_first_missed
    return InterfaceJointReport(
        service=service_name(message.service, "service"),
        first=first,
        second=second,
        server=node_name(message.server, "server") if message.server else None,
        requests=requests,
        both_missed=both_missed,
        races=races,
        only_first_missed=only_first_missed,
        only_second_missed=at_most(message.only_second_missed, most, "only_second_missed"),
    )


def _interface_joint_to_proto(joint: InterfaceJointReport) -> control_pb2.InterfaceJointReport:
    return control_pb2.InterfaceJointReport(
        service=joint.service,
        first=joint.first,
        second=joint.second,
        server=joint.server or "",
        requests=joint.requests,
        both_missed=joint.both_missed,
        races=joint.races,
        only_first_missed=joint.only_first_missed,
        only_second_missed=joint.only_second_missed,
    )
