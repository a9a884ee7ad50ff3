"""Hypothesis strategies that draw every valid value of the control protocol."""

from __future__ import annotations

import dataclasses
import operator
from typing import TypeVar

from hypothesis import strategies as st

from plr.protos.base.histogram import BUCKETS, MAX_COUNT, Histogram
from plr.protos.base.size_class import SIZE_CLASSES
from plr.protos.convert.control import MAX_WALL_S
from plr.protos.convert.fields import (
    MAX_CAPACITY,
    MAX_COST_PER_REQUEST,
    MAX_DURATION_S,
    MAX_MAPPED_COPIES,
    MAX_REPORTED_COUNT,
)
from plr.protos.convert.types import LEAST_TARGET
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
from plr.protos.model.fleet_events import DepartedSidecar, EventKind, EventLogState, FleetEvent, Why
from plr.protos.model.ids import (
    MAX_VERSION,
    PROTOCOL_VERSION,
    Address,
    InterfaceId,
    InterfaceName,
    NodeName,
    Role,
    ServiceName,
    SessionId,
    Version,
)
from plr.protos.model.mapping import Assignment, MappingSet, ServiceMapping
from plr.protos.model.members import (
    ALL_CALLS,
    MAX_CREDENTIAL_BYTES,
    MAX_SIGNATURE_BYTES,
    TOKEN_BYTES,
    CallPermit,
    Candidate,
    CandidateKind,
    CandidateSet,
    Copies,
    HeldList,
    InterfaceLabel,
    Peer,
    PeerSet,
    Registration,
    RemovalReason,
    RemovedPeer,
    RevocationSet,
    ServiceOffer,
    ServiceSet,
    ServiceUse,
)
from plr.protos.model.redundancy_mode import RedundancyMode
from plr.protos.model.report import (
    InterfaceJointReport,
    JointReport,
    LatencyReport,
    OutcomeReport,
    PathReport,
    PenaltyReport,
    Report,
)
from plr.protos.model.status import Fault, InterfaceFault, ResourceStatus, SidecarStatus, SyncState
from plr.protos.model.stream import Ack, ControlMessage, Drain, Heartbeat, Nack, ResourceKind, SidecarMessage, Welcome

T = TypeVar("T")

node_names = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,20}", fullmatch=True).map(NodeName)
interface_names = st.from_regex(r"[a-z]{1,4}[0-9.:@_-]{0,8}", fullmatch=True).map(InterfaceName)
service_names = st.from_regex(r"(/[A-Za-z_][A-Za-z0-9_]{0,6}){1,3}", fullmatch=True).map(ServiceName)
type_names = st.from_regex(r"[a-z][a-z_]{0,5}/(srv|action|msg)/[A-Z][A-Za-z0-9_]{0,8}", fullmatch=True)
texts = st.text(st.characters(categories=["L", "N", "P", "S"]), max_size=40)
uint64 = st.integers(0, (1 << 64) - 1)
versions = st.integers(0, MAX_VERSION).map(Version)
sessions = st.integers(1, (1 << 64) - 1).map(SessionId)
tokens = st.binary(min_size=TOKEN_BYTES, max_size=TOKEN_BYTES)
credentials = st.binary(max_size=MAX_CREDENTIAL_BYTES)
signatures = st.binary(max_size=MAX_SIGNATURE_BYTES)
durations = st.integers(1, round(MAX_DURATION_S * 1e6)).map(lambda us: us / 1_000_000)
probabilities = st.floats(0.0, 1.0)
events = st.integers(0, MAX_REPORTED_COUNT)


def _of_one_host(address: Address) -> bool:
    first = address[0].split(".")[0]
    return not (
        (first.isdigit() and (int(first) >= 224 or address[0] == "0.0.0.0"))
        or address[0] == "::"
        or address[0].startswith(("ff", "::ffff:"))
    )


addresses = st.tuples(st.ip_addresses().map(str), st.integers(1, 65535)).filter(_of_one_host)


@st.composite
def histograms(draw: st.DrawFn) -> Histogram:
    indices = sorted(draw(st.sets(st.integers(0, BUCKETS - 1), max_size=5)))
    most = MAX_COUNT // (len(indices) + 1)
    counts = [draw(st.integers(1, most)) for _ in indices]
    return Histogram.from_sparse(indices, counts, draw(st.integers(0, most)))


@st.composite
def candidate_tuples(draw: st.DrawFn) -> tuple[Candidate, ...]:
    interfaces = draw(st.dictionaries(st.integers(0, 255), interface_names, max_size=3))
    found: list[Candidate] = []
    for number, name in {name: (number, name) for number, name in interfaces.items()}.values():
        for kind, address in draw(
            st.sets(st.tuples(st.sampled_from(CandidateKind), addresses), min_size=1, max_size=3)
        ):
            found.append(Candidate(InterfaceId(number), name, kind, address))
    return tuple(found)


def _tuples(
    elements: st.SearchStrategy[T], *, size: int = 3, by: str | None = None
) -> st.SearchStrategy[tuple[T, ...]]:
    if by is None:
        return st.lists(elements, max_size=size).map(lambda found: tuple(found))
    attribute = operator.attrgetter(by)
    return st.lists(elements, max_size=size, unique_by=attribute).map(lambda found: tuple(found))


costs = st.floats(0.0, MAX_COST_PER_REQUEST)
domain_labels = st.just("") | st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_.&+-]{0,10}", fullmatch=True)
copies = st.tuples(st.integers(0, MAX_MAPPED_COPIES), st.just(0)) | st.tuples(
    st.integers(1, MAX_MAPPED_COPIES), st.integers(1, MAX_MAPPED_COPIES)
).map(sorted)
offers = st.builds(ServiceOffer, service_names, type_names, st.integers(0, MAX_CAPACITY), costs)
uses = st.builds(
    ServiceUse,
    service_names,
    type_names,
    durations,
    st.booleans(),
    copies.map(lambda pair: Copies(*pair)),
    st.just(0.0) | st.floats(LEAST_TARGET, 1.0),
    st.none() | st.booleans(),
    st.sampled_from(RedundancyMode),
    st.floats(0.5, 0.99),
    st.booleans(),
    probabilities,
)
permits = st.just(ALL_CALLS) | st.builds(CallPermit, st.frozensets(service_names, max_size=3))
peers = st.builds(
    Peer,
    node_names,
    st.sampled_from(Role),
    sessions,
    tokens,
    uint64,
    candidate_tuples(),
    _tuples(offers, by="name"),
    st.booleans(),
    credentials,
    permits,
)
registrations = st.builds(
    Registration,
    st.just(PROTOCOL_VERSION),
    node_names,
    st.sampled_from(Role),
    sessions,
    tokens,
    uint64,
    texts,
    versions,
    versions,
    credentials,
    domain_labels,
    st.booleans(),
    st.integers(0, 0xFFFFFFFF),
)


@st.composite
def candidate_sets(draw: st.DrawFn) -> CandidateSet:
    candidates = draw(candidate_tuples())
    names = sorted({candidate.interface for candidate in candidates})
    labelled = draw(st.lists(st.sampled_from(names), unique=True)) if names else []
    labels = tuple(InterfaceLabel(name, draw(domain_labels), draw(costs)) for name in labelled)
    others = draw(st.lists(interface_names.filter(lambda name: name not in names), unique=True, max_size=4))
    down = tuple(InterfaceLabel(name, draw(domain_labels), draw(costs)) for name in others)
    return CandidateSet(candidates, labels, draw(uint64), draw(signatures), down)


counts_of = events.flatmap(lambda total: st.tuples(st.just(total), st.integers(0, total)))
latencies = st.builds(
    lambda interface, server, service, size_class, network, called_off, processing, counts: LatencyReport(
        interface, server, service, size_class, network, called_off, processing, *counts
    ),
    interface_names,
    node_names,
    service_names,
    st.integers(0, SIZE_CLASSES - 1),
    histograms(),
    histograms(),
    histograms(),
    counts_of,
)
paths = st.builds(PathReport, interface_names, node_names, st.booleans(), histograms(), events, events)
outcomes = st.builds(OutcomeReport, service_names, events, events, events)
assignments = st.builds(Assignment, interface_names, node_names)


@st.composite
def joint_reports(draw: st.DrawFn) -> JointReport:
    first, second = sorted(
        draw(st.lists(assignments, min_size=2, max_size=2, unique=True)), key=lambda path: (path.interface, path.server)
    )
    return JointReport(draw(service_names), first, second, *draw(counts_of))


@st.composite
def interface_joint_reports(draw: st.DrawFn) -> InterfaceJointReport:
    first, second = sorted(draw(st.lists(interface_names, min_size=2, max_size=2, unique=True)))
    requests, both_missed = draw(counts_of)
    races = draw(st.integers(0, requests))
    only_first_missed = draw(st.integers(0, min(races, requests - both_missed)))
    only_second_missed = draw(st.integers(0, min(races, requests - both_missed) - only_first_missed))
    alone = races, only_first_missed, only_second_missed
    server = draw(st.none() | node_names)
    return InterfaceJointReport(draw(service_names), first, second, server, requests, both_missed, *alone)


reports = st.builds(
    Report,
    _tuples(latencies),
    _tuples(paths),
    _tuples(outcomes),
    _tuples(joint_reports()),
    _tuples(interface_joint_reports()),
    st.lists(
        st.builds(PenaltyReport, node_names, durations | st.just(0.0), events),
        max_size=3,
        unique_by=lambda penalty: penalty.server,
    ).map(tuple),
    st.lists(node_names, max_size=3).map(tuple),
)


@st.composite
def service_mappings(draw: st.DrawFn) -> ServiceMapping:
    pairs = draw(st.lists(assignments, max_size=4, unique=True))
    explores = draw(st.sampled_from((True, False)))
    explore = pairs.pop() if pairs and explores else None
    return ServiceMapping(draw(service_names), tuple(pairs), draw(probabilities), draw(texts), explore)


mapping_sets = st.builds(MappingSet, versions, uint64, _tuples(service_mappings(), by="service"))
welcomes = st.builds(Welcome, durations, durations, _tuples(texts), st.binary(max_size=50))


@st.composite
def peer_sets(draw: st.DrawFn) -> PeerSet:
    present = draw(_tuples(peers, by="name"))
    gone = draw(_tuples(st.builds(RemovedPeer, node_names, st.sampled_from(RemovalReason)), by="name"))
    names = {peer.name for peer in present}
    removed = tuple(peer for peer in gone if peer.name not in names)
    return PeerSet(
        draw(versions),
        draw(uint64),
        present,
        removed,
        draw(uint64),
        draw(versions),
        draw(st.sampled_from((True, False))),
    )


revocation_sets = st.builds(
    RevocationSet,
    st.lists(
        st.builds(HeldList, uint64, uint64, st.integers(0, MAX_WALL_S)), max_size=16, unique_by=lambda one: one.ca
    ).map(tuple),
    st.integers(0, 16),
)
sidecar_messages: st.SearchStrategy[SidecarMessage] = st.one_of(
    registrations,
    candidate_sets(),
    st.builds(
        ServiceSet, _tuples(offers, by="name"), _tuples(uses, by="name"), _tuples(service_names), _tuples(service_names)
    ),
    reports,
    st.builds(Ack, st.sampled_from(ResourceKind), versions, uint64),
    st.builds(Nack, st.sampled_from(ResourceKind), versions, uint64, texts),
    st.just(Heartbeat()),
    st.just(Drain()),
    revocation_sets,
)
control_messages: st.SearchStrategy[ControlMessage] = st.one_of(welcomes, peer_sets(), mapping_sets)
resource_statuses = st.builds(ResourceStatus, versions, versions, st.sampled_from(SyncState), texts)
statuses = st.builds(
    SidecarStatus,
    peers.map(lambda peer: dataclasses.replace(peer, token=b"", credential=b"", candidates_signature=b"")),
    st.booleans(),
    durations | st.just(0.0),
    texts,
    _tuples(uses),
    resource_statuses,
    resource_statuses,
    _tuples(service_mappings()),
    _tuples(paths),
    _tuples(service_names),
    revocation_sets,
    _tuples(service_names),
    faults=_tuples(st.builds(InterfaceFault, interface_names, st.sampled_from(Fault), texts)),
)

beliefs = st.tuples(probabilities, probabilities, probabilities).map(lambda three: Belief(three[0], *sorted(three[1:])))
weights = st.floats(0.0, MAX_REPORTED_COUNT)
wall_times = st.integers(0, MAX_WALL_S * 1000).map(lambda ms: ms / 1000)
fleet_events = st.builds(
    FleetEvent,
    uint64,
    wall_times,
    st.sampled_from(EventKind),
    st.none() | node_names,
    texts,
    st.none() | st.sampled_from(Role),
    st.none() | st.sampled_from(Why),
)
departed_sidecars = st.builds(
    DepartedSidecar,
    node_names,
    st.sampled_from(Role),
    st.sampled_from(Why),
    durations | st.just(0.0),
    durations | st.just(0.0),
    texts,
    texts,
    _tuples(service_names),
)
log_states = st.builds(EventLogState, events, events, events, events, events, st.booleans(), texts)
explained_pairs = st.builds(
    PairExplanation,
    assignments,
    st.booleans(),
    st.sampled_from((True, False, None)),
    st.none() | beliefs,
    weights,
    weights,
    histograms(),
    histograms(),
    histograms(),
    texts,
    texts,
    st.booleans(),
    st.integers(0, 2**32 - 1),
    st.none() | node_names,
    probabilities,
    durations | st.just(0.0),
    events,
)
explained_joints = st.builds(
    JointExplanation,
    interface_names,
    interface_names,
    st.none() | node_names,
    *[st.floats(1e-3, MAX_REPORTED_COUNT)] * 3,
    weights,
    st.sampled_from(Correlation),
    _tuples(texts),
)
alternatives = st.builds(
    Alternative,
    st.sampled_from(AlternativeKind),
    _tuples(assignments),
    probabilities,
    st.none() | node_names,
    texts,
    st.none() | weights,
)
explanations = st.builds(
    Explanation,
    node_names,
    service_names,
    durations,
    st.booleans(),
    texts,
    resource_statuses,
    st.none() | service_mappings(),
    st.none() | probabilities,
    st.none() | durations,
    probabilities,
    st.none() | weights,
    st.none() | probabilities,
    _tuples(explained_pairs),
    events,
    _tuples(explained_joints),
    _tuples(alternatives),
    _tuples(st.builds(MappingChange, durations, versions, service_mappings())),
    st.none() | st.sampled_from(RedundancyMode),
)
