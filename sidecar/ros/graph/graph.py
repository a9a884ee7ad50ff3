"""Finds out who serves what in the local ROS graph.

rmw reports that the graph has changed, but not what; `scans.py` decides when to scan it. An endpoint whose node rmw
does not know may have a name all the same (`unknown_nodes.py`); without one it is no server of an application.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy

from plr.protos.model.ids import ServiceName

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Mapping

    NameOf = Callable[[bytes, float], str | None]
    """Takes an endpoint that rmw has no name for, and the time; returns its node's full name, if known."""

SIDECAR_NODE_PREFIX = "_plr_sidecar_"
"""The leading underscore hides the node from `ros2 node list`."""
PARTICIPANTS_TOPIC = "ros_discovery_info"
"""DDS name of the topic on which each ROS process announces its nodes (rmw_dds_common)."""
_UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"


def sidecar_node_name(sidecar: str) -> str:
    """Return the ROS node name of the sidecar called `sidecar`."""
    return SIDECAR_NODE_PREFIX + re.sub(r"[^A-Za-z0-9_]", "_", sidecar)


def is_sidecar(full_node_name: str) -> bool:
    """Return True for nodes of FogROS2-PLR sidecars."""
    return full_node_name.rsplit("/", 1)[-1].startswith(SIDECAR_NODE_PREFIX)


@dataclass(frozen=True, slots=True)
class Served:
    """The types of one service name, each with the full names of the nodes that serve it."""

    by_type: Mapping[str, frozenset[str]]

    def applications(self) -> dict[str, frozenset[str]]:
        """Return type -> nodes, without sidecars and without types that only sidecars serve."""
        own = {kind: frozenset(n for n in nodes if not is_sidecar(n)) for kind, nodes in self.by_type.items()}
        return {kind: nodes for kind, nodes in own.items() if nodes}

    def nodes(self) -> frozenset[str]:
        """Return all nodes that serve it."""
        return frozenset().union(*self.by_type.values())


def scan(
    node: Any, name_of: NameOf, wanted: Callable[[ServiceName], bool], now: float
) -> Generator[None, None, dict[ServiceName, Served]]:
    """Return the services of known nodes, scanning node by node, and all servers found for those that are `wanted`."""
    found: dict[ServiceName, dict[str, set[str]]] = {}
    for name, namespace in frozenset(node.get_node_names_and_namespaces()):
        if name == _UNKNOWN_NODE:
            continue  # its endpoints are discovered before its name, which changes the graph again
        full_name = _full_name(namespace, name)
        try:
            services = node.get_service_names_and_types_by_node(name, namespace)
        except (_rclpy.NodeNameNonExistentError, _rclpy.RCLError):
            continue  # it went away since its name was read
        for service, types in services:
            by_type = found.setdefault(ServiceName(service), {})
            for kind in types:
                by_type.setdefault(kind, set()).add(full_name)
        yield
    # Of several nodes of one name, such as a server started twice, rmw shows the services of one only. It shows none of
    # a process whose nodes it does not know, even if a sidecar serves the name as well.
    for service in [ServiceName(name) for name, _ in node.get_service_names_and_types()]:
        if not wanted(service) or any(not is_sidecar(n) for nodes in found.get(service, {}).values() for n in nodes):
            continue
        for info in _reply_writers(node, service):
            known = _node_of(info, name_of, now)
            if known is not None:
                by_type = found.setdefault(service, {})
                by_type.setdefault(_service_type(info["topic_type"]), set()).add(known)
        yield
    return {
        service: Served({kind: frozenset(nodes) for kind, nodes in by_type.items()})
        for service, by_type in found.items()
    }


def server_endpoints(node: Any, service: ServiceName, name_of: NameOf, now: float) -> dict[str, dict[bytes, bool]]:
    """Return type -> DDS ids of the endpoints that answer for `service`, each with whether an application owns it.

    The result is empty where rmw is not DDS.
    """
    found: dict[str, dict[bytes, bool]] = {}
    for info in _reply_writers(node, service):
        name = _node_of(info, name_of, now)
        is_known = name is not None and not is_sidecar(name)
        found.setdefault(_service_type(info["topic_type"]), {})[bytes(info["endpoint_gid"])] = is_known
    return found


def _node_of(info: dict[str, Any], name_of: NameOf, now: float) -> str | None:
    if info["node_name"] == _UNKNOWN_NODE:
        return name_of(bytes(info["endpoint_gid"]), now)
    return _full_name(info["node_namespace"], info["node_name"])


def _full_name(namespace: str, name: str) -> str:
    return f"{namespace.rstrip('/')}/{name}"


def _reply_writers(node: Any, service: str) -> list[dict[str, Any]]:
    # The node's own method makes an object of each endpoint's QoS and takes twice as long.
    infos: list[dict[str, Any]] = _rclpy.rclpy_get_publishers_info_by_topic(node.handle, f"rr{service}Reply", True)
    return infos


def _service_type(dds_type: str) -> str:
    """Return `std_srvs/srv/Trigger` for `std_srvs::srv::dds_::Trigger_Response_`."""
    return dds_type.replace("dds_::", "").replace("::", "/").removesuffix("_Response_")


def participants(node: Any) -> frozenset[bytes]:
    """Return the DDS ids of the endpoints on which the domain's ROS processes announce their nodes, one per process."""
    infos = _rclpy.rclpy_get_publishers_info_by_topic(node.handle, PARTICIPANTS_TOPIC, True)
    return frozenset(bytes(info["endpoint_gid"]) for info in infos)
