"""Holds the sidecar's ROS node and a small loop that waits on its entities; one thread owns all of it.

rclpy's own executors are not used: the standard ones rebuild their lists in Python for each event, and the experimental
EventsExecutor starves the other threads of the process (docs/develop/adr/0007-one-thread-owns-ros.md).
"""

from __future__ import annotations

import contextlib
import time
from typing import TYPE_CHECKING, Any, Protocol

import rclpy
from rclpy.context import Context
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, qos_profile_services_default
from rclpy.signals import SignalHandlerOptions

from plr.sidecar.ros.environment import not_started
from plr.sidecar.ros.errors import RosStartError
from plr.sidecar.ros.rcl import graph_guard, wait_for_guard

if TYPE_CHECKING:
    from collections.abc import Sequence

LONGEST_WAIT_S = 3600.0
_NANOSECONDS = 1_000_000_000


def service_qos(depth: int) -> Any:
    """Return the QoS profile of the bridge's services and clients: the default except for the depth of the queues."""
    return QoSProfile(
        history=qos_profile_services_default.history,
        depth=depth,
        reliability=qos_profile_services_default.reliability,
        durability=qos_profile_services_default.durability,
    )


class Waited(Protocol):
    """An entity whose handle the loop waits on."""

    @property
    def handle(self) -> Any:
        """rclpy's handle of a service or client."""


class RosLoop:
    """Context, node and wait set. All methods but `wake` belong to one thread."""

    def __init__(self, node_name: str, domain_id: int | None) -> None:
        """Join the domain; raise RosStartError if rmw cannot now."""
        self._context = Context()
        try:
            self.node = self._join(node_name, domain_id)
        except (_rclpy.RCLError, _rclpy.RMWError) as error:
            self._context.try_shutdown()
            raise RosStartError(not_started(str(error), time.time())) from error
        self._guard = _rclpy.GuardCondition(self._context.handle)
        self._graph_guard = graph_guard(self.node.handle.pointer)
        self.graph_changed = False
        """Whether the graph changed; the reader resets it."""
        self._services: dict[Any, Waited] = {}
        self._clients: dict[Any, Waited] = {}
        self._by_pointer: dict[int, Waited] = {}
        self._wait_set: Any = None
        self._woken = False

    def _join(self, node_name: str, domain_id: int | None) -> Node:
        # A separate context without rclpy's signal handlers and the command line: both belong to the program.
        # No ROS log file either: it would need a writable home directory.
        rclpy.init(
            args=["--ros-args", "--disable-external-lib-logs"],
            context=self._context,
            domain_id=domain_id,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        return Node(
            node_name,
            context=self._context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
            # The node offers nothing under its own name.
            parameter_overrides=[Parameter("start_type_description_service", value=False)],
        )

    @property
    def domain_id(self) -> int:
        """The ROS domain in force."""
        return int(self._context.get_domain_id())

    def set_services(self, services: Sequence[Waited]) -> None:
        """Wait on these services from now on."""
        self._services = {service.handle: service for service in services}
        self._wait_set = None

    def set_clients(self, clients: Sequence[Waited]) -> None:
        """Wait on these clients from now on."""
        self._clients = {client.handle: client for client in clients}
        self._wait_set = None

    def wake(self) -> None:
        """End the wait; any thread may call this."""
        if not self._woken:
            self._woken = True
            with contextlib.suppress(_rclpy.RCLError, _rclpy.InvalidHandle):  # closed meanwhile: nothing waits
                self._guard.trigger_guard_condition()

    def wait(self, timeout_s: float) -> list[Waited]:
        """Return the entities that have something to take, after at most `timeout_s` seconds."""
        if self._wait_set is None:
            self._rebuild()
        wait_set = self._wait_set
        wait_set.clear_entities()
        wait_set.add_guard_condition(self._guard)
        wait_for_guard(wait_set.pointer, self._graph_guard)
        for service in self._services:
            wait_set.add_service(service)
        for client in self._clients:
            wait_set.add_client(client)
        wait_set.wait(int(min(max(timeout_s, 0.0), LONGEST_WAIT_S) * _NANOSECONDS))
        self._woken = False
        if self._graph_guard in wait_set.get_ready_entities("guard_condition"):
            self.graph_changed = True
        ready = []
        if self._services:
            ready += wait_set.get_ready_entities("service")
        if self._clients:
            ready += wait_set.get_ready_entities("client")
        return [self._by_pointer[pointer] for pointer in ready]

    def close(self) -> None:
        """Destroy the node and all its entities, and leave the domain."""
        self._wait_set = None
        self._guard.destroy_when_not_in_use()
        self.node.destroy_node()
        self._context.try_shutdown()

    def _rebuild(self) -> None:
        self._by_pointer = {
            handle.pointer: entity for handle, entity in (*self._services.items(), *self._clients.items())
        }
        self._wait_set = _rclpy.WaitSet(0, 2, 0, len(self._clients), len(self._services), 0, self._context.handle)
