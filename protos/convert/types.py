"""Converts the types that both planes share (types.proto)."""

from __future__ import annotations

from collections import Counter
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import TYPE_CHECKING

from plr.protos.base.errors import DecodeError
from plr.protos.base.histogram import BUCKETS, LAYOUT, Histogram
from plr.protos.convert.fields import (
    MAX_CANDIDATES,
    MAX_CAPACITY,
    MAX_MAPPED_COPIES,
    MAX_OFFERS,
    at_most,
    cost,
    duration,
    each,
    known,
    microseconds,
    probability,
    unique,
)
from plr.protos.model.ids import Address, InterfaceId, InterfaceName, Role, ServiceName, SessionId
from plr.protos.model.members import (
    ALL_CALLS,
    MAX_CANDIDATES_OF_INTERFACE,
    MAX_CREDENTIAL_BYTES,
    MAX_SIGNATURE_BYTES,
    TOKEN_BYTES,
    CallPermit,
    Candidate,
    CandidateKind,
    Copies,
    InterfaceLabel,
    Peer,
    ServiceOffer,
    ServiceUse,
)
from plr.protos.model.names import domain_label, interface_name, node_name, service_name, type_name
from plr.protos.model.redundancy_mode import DEFAULT_HEDGE_QUANTILE, RedundancyMode
from plr.protos.plr.v1 import types_pb2

if TYPE_CHECKING:
    from collections.abc import Sequence

LEAST_TARGET = 1e-9
"""Smallest miss probability that can be wanted: one request in years."""

MAX_INTERFACE_ID = 255
"""Largest number of an interface, which takes one byte in the data plane's frames."""

_ROLES = {types_pb2.ROLE_ROBOT: Role.ROBOT, types_pb2.ROLE_CLOUD: Role.CLOUD}
_ROLE_NUMBERS = {role: number for number, role in _ROLES.items()}
_REDUNDANCY_NUMBERS = {
    RedundancyMode.REPLICATE: types_pb2.REDUNDANCY_MODE_REPLICATE,
    RedundancyMode.SINGLE: types_pb2.REDUNDANCY_MODE_SINGLE,
    RedundancyMode.BACKUP: types_pb2.REDUNDANCY_MODE_BACKUP,
    RedundancyMode.HEDGE: types_pb2.REDUNDANCY_MODE_HEDGE,
    RedundancyMode.ADAPTIVE: types_pb2.REDUNDANCY_MODE_ADAPTIVE,
    RedundancyMode.SHARE: types_pb2.REDUNDANCY_MODE_SHARE,
}
_REDUNDANCY_MODES = {number: mode for mode, number in _REDUNDANCY_NUMBERS.items()}
_CANDIDATE_KINDS = {
    types_pb2.CANDIDATE_KIND_HOST: CandidateKind.HOST,
    types_pb2.CANDIDATE_KIND_SERVER_REFLEXIVE: CandidateKind.SERVER_REFLEXIVE,
}
_CANDIDATE_KIND_NUMBERS = {kind: number for number, kind in _CANDIDATE_KINDS.items()}


def redundancy_from_proto(value: types_pb2.RedundancyMode.ValueType) -> RedundancyMode:
    """Return a mode; for one of a later version the one that promises least: only predictions depend on it."""
    return _REDUNDANCY_MODES.get(value, RedundancyMode.SINGLE)


def redundancy_to_proto(mode: RedundancyMode) -> types_pb2.RedundancyMode.ValueType:
    """Encode a mode."""
    return _REDUNDANCY_NUMBERS[mode]


def role_from_proto(value: types_pb2.Role.ValueType) -> Role:
    """Check a role."""
    return known(value, _ROLES, "role")


def role_to_proto(role: Role) -> types_pb2.Role.ValueType:
    """Encode a role."""
    return _ROLE_NUMBERS[role]


def address_from_proto(message: types_pb2.Address) -> Address:
    """Check the address of a single host: neither unspecified nor multicast or broadcast, which reach many."""
    if len(message.ip) not in (4, 16):
        raise DecodeError(f"address has {len(message.ip)} bytes, not 4 or 16")
    if not 1 <= message.port <= 65535:
        raise DecodeError(f"port {message.port} is not within 1..65535")
    ip: IPv4Address | IPv6Address = ip_address(message.ip)
    if isinstance(ip, IPv6Address) and ip.ipv4_mapped is not None:
        ip = ip.ipv4_mapped
    if ip.is_unspecified or ip.is_multicast or ip == IPv4Address("255.255.255.255"):
        raise DecodeError(f"address {ip} is not one of a host")
    return str(ip), message.port


def address_to_proto(address: Address) -> types_pb2.Address:
    """Encode an address; a zone (fe80::1%eth0) means nothing elsewhere and is left out."""
    return types_pb2.Address(ip=ip_address(address[0]).packed, port=address[1])


def candidate_from_proto(message: types_pb2.Candidate) -> Candidate:
    """Check a candidate."""
    return Candidate(
        interface_id=InterfaceId(at_most(message.interface_id, MAX_INTERFACE_ID, "interface_id")),
        interface=interface_name(message.interface, "interface"),
        kind=known(message.kind, _CANDIDATE_KINDS, "candidate kind"),
        address=address_from_proto(message.address),
    )


def candidate_to_proto(candidate: Candidate) -> types_pb2.Candidate:
    """Encode a candidate."""
    return types_pb2.Candidate(
        interface_id=candidate.interface_id,
        interface=candidate.interface,
        kind=_CANDIDATE_KIND_NUMBERS[candidate.kind],
        address=address_to_proto(candidate.address),
    )


def announced_from_proto(messages: Sequence[types_pb2.Candidate]) -> tuple[Candidate, ...]:
    """Check what a sidecar announces: like `candidates_from_proto`, but no more per interface than peers use."""
    candidates = candidates_from_proto(messages)
    for name, count in Counter(candidate.interface for candidate in candidates).items():
        if count > MAX_CANDIDATES_OF_INTERFACE:
            raise DecodeError(f"{name} has {count} candidates, more than {MAX_CANDIDATES_OF_INTERFACE}")
    return candidates


def candidates_from_proto(messages: Sequence[types_pb2.Candidate]) -> tuple[Candidate, ...]:
    """Check all candidates of a sidecar: numbers and names of interfaces must correspond one to one."""
    candidates = each(messages, MAX_CANDIDATES, "candidates", candidate_from_proto)
    unique(candidates, "candidates")
    interfaces = {(candidate.interface_id, candidate.interface) for candidate in candidates}
    unique((number for number, _ in interfaces), "interface_id")
    unique((name for _, name in interfaces), "interface")
    return candidates


def labels_from_proto(
    messages: Sequence[types_pb2.InterfaceLabel], candidates: Sequence[Candidate]
) -> tuple[InterfaceLabel, ...]:
    """Check what a sidecar says about the interfaces that its candidates name."""
    labels = each(messages, MAX_CANDIDATES, "labels", _label_from_proto)
    unique((label.interface for label in labels), "labels")
    known_names = {candidate.interface for candidate in candidates}
    for label in labels:
        if label.interface not in known_names:
            raise DecodeError(f"labels name {label.interface!a}, which no candidate does")
    return labels


def down_from_proto(
    messages: Sequence[types_pb2.InterfaceLabel], candidates: Sequence[Candidate]
) -> tuple[InterfaceLabel, ...]:
    """Check which interfaces carry nothing; no candidate may name them."""
    down = each(messages, MAX_CANDIDATES, "down", _label_from_proto)
    names = [label.interface for label in down]
    unique(names, "down")
    both = {candidate.interface for candidate in candidates}.intersection(names)
    if both:
        raise DecodeError(f"down names {min(both)!a}, which a candidate does too")
    return down


def _label_from_proto(message: types_pb2.InterfaceLabel) -> InterfaceLabel:
    return InterfaceLabel(
        interface=interface_name(message.interface, "interface"),
        carrier=domain_label(message.carrier, "carrier"),
        cost_per_request=cost(message.cost_per_request, "cost_per_request"),
    )


def label_to_proto(label: InterfaceLabel) -> types_pb2.InterfaceLabel:
    """Encode what a sidecar says about an interface."""
    return types_pb2.InterfaceLabel(
        interface=label.interface, carrier=label.carrier, cost_per_request=label.cost_per_request
    )


def offer_from_proto(message: types_pb2.ServiceOffer) -> ServiceOffer:
    """Check an offer."""
    return ServiceOffer(
        name=service_name(message.name, "service"),
        type=type_name(message.type, "type"),
        capacity=at_most(message.capacity, MAX_CAPACITY, "capacity"),
        cost_per_request=cost(message.cost_per_request, "cost_per_request"),
    )


def offer_to_proto(offer: ServiceOffer) -> types_pb2.ServiceOffer:
    """Encode an offer."""
    return types_pb2.ServiceOffer(
        name=offer.name, type=offer.type, capacity=offer.capacity, cost_per_request=offer.cost_per_request
    )


def offers_from_proto(messages: Sequence[types_pb2.ServiceOffer]) -> tuple[ServiceOffer, ...]:
    """Check all offers of a sidecar."""
    offers = each(messages, MAX_OFFERS, "offers", offer_from_proto)
    unique((offer.name for offer in offers), "offers")
    return offers


def use_from_proto(message: types_pb2.ServiceUse) -> ServiceUse:
    """Check a use."""
    return ServiceUse(
        name=service_name(message.name, "service"),
        type=type_name(message.type, "type"),
        deadline_s=duration(message.deadline_us, "deadline_us"),
        idempotent=message.idempotent,
        copies=_copies_from_proto(message),
        target_miss=_target(message.target_miss),
        fallback_up=message.fallback_up if message.has_fallback else None,
        redundancy=redundancy_from_proto(message.redundancy),
        hedge_quantile=probability(message.hedge_quantile, "hedge_quantile") or DEFAULT_HEDGE_QUANTILE,
        budgeted=message.budgeted,
        wanted_miss=probability(message.wanted_miss, "wanted_miss"),
    )


def _copies_from_proto(message: types_pb2.ServiceUse) -> Copies:
    least = at_most(message.least_copies, MAX_MAPPED_COPIES, "least_copies")
    most = at_most(message.most_copies, MAX_MAPPED_COPIES, "most_copies")
    if most and not 1 <= least <= most:
        raise DecodeError(f"least_copies {least} is not within 1..{most}, the most")
    return Copies(least, most)


def _target(value: float) -> float:
    """Check the wanted miss probability; 0 means none. Any below LEAST_TARGET, which is beyond counting, becomes it."""
    return max(probability(value, "target_miss"), LEAST_TARGET) if value else 0.0


def use_to_proto(use: ServiceUse) -> types_pb2.ServiceUse:
    """Encode a use."""
    return types_pb2.ServiceUse(
        name=use.name,
        type=use.type,
        deadline_us=microseconds(use.deadline_s),
        idempotent=use.idempotent,
        least_copies=use.copies.least,
        most_copies=use.copies.most,
        target_miss=use.target_miss,
        has_fallback=use.fallback_up is not None,
        fallback_up=bool(use.fallback_up),
        redundancy=redundancy_to_proto(use.redundancy),
        hedge_quantile=use.hedge_quantile,
        budgeted=use.budgeted,
        wanted_miss=use.wanted_miss,
    )


def peer_from_proto(message: types_pb2.Peer, *, with_token: bool = True) -> Peer:
    """Check a peer; when shown to the operator it comes without its token."""
    if len(message.token) != (TOKEN_BYTES if with_token else 0):
        raise DecodeError(f"token has {len(message.token)} bytes, not {TOKEN_BYTES if with_token else 0}")
    return Peer(
        name=node_name(message.name, "peer"),
        role=role_from_proto(message.role),
        session=session_from_proto(message.session),
        token=message.token,
        incarnation=message.incarnation,
        candidates=candidates_from_proto(message.candidates),
        offers=offers_from_proto(message.offers),
        draining=message.draining,
        credential=credential_from_proto(message.credential),
        may_call=permit_from_proto(message),
        candidates_serial=message.candidates_serial,
        candidates_signature=signature_from_proto(message.candidates_signature),
    )


def permit_from_proto(message: types_pb2.Peer) -> CallPermit:
    """Check what a peer may call: everything, or services by name."""
    if not message.may_call_everything:
        names = service_names(message.may_call, MAX_OFFERS, "may_call")
        unique(names, "may_call")
        return CallPermit(frozenset(names))
    if message.may_call:
        raise DecodeError("may_call names services beside may_call_everything")
    return ALL_CALLS


def service_names(values: Sequence[str], limit: int, field: str) -> tuple[ServiceName, ...]:
    """Check a repeated field of at most `limit` service names."""
    if len(values) > limit:
        raise DecodeError(f"{field} has {len(values)} elements, more than {limit}")
    return tuple(service_name(value, field) for value in values)


def interface_names(values: Sequence[str], field: str) -> tuple[InterfaceName, ...]:
    """Check a repeated field of interface names."""
    if len(values) > MAX_CANDIDATES:
        raise DecodeError(f"{field} has {len(values)} elements, more than {MAX_CANDIDATES}")
    return tuple(interface_name(value, field) for value in values)


def credential_from_proto(value: bytes) -> bytes:
    """Check the size of a credential; its content is for the peers to judge."""
    if len(value) > MAX_CREDENTIAL_BYTES:
        raise DecodeError(f"credential has {len(value)} bytes, more than {MAX_CREDENTIAL_BYTES}")
    return value


def signature_from_proto(value: bytes) -> bytes:
    """Check the size of a signature; whether it is right is for the peers to judge."""
    if len(value) > MAX_SIGNATURE_BYTES:
        raise DecodeError(f"signature has {len(value)} bytes, more than {MAX_SIGNATURE_BYTES}")
    return value


def session_from_proto(value: int) -> SessionId:
    """Check a session number; 0 means that the field was never written."""
    if value == 0:
        raise DecodeError("session is 0")
    return SessionId(value)


def peer_to_proto(peer: Peer) -> types_pb2.Peer:
    """Encode a peer."""
    return types_pb2.Peer(
        name=peer.name,
        role=role_to_proto(peer.role),
        session=peer.session,
        token=peer.token,
        incarnation=peer.incarnation,
        candidates=map(candidate_to_proto, peer.candidates),
        offers=map(offer_to_proto, peer.offers),
        draining=peer.draining,
        credential=peer.credential,
        may_call=sorted(peer.may_call.services),
        may_call_everything=peer.may_call.everything,
        candidates_serial=peer.candidates_serial,
        candidates_signature=peer.candidates_signature,
    )


def histogram_from_proto(message: types_pb2.Histogram) -> Histogram:
    """Check a histogram; an unset message is an empty one."""
    layout, lost = message.layout, message.lost
    for field, values in (("index", message.index), ("count", message.count)):
        if len(values) > BUCKETS:
            raise DecodeError(f"histogram {field} has {len(values)} elements, more than {BUCKETS}")
    # Slices of repeated fields are lists, made in C.
    index, count = message.index[:], message.count[:]
    if layout == 0 and not lost and not index and not count:
        layout = LAYOUT
    return Histogram.from_sparse(index, count, lost, layout=layout)


def histogram_to_proto(histogram: Histogram) -> types_pb2.Histogram:
    """Encode a histogram."""
    indices, counts, lost = histogram.to_sparse()
    return types_pb2.Histogram(layout=LAYOUT, index=indices, count=counts, lost=lost)
