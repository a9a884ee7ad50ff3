"""Every message round-trips, and what breaks a rule of the protocol is refused by name."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plr.protos.base.errors import DecodeError, UnknownKindError
from plr.protos.convert import (
    control_message_from_proto,
    control_message_to_proto,
    departed_from_proto,
    departed_to_proto,
    event_list_from_proto,
    event_to_proto,
    explanation_from_proto,
    explanation_to_proto,
    log_state_to_proto,
    own_revocations_from_proto,
    parse_control_message,
    parse_sidecar_message,
    peer_from_proto,
    sidecar_message_from_proto,
    sidecar_message_to_proto,
    status_from_proto,
    status_to_proto,
)
from plr.protos.convert.fields import MAX_CANDIDATES, MAX_OFFERS
from plr.protos.model.fleet_events import EventList
from plr.protos.model.ids import MAX_VERSION, InterfaceId, InterfaceName, NodeName, Role, SessionId, Version
from plr.protos.model.members import (
    ALL_CALLS,
    MAX_CREDENTIAL_BYTES,
    NO_CALLS,
    CallPermit,
    Candidate,
    CandidateKind,
    CandidateSet,
    Peer,
    PeerSet,
    RemovalReason,
    RevocationSet,
    ServiceSet,
)
from plr.protos.model.names import MAX_STRING_BYTES, clean_text
from plr.protos.model.redundancy_mode import DEFAULT_HEDGE_QUANTILE, RedundancyMode
from plr.protos.model.status import SidecarStatus
from plr.protos.model.stream import Ack, ControlMessage, Nack, ResourceKind, SidecarMessage
from plr.protos.plr.v1 import admin_pb2, control_pb2, types_pb2
from tests.unit.protos import message_strategies as some

if TYPE_CHECKING:
    from plr.protos.model.explanation import Explanation
    from plr.protos.model.fleet_events import DepartedSidecar, EventLogState, FleetEvent

PEERS = control_pb2.RESOURCE_KIND_PEERS
LEFT = control_pb2.REMOVAL_REASON_LEFT


@given(some.sidecar_messages)
def test_sidecar_messages_round_trip(value: SidecarMessage) -> None:
    assert sidecar_message_from_proto(sidecar_message_to_proto(value)) == value
    assert parse_sidecar_message(sidecar_message_to_proto(value).SerializeToString()) == value


@given(some.control_messages)
def test_control_messages_round_trip(value: ControlMessage) -> None:
    assert control_message_from_proto(control_message_to_proto(value)) == value
    assert parse_control_message(control_message_to_proto(value).SerializeToString()) == value


@given(st.lists(some.statuses, max_size=3), some.revocation_sets)
@settings(max_examples=30)
def test_statuses_round_trip(statuses: list[SidecarStatus], own: RevocationSet) -> None:
    message = status_to_proto(statuses, own)
    assert status_from_proto(message) == tuple(statuses)
    assert own_revocations_from_proto(message) == own


@given(st.lists(some.fleet_events, max_size=3), some.departed_sidecars, some.log_states)
@settings(max_examples=30)
def test_events_round_trip(events: list[FleetEvent], gone: DepartedSidecar, state: EventLogState) -> None:
    message = admin_pb2.ListEventsResponse(events=map(event_to_proto, events), log=log_state_to_proto(state))
    assert event_list_from_proto(message) == EventList(tuple(events), 0, state)
    assert departed_from_proto([departed_to_proto(gone)]) == (gone,)


@given(some.explanations, some.departed_sidecars)
@settings(max_examples=10)
def test_an_explanation_says_who_is_gone(explanation: Explanation, gone: DepartedSidecar) -> None:
    explanation = replace(explanation, gone_s=gone.gone_s, gone_why=gone.why)
    assert explanation_from_proto(explanation_to_proto(explanation)) == explanation


@given(some.explanations)
@settings(max_examples=30)
def test_explanations_round_trip(explanation: Explanation) -> None:
    assert explanation_from_proto(explanation_to_proto(explanation)) == explanation


@pytest.mark.audit("ops-12")
@pytest.mark.parametrize(
    ("told", "mode"),
    [
        ({}, RedundancyMode.REPLICATE),
        ({"redundancy": types_pb2.REDUNDANCY_MODE_HEDGE}, RedundancyMode.HEDGE),
        ({"redundancy": 77}, RedundancyMode.SINGLE),
    ],
    ids=["an older sidecar tells none", "hedge", "a newer sidecar's"],
)
def test_a_mode_that_is_not_known_promises_the_least(told: dict[str, int], mode: RedundancyMode) -> None:
    found = sidecar_message_from_proto(services(uses=[use(**told)]))
    assert isinstance(found, ServiceSet)
    assert found.uses[0].redundancy is mode
    assert found.uses[0].hedge_quantile == DEFAULT_HEDGE_QUANTILE
    assert not found.uses[0].budgeted


@pytest.mark.parametrize(
    ("message", "field"),
    [
        (admin_pb2.ExplainResponse(), "deadline_us"),
        (admin_pb2.ExplainResponse(deadline_us=1, observed_miss=1.5), "observed_miss"),
        (admin_pb2.ExplainResponse(deadline_us=1, pairs=[admin_pb2.ExplainedPair()]), "interface"),
        (admin_pb2.ExplainResponse(deadline_us=1, alternatives=[admin_pb2.Alternative()]), "kind"),
    ],
)
def test_an_explanation_that_makes_no_sense_is_refused(message: admin_pb2.ExplainResponse, field: str) -> None:
    message.robot, message.service, message.sync.state = "robot", "/plan", admin_pb2.SYNC_STATE_SYNCED
    with pytest.raises(DecodeError, match=field):
        explanation_from_proto(message)


def test_a_status_never_carries_a_token() -> None:
    secret = bytes(range(16))
    peer = Peer(NodeName("robot"), Role.ROBOT, SessionId(1), secret, incarnation=1, credential=b"signed")
    message = status_to_proto([SidecarStatus(peer, connected=True, lease_left_s=1.0, software_version="1")])
    assert secret not in message.SerializeToString()
    assert status_from_proto(message)[0].peer.token == b""
    assert status_from_proto(message)[0].peer.credential == b""


def register(**changes: Any) -> control_pb2.SidecarMessage:
    fields: dict[str, Any] = {
        "protocol_version": 1,
        "name": "robot-1",
        "role": types_pb2.ROLE_ROBOT,
        "session": 7,
        "token": bytes(16),
        "incarnation": 1,
        "software_version": "1.0",
    }
    return control_pb2.SidecarMessage(register=control_pb2.Register(**(fields | changes)))


def candidates(*changes: dict[str, Any]) -> control_pb2.SidecarMessage:
    fields: dict[str, Any] = {
        "interface_id": 0,
        "interface": "wlan0",
        "kind": types_pb2.CANDIDATE_KIND_HOST,
        "address": types_pb2.Address(ip=b"\x0a\x00\x00\x01", port=4000),
    }
    made = [types_pb2.Candidate(**(fields | change)) for change in changes]
    return control_pb2.SidecarMessage(candidates=control_pb2.Candidates(candidates=made))


def test_a_permit_is_all_or_names() -> None:
    def parse(**fields: Any) -> CallPermit:
        peer = types_pb2.Peer(name="robot", role=types_pb2.ROLE_ROBOT, session=1, **fields)
        return peer_from_proto(peer, with_token=False).may_call

    assert parse() == NO_CALLS
    assert parse(may_call_everything=True) == ALL_CALLS
    assert "/a" in parse(may_call=["/a", "/b"])
    assert "/c" not in parse(may_call=["/a", "/b"])
    for wrong in (["a"], ["/a", "/a"], [f"/s{number}" for number in range(MAX_OFFERS + 1)]):
        with pytest.raises(DecodeError, match="may_call"):
            parse(may_call=wrong)
    with pytest.raises(DecodeError, match="beside may_call_everything"):
        parse(may_call=["/a"], may_call_everything=True)


def at(ip: bytes, port: int = 4000) -> dict[str, Any]:
    return {"address": types_pb2.Address(ip=ip, port=port)}


def labels(*changes: dict[str, Any]) -> control_pb2.SidecarMessage:
    message = candidates({})
    fields: dict[str, Any] = {"interface": "wlan0", "carrier": "telekom", "cost_per_request": 2.0}
    message.candidates.labels.extend(types_pb2.InterfaceLabel(**(fields | change)) for change in changes)
    return message


def services(offers: Any = (), uses: Any = ()) -> control_pb2.SidecarMessage:
    return control_pb2.SidecarMessage(services=control_pb2.Services(offers=offers, uses=uses))


def use(**changes: Any) -> types_pb2.ServiceUse:
    fields: dict[str, Any] = {"name": "/plan", "type": "nav_msgs/srv/GetPlan", "deadline_us": 100_000}
    return types_pb2.ServiceUse(**(fields | changes))


def latency(**changes: Any) -> control_pb2.SidecarMessage:
    fields: dict[str, Any] = {"interface": "wlan0", "server": "cloud-a", "service": "/plan"}
    report = control_pb2.Report(latencies=[control_pb2.LatencyReport(**(fields | changes))])
    return control_pb2.SidecarMessage(report=report)


def joint(**changes: Any) -> control_pb2.SidecarMessage:
    fields: dict[str, Any] = {
        "service": "/plan",
        "first": control_pb2.Assignment(interface="wlan0", server="cloud-a"),
        "second": control_pb2.Assignment(interface="wwan0", server="cloud-a"),
        "requests": 3,
        "both_missed": 3,
    }
    report = control_pb2.Report(joints=[control_pb2.JointReport(**(fields | changes))])
    return control_pb2.SidecarMessage(report=report)


def interface_joint(**changes: Any) -> control_pb2.SidecarMessage:
    counts = {"requests": 6, "both_missed": 3, "races": 3, "only_first_missed": 1, "only_second_missed": 2}
    fields: dict[str, Any] = {"service": "/plan", "first": "wlan0", "second": "wwan0", **counts}
    report = control_pb2.Report(interface_joints=[control_pb2.InterfaceJointReport(**(fields | changes))])
    return control_pb2.SidecarMessage(report=report)


def test_the_samples_that_the_next_test_breaks_are_good() -> None:
    for message in (
        register(),
        candidates({}),
        labels({}),
        services(uses=[use()]),
        latency(),
        joint(),
        interface_joint(),
    ):
        sidecar_message_from_proto(message)


@pytest.mark.parametrize(
    ("message", "field"),
    [
        (control_pb2.SidecarMessage(), "no known kind"),
        (register(name=""), "name"),
        (register(name="robot 1"), "name"),
        (register(name="../robot"), "name"),
        (register(name="-robot"), "name"),
        (register(name="röbot"), "name"),
        (register(name="robot\n"), "name"),
        (register(name="r" * (MAX_STRING_BYTES + 1)), "name"),
        (register(role=0), "role"),
        (register(role=9), "role"),
        (register(session=0), "session"),
        (register(token=b""), "token"),
        (register(token=bytes(17)), "token"),
        (register(credential=bytes(MAX_CREDENTIAL_BYTES + 1)), "credential"),
        (register(software_version="1\x1b[2J"), "software_version"),
        (register(peers_version=MAX_VERSION + 1), "peers_version"),
        (candidates({"interface_id": 256}), "interface_id"),
        (candidates({"interface": ""}), "interface"),
        (candidates({"interface": "a/b"}), "interface"),
        (candidates({"kind": 0}), "candidate kind"),
        (candidates({}, {}), "candidates"),
        (candidates(*(at(bytes((10, 0, 0, number))) for number in range(9))), "wlan0 has 9 candidates, more than 8"),
        (control_pb2.SidecarMessage(candidates=control_pb2.Candidates(signature=bytes(73))), "signature"),
        (candidates({}, {"interface_id": 1, **at(b"\x0a\x00\x00\x02")}), "interface"),
        (candidates({}, {"interface": "wwan0", **at(b"\x0a\x00\x00\x02")}), "interface_id"),
        (candidates(at(b"")), "address"),
        (candidates(at(bytes(5))), "address"),
        (candidates(at(bytes(4))), "address"),
        (candidates(at(bytes(16))), "address"),
        (candidates(at(b"\xe0\x00\x00\x01")), "address"),
        (candidates(at(b"\xff\xff\xff\xff")), "address"),
        (candidates(at(b"\x0a\x00\x00\x01", 0)), "port"),
        (candidates(at(b"\x0a\x00\x00\x01", 65536)), "port"),
        (candidates(*({**at(b"\x0a\x00\x00\x01", 1 + i)} for i in range(MAX_CANDIDATES + 1))), "candidates"),
        (services(uses=[use(name="plan")]), "service"),
        (services(uses=[use(name="/plan/")]), "service"),
        (services(uses=[use(name="/1plan")]), "service"),
        (services(uses=[use(type="GetPlan")]), "type"),
        (services(uses=[use(deadline_us=0)]), "deadline_us"),
        (services(uses=[use(deadline_us=1 << 60)]), "deadline_us"),
        (services(uses=[use(), use()]), "uses"),
        (services(offers=[types_pb2.ServiceOffer(name="/a", type="a/srv/A", capacity=1 << 31)]), "capacity"),
        (services(offers=[types_pb2.ServiceOffer(name="/a", type="a/srv/A")] * 2), "offers"),
        (
            services(offers=[types_pb2.ServiceOffer(name="/a", type="a/srv/A", cost_per_request=-1.0)]),
            "cost_per_request",
        ),
        (services(uses=[use(target_miss=1.5)]), "target_miss"),
        (services(uses=[use(target_miss=math.nan)]), "target_miss"),
        (services(uses=[use(least_copies=257)]), "least_copies"),
        (services(uses=[use(most_copies=257)]), "most_copies"),
        (services(uses=[use(least_copies=3, most_copies=2)]), "least_copies"),
        (services(uses=[use(most_copies=2)]), "least_copies"),
        (register(region="eu central"), "region"),
        (register(region="-eu"), "region"),
        (labels({"interface": "wwan0"}), "labels"),
        (labels({}, {}), "labels"),
        (labels({"carrier": "a\n"}), "carrier"),
        (labels({"cost_per_request": math.inf}), "cost_per_request"),
        (latency(server=""), "server"),
        (latency(network=types_pb2.Histogram(layout=2, index=[1], count=[1])), "layout"),
        (latency(size_class=7), "size_class"),
        (latency(called_off=types_pb2.Histogram(layout=1, index=[1], count=[])), "histogram"),
        (latency(processing=types_pb2.Histogram(lost=1)), "layout"),
        (latency(requests=2, missed=3), "missed"),
        (joint(first=control_pb2.Assignment(interface="wwan0", server="cloud-a")), "joints"),
        (joint(second=control_pb2.Assignment(interface="wwan0")), "server"),
        (joint(both_missed=4), "both_missed"),
        (interface_joint(first="wwan0"), "interface_joints"),
        (interface_joint(second="x/y"), "second"),
        (interface_joint(server="-"), "server"),
        (interface_joint(both_missed=7), "both_missed"),
        (interface_joint(both_missed=4), "only_second_missed"),
        (interface_joint(races=7), "races"),
        (interface_joint(races=2), "only_second_missed"),
        (interface_joint(only_first_missed=4), "only_first_missed"),
        (interface_joint(only_second_missed=3), "only_second_missed"),
        (control_pb2.SidecarMessage(ack=control_pb2.Ack(version=1)), "resource"),
        (control_pb2.SidecarMessage(nack=control_pb2.Nack(resource=PEERS, error="a\nb")), "error"),
    ],
)
def test_a_broken_rule_is_named(message: control_pb2.SidecarMessage, field: str) -> None:
    with pytest.raises(DecodeError, match=field):
        sidecar_message_from_proto(message)


PAIR = control_pb2.Assignment(interface="w", server="a")


@pytest.mark.audit("ops-10")
def test_what_only_a_newer_program_knows_is_told_from_what_is_broken() -> None:
    later = b"\xaa\x06\x02hi"  # field 101
    for parse in (parse_sidecar_message, parse_control_message):
        with pytest.raises(UnknownKindError, match="its sender is newer"):
            parse(later)
        with pytest.raises(DecodeError, match="empty") as broken:
            parse(b"")
        assert not isinstance(broken.value, UnknownKindError)
    known = register()
    more = control_pb2.Register.FromString(known.register.SerializeToString() + later)
    said = sidecar_message_from_proto(control_pb2.SidecarMessage(register=more))
    assert said == sidecar_message_from_proto(known), "a field that is not known is left out"


@pytest.mark.audit("ops-10")
def test_a_removal_for_a_reason_that_is_not_known_lets_no_path_go_on() -> None:
    gone = control_pb2.RemovedPeer(name="a")
    gone.MergeFromString(b"\x10\x63")  # reason 99
    told = control_message_from_proto(control_pb2.ControlMessage(peers=control_pb2.PeerSet(removed=[gone])))
    assert isinstance(told, PeerSet)
    assert [removed.reason for removed in told.removed] == [RemovalReason.FORBIDDEN]


def mapping(**changes: Any) -> control_pb2.ControlMessage:
    made = control_pb2.ServiceMapping(**({"service": "/plan"} | changes))
    return control_pb2.ControlMessage(mapping=control_pb2.MappingSet(version=1, services=[made]))


@pytest.mark.parametrize(
    ("message", "field"),
    [
        (control_pb2.ControlMessage(), "no known kind"),
        (control_pb2.ControlMessage(welcome=control_pb2.Welcome(report_interval_us=1)), "lease_us"),
        (control_pb2.ControlMessage(welcome=control_pb2.Welcome(lease_us=1)), "report_interval_us"),
        (mapping(predicted_miss=float("nan")), "predicted_miss"),
        (mapping(predicted_miss=1.5), "predicted_miss"),
        (mapping(predicted_miss=-0.1), "predicted_miss"),
        (mapping(assignments=[PAIR] * 2), "assignments"),
        (mapping(assignments=[PAIR], explore=PAIR), "assignments and explore"),
        (mapping(explore=control_pb2.Assignment(interface="w")), "server"),
        (
            control_pb2.ControlMessage(
                peers=control_pb2.PeerSet(removed=[control_pb2.RemovedPeer(name="a", reason=LEFT)] * 2)
            ),
            "peers",
        ),
    ],
)
def test_a_broken_rule_of_the_control_plane_is_named(message: control_pb2.ControlMessage, field: str) -> None:
    with pytest.raises(DecodeError, match=field):
        control_message_from_proto(message)


def test_a_sync_state_without_meaning_is_refused() -> None:
    peer = types_pb2.Peer(name="a", role=types_pb2.ROLE_CLOUD, session=1)
    status = admin_pb2.SidecarStatus(peer=peer)
    with pytest.raises(DecodeError, match="sync state"):
        status_from_proto(admin_pb2.GetStatusResponse(sidecars=[status]))


def test_an_ipv4_address_inside_ipv6_is_written_as_ipv4() -> None:
    message = candidates(at(bytes(10) + b"\xff\xff\x0a\x00\x00\x01"))
    value = sidecar_message_from_proto(message)
    assert isinstance(value, CandidateSet)
    assert value.candidates[0].address == ("10.0.0.1", 4000)


def test_a_zone_stays_at_home() -> None:
    value = CandidateSet(
        (Candidate(InterfaceId(0), InterfaceName("eth0"), CandidateKind.HOST, ("fe80::1%eth0", 4000)),)
    )
    back = sidecar_message_from_proto(sidecar_message_to_proto(value))
    assert isinstance(back, CandidateSet)
    assert back.candidates[0].address == ("fe80::1", 4000)


@given(st.text())
def test_any_error_text_can_be_sent(text: str) -> None:
    nack = Nack(ResourceKind.PEERS, Version(3), 4, text)
    back = sidecar_message_from_proto(sidecar_message_to_proto(nack))
    assert back == Nack(ResourceKind.PEERS, Version(3), 4, clean_text(text))


def test_a_long_text_is_cut_between_characters() -> None:
    assert clean_text("x" + "é" * 200) == "x" + "é" * 127


def test_a_message_of_the_wrong_type_is_refused() -> None:
    ack = sidecar_message_to_proto(Ack(ResourceKind.PEERS, Version(1), 1))
    with pytest.raises(DecodeError):
        parse_control_message(ack.SerializeToString())
