"""A mesh whose robots stand behind NATs, which may forget their mappings at any moment."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lab.simulated.mesh import IPV6, Mesh

if TYPE_CHECKING:
    from plr.protos.model.ids import Address

FIRST_PORT = 10_000


class NatMesh(Mesh):
    """Each interface of a robot has a NAT of its own: one port for all destinations, and in by it comes only who was
    sent something (RFC 4787: endpoint-independent mapping, address- and port-dependent filtering).
    """

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self._next_port = FIRST_PORT
        self._ports: dict[str, int] = {}
        self._opened: set[tuple[Address, Address]] = set()
        self.refused = 0
        """Datagrams that came from outside to where nothing leads any more."""

    def rebind(self, host: str) -> None:
        """The NAT of an interface (host part of its address) forgets its mappings; the next ones have another port."""
        self._ports.pop(host, None)

    def _is_inside(self, host: str) -> bool:
        name = host.removesuffix(IPV6).rsplit(".", 1)[0]
        return name in self.nodes and self.nodes[name].role.value == "robot"

    def _carry(self, source: Address, destination: Address, data: bytes) -> None:
        if self._is_inside(source[0]):
            port = self._ports.get(source[0])
            if port is None:
                port = self._ports[source[0]] = self._next_port
                self._next_port += 1
            source = (source[0], port)
            self._opened.add((source, destination))
        super()._carry(source, destination, data)

    def _arrive(self, source: Address, destination: Address, data: bytes) -> None:
        if self._is_inside(destination[0]) and (
            destination[1] != self._ports.get(destination[0]) or (destination, source) not in self._opened
        ):
            self.refused += 1
            return
        super()._arrive(source, destination, data)
