"""Times one STUN request to one server over UDP: when to send it, when to give it up (RFC 8489 section 6.2.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.protos.stun.codec import MessageClass, StunMessage, encode

if TYPE_CHECKING:
    from plr.protos.model.ids import Address


@dataclass(frozen=True, slots=True)
class Retransmission:
    """RFC 8489's timer, with its own default values: 39.5 s from the first request to giving up."""

    initial_rto_s: float = 0.5
    """RTO: wait after the first request; doubles with each further one."""

    max_requests: int = 7
    """Rc: number of requests sent in all."""

    last_wait_factor: float = 16.0
    """Rm: wait after the last request, in multiples of the initial RTO."""

    def __post_init__(self) -> None:
        if self.initial_rto_s <= 0 or self.max_requests < 1 or self.last_wait_factor <= 0:
            raise ValueError("retransmission needs a positive RTO, at least one request and a positive last wait")


class StunTransaction:
    """A Binding request that is repeated, byte for byte, until it is answered or given up."""

    __slots__ = (
        "_retransmission",
        "_rto_s",
        "deadline",
        "request",
        "requests_sent",
        "server",
        "transaction_id",
    )

    def __init__(
        self,
        server: Address,
        transaction_id: bytes,
        software: str | None,
        retransmission: Retransmission,
        now: float,
    ) -> None:
        self.server = server
        self.transaction_id = transaction_id
        self.request = encode(StunMessage(MessageClass.REQUEST, transaction_id, software=software, fingerprint=True))
        self.requests_sent = 0
        self.deadline = now
        """When to call handle_timer next; the first request is due at once."""
        self._retransmission = retransmission
        self._rto_s = retransmission.initial_rto_s

    def handle_timer(self, now: float) -> bool:
        """Count one more request as sent and return True; return False when all were sent and waited for.

        Call it at `deadline` or later. After a pause longer than the schedule (a suspended machine) the waits
        start from now: a burst of overdue copies would tell no more than one.
        """
        if self.requests_sent >= self._retransmission.max_requests:
            return False
        self.requests_sent += 1
        if self.requests_sent < self._retransmission.max_requests:
            self.deadline = now + self._rto_s
            self._rto_s *= 2
        else:
            self.deadline = now + self._retransmission.last_wait_factor * self._retransmission.initial_rto_s
        return True
