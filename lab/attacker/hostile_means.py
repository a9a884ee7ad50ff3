"""Holds what the parts of one compromised member share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric import ec

    from lab.attacker.orders import Commander
    from lab.attacker.tally import Tally


@dataclass(frozen=True, slots=True)
class Means:
    """The means of one insider."""

    commander: Commander
    tally: Tally
    key: ec.EllipticCurvePrivateKey = field(repr=False)
    """The key of its certificate."""
    service: tuple[str, str]
    """Name and type of the service that it may call or offer."""
    request: bytes
    """A small request for the service, in CDR."""
    request_of_much: bytes
    """A request for a large answer."""
    request_that_is_large: bytes
    response: bytes

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the honest nodes."""
        orders = self.commander.orders
        return () if orders is None else orders.names

    @property
    def third_party(self) -> tuple[str, str]:
        """IPv4 and IPv6 address of the third party."""
        orders = self.commander.orders
        return ("192.0.2.1", "2001:db8::1") if orders is None else orders.third_party
