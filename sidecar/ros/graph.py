"""Who serves what in the local ROS graph.

rclpy (Jazzy) gives no access to the graph's guard condition, so the graph is looked at every `SCAN_PERIOD_S`; a look
costs about 10 microseconds per node.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy

from protos.model import ServiceName

if TYPE_CHECKING:
    from collections.abc import Mapping

SCAN_PERIOD_S = 0.2
SETTLING_PERIOD_S = 0.02
"""Between looks while an entity of ours waits to be matched with its server."""
SIDECAR_NODE_PREFIX = "_plr_sidecar_"
"""The leading underscore hides the node from `ros2 node list`."""
_UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"


def sidecar_node_name(sidecar: str) -> str:
    """Return the ROS node name of the sidecar called `sidecar`."""
    return SIDECAR_NODE_PREFIX + re.sub(r"[^A-Za-z0-9_]", "_", sidecar)


def is_sidecar(full_node_name: str) -> bool:
    """True for nodes of FogROS2-PLR sidecars."""
    return full_node_name.rsplit("/", 1)[-1].startswith(SIDECAR_NODE_PREFIX)


@dataclass(frozen=True, slots=True)
class Served:
    """One service name: its types, and for each the full names of the nodes that serve it."""

    by_type: Mapping[str, frozenset[str]]

    def applications(self) -> dict[str, frozenset[str]]:
        """Return type -> nodes, without sidecars and without types that only sidecars serve."""
        own = {kind: frozenset(n for n in nodes if not is_sidecar(n)) for kind, nodes in self.by_type.items()}
        return {kind: nodes for kind, nodes in own.items() if nodes}

    def nodes(self) -> frozenset[str]:
        """Return all nodes that serve it."""
        return frozenset().union(*self.by_type.values())


def scan(node: Any) -> dict[ServiceName, Served]:
    """Return every service of the graph whose node is known."""
    found: dict[ServiceName, dict[str, set[str]]] = {}
    for name, namespace in set(node.get_node_names_and_namespaces()):
        if name == _UNKNOWN_NODE:
            continue  # its endpoints are discovered before its name: seen at the next look
        full_name = f"{namespace.rstrip('/')}/{name}"
        try:
            services = node.get_service_names_and_types_by_node(name, namespace)
        except (_rclpy.NodeNameNonExistentError, _rclpy.RCLError):
            continue  # it went away since its name was read
        for service, types in services:
            by_type = found.setdefault(ServiceName(service), {})
            for kind in types:
                by_type.setdefault(kind, set()).add(full_name)
    return {
        service: Served({kind: frozenset(nodes) for kind, nodes in by_type.items()})
        for service, by_type in found.items()
    }


def server_endpoints(node: Any, service: ServiceName) -> frozenset[bytes]:
    """Return the DDS ids of the endpoints that answer for `service`, or nothing where rmw is not DDS."""
    infos = node.get_publishers_info_by_topic(f"rr{service}Reply", no_mangle=True)
    return frozenset(bytes(info.endpoint_gid) for info in infos)
