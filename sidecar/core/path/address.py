"""Tracks a path's remote address and limits what goes to an unproven one (RFC 9000 sections 8 and 9.3).

A datagram's source address proves nothing: a member can forge another's. The proof is an answer to what we sent to an
address, with an id of 64 random bits that stood in it and nowhere else. Until then at most three times as many bytes go
to an address as came from it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.protos.model.ids import Address

AMPLIFICATION = 3
"""Bytes that may go to an unproven address for each byte that came from it (RFC 9000 section 8)."""
LEAST_CREDIT_BYTES = 64
"""Bytes that a probe takes. With less credit nothing leaves until more arrives."""
PROOF_S = 1.0
"""Time to prove a new address, or the time an answer takes if longer. After it the path returns to its last proven one.
"""
MAX_PROVEN = 4
"""Proven addresses that a path remembers, the newest. A roaming robot alternates between two."""


class PathAddress:
    """The remote address of one path."""

    __slots__ = ("_credit", "_proven", "_since", "address")

    def __init__(self) -> None:
        self.address: Address | None = None
        """Source of the newest authentic datagram."""
        self._proven: dict[Address, None] = {}
        """Addresses that the peer has proven in its current session; the newest last."""
        self._credit = 0
        self._since = 0.0

    @property
    def is_proven(self) -> bool:
        """Whether the peer has proven the current address."""
        return self.address in self._proven

    def proven(self, address: Address) -> bool:
        """Return whether the peer has proven this address, now or earlier."""
        return address in self._proven

    def move(self, source: Address, now: float) -> None:
        """Make the source of the newest authentic datagram the current address."""
        self.address = source
        self._credit = 0
        self._since = now

    def came(self, source: Address, size: int) -> None:
        """Credit `size` authentic bytes that came from `source`."""
        if source == self.address:
            self._credit += AMPLIFICATION * size

    def went(self, address: Address, size: int) -> None:
        """Debit `size` bytes that went to `address`."""
        if address == self.address:
            self._credit -= size

    @property
    def allowance(self) -> int | None:
        """How many bytes may go there now; None: no limit."""
        if self.address in self._proven:
            return None
        return self._credit if self._credit >= LEAST_CREDIT_BYTES else 0

    @property
    def is_blocked(self) -> bool:
        """Whether nothing may go there until something comes from there."""
        return self._credit < LEAST_CREDIT_BYTES and self.address not in self._proven

    def block(self) -> None:
        """Drop the remaining credit: it is too little for what comes next."""
        self._credit = 0

    def prove(self, address: Address) -> None:
        """Note that the peer is, or was a moment ago, at this address."""
        self._proven.pop(address, None)
        self._proven[address] = None
        if len(self._proven) > MAX_PROVEN:
            oldest = next(one for one in self._proven if one != self.address)
            del self._proven[oldest]

    def gives_up_at(self, answer_s: float) -> float | None:
        """Return when the path goes back to its last proven address (s) if an answer takes `answer_s`; None: never."""
        if self.address is None or not self._proven or self.address in self._proven:
            return None
        return self._since + max(PROOF_S, answer_s)

    def before(self) -> Address | None:
        """Return the last address that the peer has proven."""
        return next(reversed(self._proven), None)
