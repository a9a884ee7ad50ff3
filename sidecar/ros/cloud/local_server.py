"""Wraps the client of one service of the local graph: requests go in and answers come out, with rmw's numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from plr.sidecar.ros.cloud.server_capacity import MOST_AT_ONCE
from plr.sidecar.ros.errors import RosBridgeError
from plr.sidecar.ros.graph import graph
from plr.sidecar.ros.rcl import Message, send_request, take_response
from plr.sidecar.ros.ros_loop import service_qos

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from plr.protos.model.ids import ServiceName
    from plr.sidecar.ros.graph.graph import NameOf
    from plr.sidecar.ros.types import ServiceType

TAKEN_AT_ONCE = 32
"""Answers taken from one server before the next has its turn."""
SETTLES_S = 0.2
"""How long after its node is known a new server gets requests. Until then it may not know our client, and DDS takes up
to 2 s to deliver what it missed (measured with servers killed and restarted)."""


class LocalServer:
    """A client of the service `name`."""

    def __init__(self, node: Any, name: ServiceName, service_type: ServiceType, name_of: NameOf) -> None:
        """Create the client; raise RosBridgeError if rmw refuses."""
        self.name = name
        self.type = service_type
        self._node = node
        self._name_of = name_of
        try:
            self._client = node.create_client(service_type.service, name, qos_profile=service_qos(MOST_AT_ONCE))
        # rclpy validates names with exceptions of several unrelated classes.
        except Exception as error:
            raise RosBridgeError(f"rmw refuses a client of {name}, type {service_type.name}: {error}") from error
        self._pointer: int = self._client.handle.pointer
        self.endpoints: frozenset[bytes] = frozenset()
        """DDS ids of all its servers of this type in the graph, which tell a restarted one from the old one; empty
        where rmw is not DDS."""
        self._alive: frozenset[bytes] = frozenset()
        self._asked: frozenset[bytes] = frozenset()
        """Endpoints that may still owe answers."""
        self._usable_at: float | None = None
        self._matched = False
        self._scanned = False
        self.ready = False
        """Whether requests may be sent; otherwise rmw would silently drop them, or no server is there."""

    @property
    def handle(self) -> Any:
        """rclpy's handle."""
        return self._client.handle

    @property
    def lost(self) -> bool:
        """True while all its servers in the graph are dead."""
        return bool(self.endpoints) and not self._alive

    @property
    def mismatched(self) -> bool:
        """Whether a server lives that rmw has not connected to us: its QoS is incompatible, or it is new."""
        return bool(self._alive) and not self.ready

    @property
    def living(self) -> int:
        """Number of live servers in the graph; each of them gets every request."""
        return len(self._alive)

    @property
    def only(self) -> bytes | None:
        """The only server that can be the one that answers: the only live one or, if none lives, the only one shown."""
        answering = self._alive or self.endpoints
        return next(iter(answering)) if len(answering) == 1 else None

    def is_usable(self, now: float) -> bool:
        """Return whether a server in the graph lives and knows our client by now."""
        if not self.endpoints:
            return self._scanned
        return self._usable_at is not None and now >= self._usable_at

    def scan(self, is_dead: Callable[[bytes], bool], now: float) -> bool:
        """Scan the graph; return whether all servers of the last scan are gone, and so will answer nothing."""
        # A node that serves the name with another type gets none of our requests, and answers nothing.
        known = graph.server_endpoints(self._node, self.name, self._name_of, now).get(self.type.name, {})
        self.endpoints = frozenset(known)
        self._scanned = True
        alive = frozenset(endpoint for endpoint, is_known in known.items() if is_known and not is_dead(endpoint))
        if not alive & self._alive:
            self._usable_at = now + SETTLES_S if alive else None
            self._matched = False
        self._alive = alive
        # A silent server keeps its requests until another takes its place, or until it is gone from the graph.
        went = bool(self._asked) and not self._asked & (alive or self.endpoints)
        if went or alive:
            self._asked = alive
        # Once true, it stays true: rmw briefly reports false again whenever another node begins to serve the name.
        self._matched = self._matched or bool(self._client.handle.service_server_is_available())
        self.ready = self._matched and self.is_usable(now)
        return went

    def is_over(self, has_ended: Callable[[bytes], bool]) -> bool:
        """Return whether all its servers in the graph have ended, and so will answer nothing more."""
        return bool(self.endpoints) and all(has_ended(endpoint) for endpoint in self.endpoints)

    def strike_out(self, is_dead: Callable[[bytes], bool]) -> bool:
        """Strike out the dead after some process died or fell silent; return whether the last live one went."""
        alive = frozenset(endpoint for endpoint in self._alive if not is_dead(endpoint))
        went = bool(self._alive) and not alive
        self._alive = alive
        if went:
            self._usable_at = None
            self.ready = False
        return went

    def send(self, request: Message) -> int:
        """Send a request and return its number; raise RosBridgeError on failure."""
        return send_request(self._pointer, request)

    def take(self) -> Iterator[tuple[int, bytes]]:
        """Yield the answers that have arrived, a limited number at a time: (number of the request, bytes)."""
        for _ in range(TAKEN_AT_ONCE):
            taken = take_response(self._pointer, self.type.response)
            if taken is None:
                return
            yield taken

    def close(self) -> None:
        """Destroy the client."""
        self._pointer = 0  # rcl refuses a null pointer, and would crash on the old one
        self._node.destroy_client(self._client)
