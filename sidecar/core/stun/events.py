"""Defines what the STUN client tells its driver, and what it counts."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.ids import Address


@dataclass(frozen=True, slots=True)
class Mapped:
    """The socket is seen as `address`: for the first time, or again after a failure or a start.

    `family` (4 or 6) is that of the server asked; behind a NAT64 `address` may be of the other one.
    """

    family: int
    address: Address
    server: Address


@dataclass(frozen=True, slots=True)
class MappingChanged:
    """The NAT gave the socket another address: `previous` is useless to peers now."""

    family: int
    address: Address
    previous: Address
    server: Address


@dataclass(frozen=True, slots=True)
class Failed:
    """No server of this family answered; asking goes on in the background.

    `last_known` is the mapping until now. A refresh also fails when only the servers are gone, so it may
    well still hold; the driver decides whether to use it.
    """

    family: int
    reason: str
    last_known: Address | None


StunEvent = Mapped | MappingChanged | Failed


class StunDrop(enum.StrEnum):
    """Why a STUN datagram was not believed; labels of plr_datagrams_dropped_total."""

    MALFORMED = "stun_malformed"
    NOT_A_RESPONSE = "stun_not_a_response"
    UNKNOWN_TRANSACTION = "stun_unknown_transaction"
    WRONG_SOURCE = "stun_wrong_source"
    UNKNOWN_ATTRIBUTE = "stun_unknown_attribute"
    NO_ADDRESS = "stun_no_address"
    BAD_ADDRESS = "stun_bad_address"
