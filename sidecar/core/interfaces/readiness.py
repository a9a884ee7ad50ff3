"""Decides when an interface may carry data (paper, section IV.B: an interface that STUN cannot see is not used).

An interface is ready once STUN has shown its address. While STUN servers answer no interface of the same families (the
control plane, which runs them, is away, or has no IPv6 for an IPv6-only interface), waiting would lose requests for
nothing: after a grace time such an interface is ready, and the probes of each path decide. An interface stays ready
for as long as it exists.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.ids import InterfaceName

STUN_GRACE_S = 3.0
"""Time for three requests to a STUN server (RFC 8489 section 6.2.1 starts at 0.5 s and doubles)."""


class Readiness:
    """The interfaces and whether each may be used."""

    def __init__(self, *, stun_enabled: bool) -> None:
        self._stun_enabled = stun_enabled
        self._added_at: dict[InterfaceName, float] = {}
        self._families: dict[InterfaceName, frozenset[int]] = {}
        self._ready: set[InterfaceName] = set()
        self._answered: set[tuple[InterfaceName, int]] = set()
        """Pairs of interface and family whose last STUN round was answered."""

    def add(self, interface: InterfaceName, families: frozenset[int], now: float) -> bool:
        """Add an interface with addresses of these families (4, 6); return whether it is ready at once."""
        self._added_at[interface] = now
        self._families[interface] = families
        if not self._stun_enabled:
            self._ready.add(interface)
        return interface in self._ready

    def set_families(self, interface: InterfaceName, families: frozenset[int]) -> None:
        """Replace the families of an interface whose addresses changed."""
        self._families[interface] = families

    @property
    def waiting(self) -> bool:
        """Return whether some interface is not ready."""
        return len(self._ready) < len(self._added_at)

    def remove(self, interface: InterfaceName) -> None:
        """Remove an interface that is gone."""
        self._added_at.pop(interface, None)
        self._families.pop(interface, None)
        self._ready.discard(interface)
        self._answered = {(name, family) for name, family in self._answered if name != interface}

    def mapped(self, interface: InterfaceName, family: int) -> bool:
        """Note that STUN over IPv4 or IPv6 showed the interface's address; return whether that made it ready."""
        if interface not in self._added_at:
            return False
        self._answered.add((interface, family))
        if interface in self._ready:
            return False
        self._ready.add(interface)
        return True

    def failed(self, interface: InterfaceName, family: int) -> None:
        """Note that no STUN server of this family answered the interface."""
        self._answered.discard((interface, family))

    def after_grace(self, now: float) -> list[InterfaceName]:
        """Return the interfaces that become ready because no STUN server answers anybody in their families."""
        answered = {family for _, family in self._answered}
        late = [
            interface
            for interface, added_at in self._added_at.items()
            if interface not in self._ready
            and now >= added_at + STUN_GRACE_S
            and not self._families[interface] & answered
        ]
        self._ready.update(late)
        return late
