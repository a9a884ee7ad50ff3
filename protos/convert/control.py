"""Converts the messages of both directions of the control stream (control.proto)."""

from __future__ import annotations

from typing import TYPE_CHECKING, assert_never

from google.protobuf.message import DecodeError as ProtobufDecodeError

from plr.protos.base.errors import DecodeError, UnknownKindError
from plr.protos.convert.fields import (
    MAX_CRL_BYTES,
    MAX_REMOVED,
    MAX_STUN_SERVERS,
    MAX_USES,
    duration,
    each,
    known,
    microseconds,
    unique,
    version,
)
from plr.protos.convert.mapping import mapping_set_from_proto, mapping_set_to_proto
from plr.protos.convert.message_cost import check_cost
from plr.protos.convert.reports import report_from_proto, report_parts, report_to_proto
from plr.protos.convert.types import (
    announced_from_proto,
    candidate_to_proto,
    credential_from_proto,
    down_from_proto,
    label_to_proto,
    labels_from_proto,
    offer_to_proto,
    offers_from_proto,
    peer_from_proto,
    peer_to_proto,
    role_from_proto,
    role_to_proto,
    service_names,
    session_from_proto,
    signature_from_proto,
    use_from_proto,
    use_to_proto,
)
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import (
    MAX_PEERS,
    MAX_UNMET,
    TOKEN_BYTES,
    CandidateSet,
    HeldList,
    PeerSet,
    Registration,
    RemovalReason,
    RemovedPeer,
    RevocationSet,
    ServiceSet,
)
from plr.protos.model.names import clean_text, domain_label, node_name, text
from plr.protos.model.report import Report
from plr.protos.model.stream import Ack, ControlMessage, Drain, Heartbeat, Nack, ResourceKind, SidecarMessage, Welcome
from plr.protos.plr.v1 import control_pb2
from plr.protos.trust.identity import MAX_CA_CERTIFICATES

if TYPE_CHECKING:
    from collections.abc import Iterator

MAX_WALL_S = 253_402_300_799
"""The end of the year 9999, the last that a certificate can name (RFC 5280 section 4.1.2.5)."""

_RESOURCES = {
    control_pb2.RESOURCE_KIND_PEERS: ResourceKind.PEERS,
    control_pb2.RESOURCE_KIND_MAPPING: ResourceKind.MAPPING,
}
_RESOURCE_NUMBERS = {kind: number for number, kind in _RESOURCES.items()}
_REASONS = {
    control_pb2.REMOVAL_REASON_LEASE_EXPIRED: RemovalReason.LEASE_EXPIRED,
    control_pb2.REMOVAL_REASON_LEFT: RemovalReason.LEFT,
    control_pb2.REMOVAL_REASON_REVOKED: RemovalReason.REVOKED,
    control_pb2.REMOVAL_REASON_FORBIDDEN: RemovalReason.FORBIDDEN,
    control_pb2.REMOVAL_REASON_EXPIRED: RemovalReason.EXPIRED,
}
_REASON_NUMBERS = {reason: number for number, reason in _REASONS.items()}


def parse_sidecar_message(data: bytes) -> SidecarMessage:
    """Parse and check the bytes of one message of a sidecar."""
    return sidecar_message_from_proto(read_sidecar_message(data))


def parse_in_parts(data: bytes) -> Iterator[SidecarMessage]:
    """Do the same, but yield a report in parts that each take little time."""
    message = read_sidecar_message(data)
    if message.WhichOneof("kind") == "report":
        yield from report_parts(message.report)
    else:
        yield sidecar_message_from_proto(message)


def read_sidecar_message(data: bytes) -> control_pb2.SidecarMessage:
    """Parse the bytes of one message of a sidecar, and check only that it is not too costly."""
    check_cost(data)
    try:
        return control_pb2.SidecarMessage.FromString(data)
    except ProtobufDecodeError as error:
        raise DecodeError(f"not a SidecarMessage: {error}") from error


def parse_control_message(data: bytes) -> ControlMessage:
    """Parse and check the bytes of one message of the control plane."""
    try:
        message = control_pb2.ControlMessage.FromString(data)
    except ProtobufDecodeError as error:
        raise DecodeError(f"not a ControlMessage: {error}") from error
    return control_message_from_proto(message)


def sidecar_message_from_proto(message: control_pb2.SidecarMessage) -> SidecarMessage:
    """Check one message of a sidecar."""
    match message.WhichOneof("kind"):
        case "register":
            return _registration_from_proto(message.register)
        case "candidates":
            return _candidate_set_from_proto(message.candidates)
        case "services":
            uses = each(message.services.uses, MAX_USES, "uses", use_from_proto)
            unique((use.name for use in uses), "uses")
            unmet = service_names(message.services.unmet, MAX_UNMET, "unmet")
            untyped = service_names(message.services.untyped, MAX_UNMET, "untyped")
            unreached = service_names(message.services.unreached, MAX_UNMET, "unreached")
            return ServiceSet(offers_from_proto(message.services.offers), uses, unmet, untyped, unreached)
        case "report":
            return report_from_proto(message.report)
        case "ack":
            return Ack(
                resource=known(message.ack.resource, _RESOURCES, "resource"),
                version=version(message.ack.version, "acknowledged version"),
                nonce=message.ack.nonce,
            )
        case "nack":
            return Nack(
                resource=known(message.nack.resource, _RESOURCES, "resource"),
                version=version(message.nack.version, "version in force"),
                nonce=message.nack.nonce,
                error=text(message.nack.error, "error"),
            )
        case "heartbeat":
            return Heartbeat()
        case "drain":
            return Drain()
        case "revocations":
            return revocations_from_proto(message.revocations)
        case _:
            raise _of_no_kind(message)


def _of_no_kind(message: control_pb2.SidecarMessage | control_pb2.ControlMessage) -> DecodeError:
    # protobuf keeps the bytes of unknown fields.
    if message.ByteSize():
        return UnknownKindError("a message of no known kind: its sender is newer")
    return DecodeError("a message of no known kind: empty")


def revocations_from_proto(message: control_pb2.Revocations) -> RevocationSet:
    """Check which revocation lists are in use."""
    lists = each(message.lists, MAX_CA_CERTIFICATES, "lists", _held_list_from_proto)
    unique((one.ca for one in lists), "lists")
    if message.too_old > MAX_CA_CERTIFICATES:
        raise DecodeError(f"too_old is above {MAX_CA_CERTIFICATES}")
    return RevocationSet(lists, message.too_old)


def _held_list_from_proto(message: control_pb2.HeldList) -> HeldList:
    if message.signed_at_s > MAX_WALL_S:
        raise DecodeError("signed_at_s is beyond the year 9999")
    return HeldList(message.ca, message.number, message.signed_at_s)


def revocations_to_proto(value: RevocationSet) -> control_pb2.Revocations:
    """Encode which revocation lists are in use."""
    lists = [control_pb2.HeldList(ca=one.ca, number=one.number, signed_at_s=one.signed_at_s) for one in value.lists]
    return control_pb2.Revocations(lists=lists, too_old=value.too_old)


def sidecar_message_to_proto(value: SidecarMessage) -> control_pb2.SidecarMessage:
    """Encode one message of a sidecar."""
    match value:
        case Registration():
            return control_pb2.SidecarMessage(register=_registration_to_proto(value))
        case CandidateSet():
            return control_pb2.SidecarMessage(candidates=_candidate_set_to_proto(value))
        case ServiceSet(offers=offers, uses=uses, unmet=unmet, untyped=untyped, unreached=unreached):
            services = control_pb2.Services(
                offers=map(offer_to_proto, offers),
                uses=map(use_to_proto, uses),
                unmet=unmet,
                untyped=untyped,
                unreached=unreached,
            )
            return control_pb2.SidecarMessage(services=services)
        case Report():
            return control_pb2.SidecarMessage(report=report_to_proto(value))
        case Ack():
            ack = control_pb2.Ack(resource=_RESOURCE_NUMBERS[value.resource], version=value.version, nonce=value.nonce)
            return control_pb2.SidecarMessage(ack=ack)
        case Nack():
            nack = control_pb2.Nack(
                resource=_RESOURCE_NUMBERS[value.resource],
                version=value.version,
                nonce=value.nonce,
                error=clean_text(value.error),
            )
            return control_pb2.SidecarMessage(nack=nack)
        case Heartbeat():
            return control_pb2.SidecarMessage(heartbeat=control_pb2.Heartbeat())
        case Drain():
            return control_pb2.SidecarMessage(drain=control_pb2.Drain())
        case RevocationSet():
            return control_pb2.SidecarMessage(revocations=revocations_to_proto(value))
        case _:
            assert_never(value)


def control_message_from_proto(message: control_pb2.ControlMessage) -> ControlMessage:
    """Check one message of the control plane."""
    match message.WhichOneof("kind"):
        case "welcome":
            return _welcome_from_proto(message.welcome)
        case "peers":
            return _peer_set_from_proto(message.peers)
        case "mapping":
            return mapping_set_from_proto(message.mapping)
        case _:
            raise _of_no_kind(message)


def control_message_to_proto(value: ControlMessage) -> control_pb2.ControlMessage:
    """Encode one message of the control plane."""
    match value:
        case Welcome():
            welcome = control_pb2.Welcome(
                lease_us=microseconds(value.lease_s),
                report_interval_us=microseconds(value.report_interval_s),
                stun_servers=value.stun_servers,
                crl=value.crl,
                reconnect_max_us=microseconds(value.reconnect_max_s),
            )
            return control_pb2.ControlMessage(welcome=welcome)
        case PeerSet():
            return control_pb2.ControlMessage(peers=_peer_set_to_proto(value))
        case MappingSet():
            return control_pb2.ControlMessage(mapping=mapping_set_to_proto(value))
        case _:
            assert_never(value)


def _candidate_set_from_proto(message: control_pb2.Candidates) -> CandidateSet:
    candidates = announced_from_proto(message.candidates)
    return CandidateSet(
        candidates,
        labels_from_proto(message.labels, candidates),
        message.serial,
        signature_from_proto(message.signature),
        down_from_proto(message.down, candidates),
    )


def _candidate_set_to_proto(value: CandidateSet) -> control_pb2.Candidates:
    return control_pb2.Candidates(
        candidates=map(candidate_to_proto, value.candidates),
        labels=map(label_to_proto, value.labels),
        serial=value.serial,
        signature=value.signature,
        down=map(label_to_proto, value.down),
    )


def _registration_from_proto(message: control_pb2.Register) -> Registration:
    if len(message.token) != TOKEN_BYTES:
        raise DecodeError(f"token has {len(message.token)} bytes, not {TOKEN_BYTES}")
    return Registration(
        protocol_version=message.protocol_version,
        name=node_name(message.name, "name"),
        role=role_from_proto(message.role),
        session=session_from_proto(message.session),
        token=message.token,
        incarnation=message.incarnation,
        software_version=text(message.software_version, "software_version"),
        peers_version=version(message.peers_version, "peers_version"),
        mapping_version=version(message.mapping_version, "mapping_version"),
        credential=credential_from_proto(message.credential),
        region=domain_label(message.region, "region"),
        incremental=message.incremental,
        newest_protocol_version=message.newest_protocol_version,
    )


def _registration_to_proto(value: Registration) -> control_pb2.Register:
    return control_pb2.Register(
        protocol_version=value.protocol_version,
        name=value.name,
        role=role_to_proto(value.role),
        session=value.session,
        token=value.token,
        incarnation=value.incarnation,
        software_version=clean_text(value.software_version),
        peers_version=value.peers_version,
        mapping_version=value.mapping_version,
        credential=value.credential,
        region=value.region,
        incremental=value.incremental,
        newest_protocol_version=value.newest_protocol_version,
    )


def _welcome_from_proto(message: control_pb2.Welcome) -> Welcome:
    if len(message.stun_servers) > MAX_STUN_SERVERS:
        raise DecodeError(f"stun_servers has more than {MAX_STUN_SERVERS} elements")
    if len(message.crl) > MAX_CRL_BYTES:
        raise DecodeError(f"crl has more than {MAX_CRL_BYTES} bytes")
    return Welcome(
        lease_s=duration(message.lease_us, "lease_us"),
        report_interval_s=duration(message.report_interval_us, "report_interval_us"),
        stun_servers=tuple(text(server, "stun_servers") for server in message.stun_servers),
        crl=message.crl,
        reconnect_max_s=duration(message.reconnect_max_us, "reconnect_max_us", zero=True),
    )


def _peer_set_from_proto(message: control_pb2.PeerSet) -> PeerSet:
    peers = each(message.peers, MAX_PEERS, "peers", peer_from_proto)
    removed = each(message.removed, MAX_REMOVED, "removed", _removed_from_proto)
    unique([*(peer.name for peer in peers), *(gone.name for gone in removed)], "peers")
    return PeerSet(
        version=version(message.version, "peers version"),
        nonce=message.nonce,
        peers=peers,
        removed=removed,
        policy=message.policy,
        base=version(message.base_version, "base version"),
        more=message.more,
    )


def _peer_set_to_proto(value: PeerSet) -> control_pb2.PeerSet:
    message = peer_set_header_to_proto(value)
    message.peers.extend(map(peer_to_proto, value.peers))
    message.more = value.more
    return message


def peer_set_header_to_proto(value: PeerSet) -> control_pb2.PeerSet:
    """Encode a set of peers without the peers, and without a continuation."""
    return control_pb2.PeerSet(
        version=value.version,
        nonce=value.nonce,
        removed=(
            control_pb2.RemovedPeer(name=removed.name, reason=_REASON_NUMBERS[removed.reason])
            for removed in value.removed
        ),
        policy=value.policy,
        base_version=value.base,
    )


def _removed_from_proto(message: control_pb2.RemovedPeer) -> RemovedPeer:
    return RemovedPeer(
        name=node_name(message.name, "removed peer"),
        # A reason that only a newer control plane knows may be a grave one: the peer goes, whatever its paths prove.
        reason=_REASONS.get(message.reason, RemovalReason.FORBIDDEN),
    )
