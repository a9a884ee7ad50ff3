"""Converts mappings."""

from __future__ import annotations

from plr.protos.convert.fields import MAX_ASSIGNMENTS, MAX_MAPPED_SERVICES, each, probability, unique, version
from plr.protos.model.mapping import Assignment, MappingSet, ServiceMapping
from plr.protos.model.names import clean_text, interface_name, node_name, service_name, text
from plr.protos.plr.v1 import control_pb2


def mapping_set_from_proto(message: control_pb2.MappingSet) -> MappingSet:
    """Check a mapping set."""
    services = each(message.services, MAX_MAPPED_SERVICES, "services", service_mapping_from_proto)
    unique((mapping.service for mapping in services), "services")
    return MappingSet(version=version(message.version, "mapping version"), nonce=message.nonce, services=services)


def mapping_set_to_proto(mapping: MappingSet) -> control_pb2.MappingSet:
    """Encode a mapping set."""
    return control_pb2.MappingSet(
        version=mapping.version,
        nonce=mapping.nonce,
        services=map(service_mapping_to_proto, mapping.services),
    )


def service_mapping_from_proto(message: control_pb2.ServiceMapping) -> ServiceMapping:
    """Check the mapping of one service."""
    assignments = each(message.assignments, MAX_ASSIGNMENTS, "assignments", assignment_from_proto)
    explore = assignment_from_proto(message.explore) if message.HasField("explore") else None
    unique(((a.interface, a.server) for a in (*assignments, explore) if a is not None), "assignments and explore")
    return ServiceMapping(
        service=service_name(message.service, "service"),
        assignments=assignments,
        predicted_miss=probability(message.predicted_miss, "predicted_miss"),
        reason=text(message.reason, "reason"),
        explore=explore,
    )


def service_mapping_to_proto(mapping: ServiceMapping) -> control_pb2.ServiceMapping:
    """Encode the mapping of one service."""
    return control_pb2.ServiceMapping(
        service=mapping.service,
        assignments=map(assignment_to_proto, mapping.assignments),
        predicted_miss=mapping.predicted_miss,
        reason=clean_text(mapping.reason),
        explore=assignment_to_proto(mapping.explore) if mapping.explore is not None else None,
    )


def assignment_from_proto(message: control_pb2.Assignment) -> Assignment:
    """Check a pair of an interface and a server."""
    return Assignment(
        interface=interface_name(message.interface, "interface"), server=node_name(message.server, "server")
    )


def assignment_to_proto(assignment: Assignment) -> control_pb2.Assignment:
    """Encode a pair of an interface and a server."""
    return control_pb2.Assignment(interface=assignment.interface, server=assignment.server)
