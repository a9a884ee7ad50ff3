"""Where a path leads, and how much may go there before the peer has proven to be there (RFC 9000 sections 8 and 9.3).

A datagram's source is no proof: a member can write another's address into it. It is proof that what we sent to an
address is answered, with an id of 64 random bits that stood in it and nowhere else. Until then at most three times as
many bytes go to an address as came from it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from protos.model.ids import Address

AMPLIFICATION = 3
"""Bytes that may go to an address for each that came from it (RFC 9000 section 8)."""
LEAST_CREDIT_BYTES = 64
"""What a probe takes. With less nothing goes out until more came in."""
PROOF_S = 1.0
"""Without a proof for so long, or for as long as an answer takes, the path leads to where it led before."""
MAX_PROVEN = 4
"""Addresses of a path that are remembered as proven, the newest: a robot that roams goes to and fro between two."""


class PathAddress:
    """The address of one path's other end."""

    __slots__ = ("_credit", "_proven", "_since", "address")

    def __init__(self) -> None:
        self.address: Address | None = None
        """Where the newest authentic datagram came from."""
        self._proven: dict[Address, None] = {}
        """Where the peer has been, in this session of it; the newest last."""
        self._credit = 0
        self._since = 0.0

    @property
    def is_proven(self) -> bool:
        """Whether the peer has proven to be there."""
        return self.address in self._proven

    def proven(self, address: Address) -> bool:
        """Whether the peer has proven to be, or to have been, at this address."""
        return address in self._proven

    def move(self, source: Address, now: float) -> None:
        """The newest authentic datagram came from here."""
        self.address = source
        self._credit = 0
        self._since = now

    def came(self, source: Address, size: int) -> None:
        """So many authentic bytes came from here."""
        if source == self.address:
            self._credit += AMPLIFICATION * size

    def went(self, address: Address, size: int) -> None:
        """So many bytes went there."""
        if address == self.address:
            self._credit -= size

    @property
    def allowance(self) -> int | None:
        """How many bytes may go there now; None: as many as one likes."""
        if self.address in self._proven:
            return None
        return self._credit if self._credit >= LEAST_CREDIT_BYTES else 0

    @property
    def is_blocked(self) -> bool:
        """Whether nothing may go there until something comes from there."""
        return self._credit < LEAST_CREDIT_BYTES and self.address not in self._proven

    def block(self) -> None:
        """What is left is too little for what comes next."""
        self._credit = 0

    def prove(self, address: Address) -> None:
        """The peer is, or was a moment ago, at this address."""
        self._proven.pop(address, None)
        self._proven[address] = None
        if len(self._proven) > MAX_PROVEN:
            oldest = next(one for one in self._proven if one != self.address)
            del self._proven[oldest]

    def gives_up_at(self, answer_s: float) -> float | None:
        """When it leads to where it led before (s), if an answer takes so long; None when that is no question."""
        if self.address is None or not self._proven or self.address in self._proven:
            return None
        return self._since + max(PROOF_S, answer_s)

    def before(self) -> Address | None:
        """Where the peer has proven to be last."""
        return next(reversed(self._proven), None)
