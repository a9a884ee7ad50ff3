"""Converts what the operator sees (admin.proto)."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from plr.protos.base.errors import DecodeError
from plr.protos.convert.control import revocations_from_proto, revocations_to_proto
from plr.protos.convert.fields import (
    MAX_CANDIDATES,
    MAX_LISTED_SIDECARS,
    MAX_MAPPED_SERVICES,
    MAX_OFFERS,
    MAX_USES,
    duration,
    each,
    known,
    microseconds,
    unique,
    version,
)
from plr.protos.convert.mapping import service_mapping_from_proto, service_mapping_to_proto
from plr.protos.convert.reports import path_from_proto, path_to_proto
from plr.protos.convert.types import (
    interface_names,
    peer_from_proto,
    peer_to_proto,
    service_names,
    use_from_proto,
    use_to_proto,
)
from plr.protos.model.members import MAX_UNMET, NO_REVOCATIONS, RevocationSet
from plr.protos.model.names import clean_text, interface_name, node_name, text
from plr.protos.model.report import MAX_PATH_REPORTS
from plr.protos.model.status import Fault, InterfaceFault, ResourceStatus, SidecarStatus, StatusQuery, SyncState
from plr.protos.plr.v1 import admin_pb2

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from plr.protos.model.ids import ServiceName

_SYNC_STATES = {
    admin_pb2.SYNC_STATE_NOT_SENT: SyncState.NOT_SENT,
    admin_pb2.SYNC_STATE_STALE: SyncState.STALE,
    admin_pb2.SYNC_STATE_SYNCED: SyncState.SYNCED,
    admin_pb2.SYNC_STATE_REJECTED: SyncState.REJECTED,
}
_SYNC_STATE_NUMBERS = {state: number for number, state in _SYNC_STATES.items()}
_FAULTS = {admin_pb2.FAULT_FLAPPING: Fault.FLAPPING, admin_pb2.FAULT_USELESS: Fault.USELESS}
_FAULT_NUMBERS = {fault: number for number, fault in _FAULTS.items()}

MAX_FAULTS = len(Fault) * MAX_CANDIDATES
"""Faults of the interfaces of one sidecar."""


def status_from_proto(message: admin_pb2.GetStatusResponse) -> tuple[SidecarStatus, ...]:
    """Check the status of all sidecars."""
    return each(message.sidecars, MAX_LISTED_SIDECARS, "sidecars", _sidecar_from_proto)


def own_revocations_from_proto(message: admin_pb2.GetStatusResponse) -> RevocationSet:
    """Check which revocation lists the control plane uses."""
    return revocations_from_proto(message.revocations)


def status_to_proto(
    sidecars: Iterable[SidecarStatus], own: RevocationSet = NO_REVOCATIONS
) -> admin_pb2.GetStatusResponse:
    """Encode the status of all sidecars, without their tokens and credentials; `own` is the control plane's."""
    return admin_pb2.GetStatusResponse(sidecars=map(_sidecar_to_proto, sidecars), revocations=revocations_to_proto(own))


def status_query_from_proto(message: admin_pb2.StreamStatusRequest) -> StatusQuery:
    """Check a query for the status."""
    if len(message.names) > MAX_LISTED_SIDECARS:
        raise DecodeError(f"names has {len(message.names)} elements, more than {MAX_LISTED_SIDECARS}")
    unique(message.names, "names")
    return StatusQuery(tuple(node_name(name, "names") for name in message.names), message.detailed_at_most)


def status_query_to_proto(query: StatusQuery) -> admin_pb2.StreamStatusRequest:
    """Encode a query for the status."""
    return admin_pb2.StreamStatusRequest(names=query.names, detailed_at_most=query.detailed_at_most)


def _sidecar_from_proto(message: admin_pb2.SidecarStatus) -> SidecarStatus:
    return SidecarStatus(
        peer=peer_from_proto(message.peer, with_token=False),
        connected=message.connected,
        lease_left_s=duration(message.lease_left_us, "lease_left_us", zero=True),
        software_version=text(message.software_version, "software_version"),
        uses=each(message.uses, MAX_USES, "uses", use_from_proto),
        peers=resource_from_proto(message.peers),
        mapping=resource_from_proto(message.mapping),
        services=each(message.services, MAX_MAPPED_SERVICES, "services", service_mapping_from_proto),
        paths=each(message.paths, MAX_PATH_REPORTS, "paths", path_from_proto),
        refused_offers=service_names(message.refused_offers, MAX_OFFERS, "refused_offers"),
        revocations=revocations_from_proto(message.revocations),
        unmet=service_names(message.unmet, MAX_UNMET, "unmet"),
        untyped=service_names(message.untyped, MAX_UNMET, "untyped"),
        unreached=service_names(message.unreached, MAX_UNMET, "unreached"),
        down=interface_names(message.down, "down"),
        faults=each(message.faults, MAX_FAULTS, "faults", _fault_from_proto),
        withdrawn=service_names(message.withdrawn, MAX_OFFERS, "withdrawn"),
        unanswered=_unanswered_from_proto(message.unanswered),
        abridged=message.abridged,
    )


def _sidecar_to_proto(status: SidecarStatus) -> admin_pb2.SidecarStatus:
    return admin_pb2.SidecarStatus(
        peer=peer_to_proto(dataclasses.replace(status.peer, token=b"", credential=b"", candidates_signature=b"")),
        connected=status.connected,
        lease_left_us=microseconds(status.lease_left_s),
        software_version=clean_text(status.software_version),
        uses=map(use_to_proto, status.uses),
        peers=resource_to_proto(status.peers),
        mapping=resource_to_proto(status.mapping),
        services=map(service_mapping_to_proto, status.services),
        paths=map(path_to_proto, status.paths),
        refused_offers=status.refused_offers,
        revocations=revocations_to_proto(status.revocations),
        unmet=status.unmet,
        untyped=status.untyped,
        unreached=status.unreached,
        down=status.down,
        faults=map(_fault_to_proto, status.faults),
        withdrawn=status.withdrawn,
        unanswered=(
            admin_pb2.UnansweredService(service=service, requests=requests)
            for service, requests in status.unanswered.items()
        ),
        abridged=status.abridged,
    )


def _fault_from_proto(message: admin_pb2.InterfaceFault) -> InterfaceFault:
    return InterfaceFault(
        interface=interface_name(message.interface, "interface"),
        fault=known(message.fault, _FAULTS, "fault"),
        text=text(message.text, "text"),
    )


def _fault_to_proto(found: InterfaceFault) -> admin_pb2.InterfaceFault:
    return admin_pb2.InterfaceFault(
        interface=found.interface, fault=_FAULT_NUMBERS[found.fault], text=clean_text(found.text)
    )


def _unanswered_from_proto(messages: Collection[admin_pb2.UnansweredService]) -> dict[ServiceName, int]:
    names = service_names([message.service for message in messages], MAX_OFFERS, "unanswered")
    return {name: message.requests for name, message in zip(names, messages, strict=True)}


def resource_from_proto(message: admin_pb2.ResourceStatus) -> ResourceStatus:
    """Check how far a sidecar has applied a resource."""
    return ResourceStatus(
        version_sent=version(message.version_sent, "version_sent"),
        version_acked=version(message.version_acked, "version_acked"),
        state=known(message.state, _SYNC_STATES, "sync state"),
        error=text(message.error, "error"),
    )


def resource_to_proto(status: ResourceStatus) -> admin_pb2.ResourceStatus:
    """Encode how far a sidecar has applied a resource."""
    return admin_pb2.ResourceStatus(
        version_sent=status.version_sent,
        version_acked=status.version_acked,
        state=_SYNC_STATE_NUMBERS[status.state],
        error=clean_text(status.error),
    )
