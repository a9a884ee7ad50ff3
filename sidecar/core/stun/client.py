"""Learns the server-reflexive addresses of one local UDP socket by STUN (RFC 8489 Binding). Sans-IO.

IPv4 and IPv6 are learned independently. Within a family one server is asked; when it is slow the next one is
asked as well, and the first answer wins. The server that answered stays the preferred one, so that a NAT with
destination-dependent mappings does not look like one that changes its mapping. A mapping is refreshed, and a
failed round repeated with backoff, without end.
"""

from __future__ import annotations

from collections import Counter
from ipaddress import ip_address
from typing import TYPE_CHECKING, NamedTuple

from plr.protos.base.errors import DecodeError
from plr.protos.stun.codec import MessageClass, decode, is_stun
from plr.sidecar.core.stun.events import StunDrop
from plr.sidecar.core.stun.family import StunClientConfig, StunFamilyClient, StunOutbox

if TYPE_CHECKING:
    import random
    from collections.abc import Iterable

    from plr.protos.model.ids import Address
    from plr.sidecar.core.stun.events import StunEvent

MAX_SERVERS_PER_FAMILY = 4
"""Servers used of those that a control plane names; the others are ignored and counted."""


class StunView(NamedTuple):
    """What is known about one family at one moment."""

    family: int
    mapping: Address | None
    server: Address | None
    """The server that answered last."""
    answered_at: float | None
    """When it answered (monotonic, s)."""
    changes: int
    """Number of times the mapping changed."""
    problem: str
    """Why the last round failed; empty if it did not."""


class StunClient:
    """Learns the server-reflexive address of one socket, per family.

    `servers` are numeric addresses in canonical form, asked in order; a host name raises ValueError.
    `rng` draws transaction ids: pass random.SystemRandom outside tests, since only the id keeps strangers
    from forging answers. STUN datagrams that are not believed are counted in `drops`, by StunDrop.
    """

    def __init__(
        self,
        servers: Iterable[Address],
        rng: random.Random,
        config: StunClientConfig | None = None,
        *,
        software: str | None = None,
        drops: Counter[str] | None = None,
    ) -> None:
        self._rng = rng
        self._config = config or StunClientConfig()
        self._software = software
        self._families: dict[int, StunFamilyClient] = {}
        self._outbox = StunOutbox(Counter() if drops is None else drops)
        self.servers_ignored = 0
        self._set_servers(servers)

    @property
    def drops(self) -> Counter[str]:
        """Return the number of STUN datagrams not believed, by StunDrop."""
        return self._outbox.drops

    @property
    def requests_sent(self) -> int:
        """Return the number of requests handed out for sending, including retransmissions."""
        return self._outbox.requests_sent

    @property
    def events_lost(self) -> int:
        """Return the number of events dropped because the driver did not fetch them."""
        return self._outbox.events_lost

    def set_servers(self, servers: Iterable[Address], now: float) -> None:
        """Ask these servers from now on; families whose servers stay the same are left undisturbed."""
        before = {family: client.servers for family, client in self._families.items()}
        self._set_servers(servers)
        for family, client in self._families.items():
            if before.get(family) != client.servers:
                client.start(now)

    def start(self, now: float) -> None:
        """Ask at once; call it also when the interface's address or link has changed.

        The answer is reported as an event even if it is the same as before.
        """
        for client in self._families.values():
            client.start(now)

    def mapping(self, family: int) -> Address | None:
        """Return the mapping last learned for family 4 or 6."""
        client = self._families.get(family)
        return client.mapping if client else None

    def views(self) -> list[StunView]:
        """Return what is known about each family; any thread may ask."""
        return [
            StunView(family, one.mapping, one.preferred, one.answered_at, one.changes, one.problem)
            for family, one in list(self._families.items())
        ]

    def receive_datagram(self, data: bytes | memoryview, addr: Address, now: float) -> bool:
        """Take a datagram of the socket; return True if it was STUN, believed or counted."""
        if not is_stun(data):
            return False
        try:
            message = decode(data)
        except DecodeError:
            self._outbox.drops[StunDrop.MALFORMED] += 1
            return True
        if message.message_class not in (MessageClass.SUCCESS, MessageClass.ERROR):
            self._outbox.drops[StunDrop.NOT_A_RESPONSE] += 1
            return True
        for client in self._families.values():
            transaction = client.find(message.transaction_id)
            if transaction is not None:
                client.handle_response(transaction, message, addr, now)
                return True
        self._outbox.drops[StunDrop.UNKNOWN_TRANSACTION] += 1
        return True

    def handle_timer(self, now: float) -> None:
        """Do what is due; call it at next_timer()."""
        for client in self._families.values():
            client.handle_timer(now)

    def next_timer(self) -> float | None:
        """Return when to call handle_timer; None before start or without servers."""
        return min((t for c in self._families.values() if (t := c.next_timer()) is not None), default=None)

    def datagrams_to_send(self) -> list[tuple[bytes, Address]]:
        """Take the datagrams to send over the socket now."""
        sending, self._outbox.sending = self._outbox.sending, []
        return sending

    def next_event(self) -> StunEvent | None:
        """Take the oldest event."""
        events = self._outbox.events
        return events.popleft() if events else None

    def _set_servers(self, servers: Iterable[Address]) -> None:
        by_family: dict[int, list[Address]] = {}
        for server in dict.fromkeys(servers):
            listed = by_family.setdefault(ip_address(server[0]).version, [])
            if len(listed) < MAX_SERVERS_PER_FAMILY:
                listed.append(server)
            else:
                self.servers_ignored += 1
        for family in self._families.keys() - by_family.keys():
            del self._families[family]
        for family, listed in by_family.items():
            client = self._families.get(family)
            if client is None:
                self._families[family] = StunFamilyClient(
                    family, tuple(listed), self._outbox, self._rng, self._config, self._software
                )
            elif set(client.servers) != set(listed):
                client.servers = tuple(listed)
