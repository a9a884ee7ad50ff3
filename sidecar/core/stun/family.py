"""Runs the STUN client for one address family: decides which server to ask when, and what to believe. Sans-IO."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from ipaddress import ip_address
from typing import TYPE_CHECKING

from plr.protos.stun.codec import TRANSACTION_ID_BYTES, MessageClass, StunMessage
from plr.sidecar.core.stun.events import Failed, Mapped, MappingChanged, StunDrop, StunEvent
from plr.sidecar.core.stun.transaction import Retransmission, StunTransaction

if TYPE_CHECKING:
    import random
    from collections import Counter

    from plr.protos.model.ids import Address

MAX_QUEUED_EVENTS = 64
"""Events kept for a driver that does not fetch them; the oldest is dropped first, and counted."""


@dataclass(frozen=True, slots=True)
class StunClientConfig:
    """Timing of the client; the defaults suit a robot behind a carrier's NAT."""

    retransmission: Retransmission = field(default_factory=Retransmission)

    stagger_s: float = 2.0
    """Silence of one server before the next one is asked as well: three requests unanswered."""

    refresh_s: float = 15.0
    """Interval of checks of a mapping; below the 30 s that short NAT bindings last, so it keeps them alive."""

    retry_s: float = 1.0
    """First wait after a round in which no server answered; doubles with each further one."""

    max_retry_s: float = 30.0
    """Longest wait between failed rounds: a server that is back up is found within this plus the jitter."""

    jitter: float = 0.25
    """Share by which waits vary, so that a fleet does not ask in step."""

    def __post_init__(self) -> None:
        if min(self.stagger_s, self.refresh_s, self.retry_s) <= 0 or self.max_retry_s < self.retry_s:
            raise ValueError("STUN waits must be positive, and max_retry_s at least retry_s")
        if not 0 <= self.jitter < 1:
            raise ValueError(f"STUN jitter {self.jitter} is not in [0, 1)")


class StunOutbox:
    """State that the families of one socket share: datagrams to send, events, counters."""

    def __init__(self, drops: Counter[str]) -> None:
        self.sending: list[tuple[bytes, Address]] = []
        self.events: deque[StunEvent] = deque()
        self.drops = drops
        self.requests_sent = 0
        self.events_lost = 0

    def send(self, transaction: StunTransaction) -> None:
        """Queue the transaction's request."""
        self.requests_sent += 1
        self.sending.append((transaction.request, transaction.server))

    def emit(self, event: StunEvent) -> None:
        """Queue an event for the driver."""
        if len(self.events) >= MAX_QUEUED_EVENTS:
            self.events.popleft()
            self.events_lost += 1
        self.events.append(event)


class StunFamilyClient:
    """Learns and refreshes the mapping of one socket for family 4 or 6; `servers` must not be empty."""

    def __init__(
        self,
        family: int,
        servers: tuple[Address, ...],
        outbox: StunOutbox,
        rng: random.Random,
        config: StunClientConfig,
        software: str | None,
    ) -> None:
        self.servers = servers
        self.mapping: Address | None = None
        self.answered_at: float | None = None
        """When a server last answered (s)."""
        self.changes = 0
        """Number of times the mapping changed."""
        self.problem = ""
        """Why the last round failed; empty if it did not."""
        self._family = family
        self._outbox = outbox
        self._rng = rng
        self._config = config
        self._software = software
        self._preferred: Address | None = None
        self._announced = False
        self._failed_rounds = 0
        self._reason = ""
        self._next_round: float | None = None
        self._next_server: float | None = None
        self._waiting: deque[Address] = deque()
        self._transactions: list[StunTransaction] = []

    def start(self, now: float) -> None:
        """Ask at once, dropping requests under way but not the mapping; report the answer even if it is the same."""
        self._failed_rounds = 0
        self._announced = False
        self._start_round(now)

    @property
    def preferred(self) -> Address | None:
        """Return the server that answered last."""
        return self._preferred

    def find(self, transaction_id: bytes) -> StunTransaction | None:
        """Return the transaction under way with this id."""
        return next((t for t in self._transactions if t.transaction_id == transaction_id), None)

    def next_timer(self) -> float | None:
        """Return when to call handle_timer."""
        timers = [t.deadline for t in self._transactions]
        timers += [t for t in (self._next_round, self._next_server) if t is not None]
        return min(timers, default=None)

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        if self._next_round is not None and now >= self._next_round:
            self._start_round(now)
        if self._next_server is not None and now >= self._next_server:
            self._ask_next_server(now)
        for transaction in list(self._transactions):
            if now < transaction.deadline:
                continue
            if transaction.handle_timer(now):
                self._outbox.send(transaction)
            else:
                self._give_up(transaction, f"no answer from {_text(transaction.server)}", now)

    def handle_response(self, transaction: StunTransaction, message: StunMessage, source: Address, now: float) -> None:
        """Believe or drop a response that carries the transaction's id."""
        drops = self._outbox.drops
        if source != transaction.server:
            drops[StunDrop.WRONG_SOURCE] += 1
            return
        # RFC 8489 sections 6.3.3 and 6.3.4: such a response ends its transaction.
        if message.unknown_required:
            drops[StunDrop.UNKNOWN_ATTRIBUTE] += 1
            self._give_up(transaction, f"{_text(source)} answered with unknown attributes", now)
            return
        if message.message_class is MessageClass.ERROR:
            reason = f"{_text(source)} answered {message.error_code} {message.error_reason}".rstrip()
            self._give_up(transaction, reason, now)
            return
        address = message.reflexive_address
        if address is None or not _is_usable(address):
            drops[StunDrop.NO_ADDRESS if address is None else StunDrop.BAD_ADDRESS] += 1
            self._give_up(transaction, f"{_text(source)} answered without a usable address", now)
            return
        self._learn(address, source, now)

    def _learn(self, address: Address, server: Address, now: float) -> None:
        previous, self.mapping = self.mapping, address
        self.answered_at, self.problem = now, ""
        if previous is not None and previous != address:
            self.changes += 1
            self._outbox.emit(MappingChanged(self._family, address, previous, server))
        elif not self._announced:
            self._outbox.emit(Mapped(self._family, address, server))
        self._announced = True
        self._preferred = server
        self._failed_rounds = 0
        self._end_round(now, self._config.refresh_s)

    def _start_round(self, now: float) -> None:
        self._next_round = None
        self._transactions.clear()
        self._reason = ""
        # The sort is stable: the other servers keep the configured order behind the preferred one.
        self._waiting = deque(sorted(self.servers, key=lambda server: server != self._preferred))
        self._ask_next_server(now)

    def _ask_next_server(self, now: float) -> None:
        transaction_id = self._rng.randbytes(TRANSACTION_ID_BYTES)
        transaction = StunTransaction(
            self._waiting.popleft(), transaction_id, self._software, self._config.retransmission, now
        )
        transaction.handle_timer(now)
        self._transactions.append(transaction)
        self._outbox.send(transaction)
        self._next_server = now + self._config.stagger_s if self._waiting else None

    def _give_up(self, transaction: StunTransaction, reason: str, now: float) -> None:
        self._transactions.remove(transaction)
        self._reason = reason
        if self._waiting:
            self._ask_next_server(now)
        elif not self._transactions:
            self.problem = self._reason
            self._outbox.emit(Failed(self._family, self._reason, self.mapping))
            self._announced = False
            wait_s = min(self._config.retry_s * 2.0**self._failed_rounds, self._config.max_retry_s)
            # Capped: without it the power would overflow a float after a week of failures.
            self._failed_rounds = min(self._failed_rounds + 1, 32)
            self._end_round(now, wait_s)

    def _end_round(self, now: float, wait_s: float) -> None:
        self._transactions.clear()
        self._waiting.clear()
        self._next_server = None
        self._next_round = now + wait_s * self._rng.uniform(1 - self._config.jitter, 1 + self._config.jitter)


def _is_usable(address: Address) -> bool:
    """Return whether a peer could send to it at all; a server's word is not enough."""
    ip = ip_address(address[0])
    return address[1] != 0 and not ip.is_unspecified and not ip.is_multicast


def _text(address: Address) -> str:
    host, port = address
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
