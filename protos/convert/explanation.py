"""Converts explanations of mappings (admin.proto)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

from plr.protos.base.errors import DecodeError
from plr.protos.convert.admin import resource_from_proto, resource_to_proto
from plr.protos.convert.events import why_from_proto, why_to_proto
from plr.protos.convert.fields import (
    MAX_ASSIGNMENTS,
    MAX_DURATION_S,
    MAX_REPORTED_COUNT,
    US_PER_S,
    at_most,
    duration,
    each,
    known,
    microseconds,
    probability,
    version,
)
from plr.protos.convert.mapping import (
    assignment_from_proto,
    assignment_to_proto,
    service_mapping_from_proto,
    service_mapping_to_proto,
)
from plr.protos.convert.types import (
    histogram_from_proto,
    histogram_to_proto,
    redundancy_from_proto,
    redundancy_to_proto,
)
from plr.protos.model.explanation import (
    Alternative,
    AlternativeKind,
    Belief,
    Correlation,
    Explanation,
    JointExplanation,
    MappingChange,
    PairExplanation,
)
from plr.protos.model.names import clean_text, interface_name, node_name, service_name, text
from plr.protos.model.report import MAX_JOINTS
from plr.protos.plr.v1 import admin_pb2

if TYPE_CHECKING:
    from collections.abc import Iterable

    from plr.protos.model.ids import NodeName, ServiceName

MAX_LISTED_PAIRS = 4096
"""Pairs in one explanation."""

MAX_ALTERNATIVES = 1024
"""Other mappings in one explanation."""

MAX_LISTED_CHANGES = 64
"""Past mappings in one explanation."""

MAX_SHARED = 16
"""Things that two paths have in common."""

_CORRELATIONS = {
    admin_pb2.CORRELATION_TOGETHER: Correlation.TOGETHER,
    admin_pb2.CORRELATION_LIKELY: Correlation.LIKELY,
    admin_pb2.CORRELATION_INDEPENDENT: Correlation.INDEPENDENT,
}
_CORRELATION_NUMBERS = {value: number for number, value in _CORRELATIONS.items()}
_KINDS = {
    admin_pb2.ALTERNATIVE_KIND_OTHER: AlternativeKind.OTHER,
    admin_pb2.ALTERNATIVE_KIND_ALONE: AlternativeKind.ALONE,
    admin_pb2.ALTERNATIVE_KIND_WITHOUT: AlternativeKind.WITHOUT,
}
_KIND_NUMBERS = {value: number for number, value in _KINDS.items()}
_STATES: dict[admin_pb2.PathState.ValueType, bool | None] = {
    admin_pb2.PATH_STATE_UP: True,
    admin_pb2.PATH_STATE_DOWN: False,
    admin_pb2.PATH_STATE_UNKNOWN: None,
}
_STATE_NUMBERS = {value: number for number, value in _STATES.items()}


def explain_request_from_proto(message: admin_pb2.ExplainRequest) -> tuple[NodeName, ServiceName]:
    """Check a request: a robot and one of its services."""
    return node_name(message.robot, "robot"), service_name(message.service, "service")


def explanation_from_proto(message: admin_pb2.ExplainResponse) -> Explanation:
    """Check an explanation."""
    return Explanation(
        robot=node_name(message.robot, "robot"),
        service=service_name(message.service, "service"),
        deadline_s=duration(message.deadline_us, "deadline_us"),
        idempotent=message.idempotent,
        objective=text(message.objective, "objective"),
        mapping=service_mapping_from_proto(message.mapping) if message.HasField("mapping") else None,
        sync=resource_from_proto(message.sync),
        predicted_miss=_optional(message, "predicted_miss"),
        in_force_s=_age(message.in_force_us, "in_force_us") if message.HasField("in_force_us") else None,
        observed_miss=_optional(message, "observed_miss"),
        target_miss=probability(message.target_miss, "target_miss"),
        cost_per_request=_cost_per_request(message),
        pairs=each(message.pairs, MAX_LISTED_PAIRS, "pairs", _pair_from_proto),
        pairs_left_out=at_most(message.pairs_left_out, MAX_REPORTED_COUNT, "pairs_left_out"),
        joints=each(message.joints, MAX_JOINTS, "joints", _joint_from_proto),
        alternatives=each(message.alternatives, MAX_ALTERNATIVES, "alternatives", _alternative_from_proto),
        changes=each(message.changes, MAX_LISTED_CHANGES, "changes", _change_from_proto),
        redundancy=redundancy_from_proto(message.redundancy) if message.HasField("redundancy") else None,
        gone_s=_age(message.gone_us, "gone_us") if message.HasField("gone_us") else None,
        gone_why=why_from_proto(message.gone_reason) if message.HasField("gone_us") else None,
    )


def explanation_to_proto(explanation: Explanation) -> admin_pb2.ExplainResponse:
    """Encode an explanation."""
    found = explanation
    return admin_pb2.ExplainResponse(
        robot=found.robot,
        service=found.service,
        deadline_us=microseconds(found.deadline_s),
        idempotent=found.idempotent,
        objective=clean_text(found.objective),
        mapping=service_mapping_to_proto(found.mapping) if found.mapping is not None else None,
        sync=resource_to_proto(found.sync),
        in_force_us=microseconds(found.in_force_s) if found.in_force_s is not None else None,
        observed_miss=found.observed_miss,
        predicted_miss=found.predicted_miss,
        target_miss=found.target_miss,
        cost_per_request=found.cost_per_request,
        pairs=map(_pair_to_proto, found.pairs),
        pairs_left_out=found.pairs_left_out,
        joints=map(_joint_to_proto, found.joints),
        alternatives=map(_alternative_to_proto, found.alternatives),
        changes=map(_change_to_proto, found.changes),
        redundancy=redundancy_to_proto(found.redundancy) if found.redundancy is not None else None,
        gone_us=microseconds(found.gone_s) if found.gone_s is not None else None,
        gone_reason=why_to_proto(found.gone_why),
    )


def pairs_to_proto(pairs: Iterable[PairExplanation]) -> admin_pb2.ExplainResponse:
    """Encode pairs as a part of an explanation that has none of its own."""
    return admin_pb2.ExplainResponse(pairs=map(_pair_to_proto, pairs))


def _optional(message: admin_pb2.ExplainResponse, field: Literal["observed_miss", "predicted_miss"]) -> float | None:
    return probability(getattr(message, field), field) if message.HasField(field) else None


def _cost_per_request(message: admin_pb2.ExplainResponse | admin_pb2.Alternative) -> float | None:
    return _weight(message.cost_per_request, "cost_per_request") if message.HasField("cost_per_request") else None


def _age(age_us: int, field: str) -> float:
    # A mapping may be in force for longer than the longest deadline or lease; beyond a century it is a unit mistake.
    return at_most(age_us, round(MAX_DURATION_S * US_PER_S) * 36_525, field) / US_PER_S


def _weight(value: float, field: str) -> float:
    if not (math.isfinite(value) and 0.0 <= value <= MAX_REPORTED_COUNT):
        raise DecodeError(f"{field} {value} is not within 0..{MAX_REPORTED_COUNT}")
    return value


def _belief_from_proto(message: admin_pb2.Belief) -> Belief:
    belief = Belief(
        probability(message.mean, "mean"), probability(message.low, "low"), probability(message.high, "high")
    )
    if belief.low > belief.high:
        raise DecodeError(f"low {belief.low} is above high {belief.high}")
    return belief


def _belief_to_proto(belief: Belief) -> admin_pb2.Belief:
    return admin_pb2.Belief(mean=belief.mean, low=belief.low, high=belief.high)


def _pair_from_proto(message: admin_pb2.ExplainedPair) -> PairExplanation:
    return PairExplanation(
        path=assignment_from_proto(message.path),
        chosen=message.chosen,
        up=known(message.state, _STATES, "state"),
        miss=_belief_from_proto(message.miss) if message.HasField("miss") else None,
        requests=_weight(message.requests, "requests"),
        probes=_weight(message.probes, "probes"),
        rtt=histogram_from_proto(message.rtt),
        network=histogram_from_proto(message.network),
        compute=histogram_from_proto(message.compute),
        carrier=text(message.carrier, "carrier"),
        region=text(message.region, "region"),
        barred=message.barred,
        witnesses=message.witnesses,
        busiest_witness=node_name(message.busiest_witness, "busiest_witness") if message.busiest_witness else None,
        busiest_share=probability(message.busiest_share, "busiest_share"),
        penalty_s=duration(message.penalty_us, "penalty_us", zero=True),
        bad_answers=at_most(message.bad_answers, MAX_REPORTED_COUNT, "bad_answers"),
    )


def _pair_to_proto(pair: PairExplanation) -> admin_pb2.ExplainedPair:
    return admin_pb2.ExplainedPair(
        path=assignment_to_proto(pair.path),
        chosen=pair.chosen,
        state=_STATE_NUMBERS[pair.up],
        miss=_belief_to_proto(pair.miss) if pair.miss is not None else None,
        requests=pair.requests,
        probes=pair.probes,
        rtt=histogram_to_proto(pair.rtt),
        network=histogram_to_proto(pair.network),
        compute=histogram_to_proto(pair.compute),
        carrier=clean_text(pair.carrier),
        region=clean_text(pair.region),
        barred=pair.barred,
        witnesses=pair.witnesses,
        busiest_witness=pair.busiest_witness or "",
        busiest_share=pair.busiest_share,
        penalty_us=microseconds(pair.penalty_s),
        bad_answers=pair.bad_answers,
    )


def _joint_from_proto(message: admin_pb2.ExplainedJoint) -> JointExplanation:
    first, second = (_weight(getattr(message, field), field) for field in ("first_missed", "second_missed"))
    requests = _weight(message.requests, "requests")
    if requests == 0.0 or first * second / requests == 0.0:
        raise DecodeError("requests, first_missed or second_missed is 0")
    if len(message.shared) > MAX_SHARED:
        raise DecodeError(f"shared has {len(message.shared)} elements, more than {MAX_SHARED}")
    return JointExplanation(
        first=interface_name(message.first_interface, "first_interface"),
        second=interface_name(message.second_interface, "second_interface"),
        server=node_name(message.server, "server") if message.server else None,
        requests=requests,
        first_missed=first,
        second_missed=second,
        both_missed=_weight(message.both_missed, "both_missed"),
        correlation=known(message.correlation, _CORRELATIONS, "correlation"),
        shared=tuple(text(shared, "shared") for shared in message.shared),
    )


def _joint_to_proto(joint: JointExplanation) -> admin_pb2.ExplainedJoint:
    return admin_pb2.ExplainedJoint(
        first_interface=joint.first,
        second_interface=joint.second,
        server=joint.server or "",
        requests=joint.requests,
        first_missed=joint.first_missed,
        second_missed=joint.second_missed,
        both_missed=joint.both_missed,
        correlation=_CORRELATION_NUMBERS[joint.correlation],
        shared=map(clean_text, joint.shared),
    )


def _alternative_from_proto(message: admin_pb2.Alternative) -> Alternative:
    return Alternative(
        kind=known(message.kind, _KINDS, "kind"),
        assignments=each(message.assignments, MAX_ASSIGNMENTS, "assignments", assignment_from_proto),
        predicted_miss=probability(message.predicted_miss, "predicted_miss"),
        without=node_name(message.without, "without") if message.without else None,
        note=text(message.note, "note"),
        cost_per_request=_cost_per_request(message),
    )


def _alternative_to_proto(alternative: Alternative) -> admin_pb2.Alternative:
    return admin_pb2.Alternative(
        kind=_KIND_NUMBERS[alternative.kind],
        assignments=map(assignment_to_proto, alternative.assignments),
        predicted_miss=alternative.predicted_miss,
        without=alternative.without or "",
        note=clean_text(alternative.note),
        cost_per_request=alternative.cost_per_request,
    )


def _change_from_proto(message: admin_pb2.MappingChange) -> MappingChange:
    return MappingChange(
        _age(message.age_us, "age_us"),
        version(message.version, "version"),
        service_mapping_from_proto(message.mapping),
    )


def _change_to_proto(change: MappingChange) -> admin_pb2.MappingChange:
    return admin_pb2.MappingChange(
        age_us=microseconds(change.age_s), version=change.version, mapping=service_mapping_to_proto(change.mapping)
    )
