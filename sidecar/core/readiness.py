"""When an interface may carry data (paper, section IV.B: an interface that STUN cannot see is not used).

An interface is ready once STUN showed its address. While STUN servers answer nobody (the control plane, which runs
them, is away), waiting would lose requests for nothing: after a grace time every interface is ready, and the probes
of each path decide. Readiness once given stays until the interface's addresses change.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from protos.model import InterfaceName

STUN_GRACE_S = 3.0
"""Three retransmissions of a STUN request (RFC 8489 section 6.2.1 starts at 0.5 s and doubles)."""


class Readiness:
    """Which interfaces may be used."""

    def __init__(self, *, stun_enabled: bool, now: float) -> None:
        self._stun_enabled = stun_enabled
        self._grace_ends = now + STUN_GRACE_S
        self._ready: dict[InterfaceName, bool] = {}
        self._any_mapped = False

    def add(self, interface: InterfaceName) -> bool:
        """An interface appeared or changed its address; returns whether it is ready at once."""
        self._ready[interface] = not self._stun_enabled
        return self._ready[interface]

    def remove(self, interface: InterfaceName) -> None:
        """An interface is gone."""
        self._ready.pop(interface, None)

    def mapped(self, interface: InterfaceName) -> bool:
        """STUN showed the interface's address; returns whether that made it ready."""
        self._any_mapped = True
        if self._ready.get(interface, True):
            return False
        self._ready[interface] = True
        return True

    def after_grace(self, now: float) -> list[InterfaceName]:
        """Return the interfaces that become ready because no STUN server answers anybody."""
        if self._any_mapped or now < self._grace_ends:
            return []
        late = [interface for interface, ready in self._ready.items() if not ready]
        self._ready.update(dict.fromkeys(late, True))
        return late
