"""What the parts of one member that was taken over share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric import ec

    from lab.attacker.orders import Commander
    from lab.attacker.tally import Tally


@dataclass(frozen=True, slots=True)
class Means:
    """Of one insider."""

    commander: Commander
    tally: Tally
    key: ec.EllipticCurvePrivateKey = field(repr=False)
    """Its certificate's."""
    service: tuple[str, str]
    """Name and type of what it may call or offer."""
    request: bytes
    """A request of it, small, in CDR."""
    request_of_much: bytes
    """One that asks for a large answer."""
    request_that_is_large: bytes
    response: bytes

    @property
    def names(self) -> tuple[str, ...]:
        """Of the honest nodes."""
        orders = self.commander.orders
        return () if orders is None else orders.names

    @property
    def third_party(self) -> tuple[str, str]:
        """An IPv4 and an IPv6 address."""
        orders = self.commander.orders
        return ("192.0.2.1", "2001:db8::1") if orders is None else orders.third_party
