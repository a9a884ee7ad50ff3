"""A network for the STUN client in simulated time."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING

from plr.protos.stun.codec import MessageClass, StunMessage, decode, encode
from plr.sidecar.core.stun.client import StunClient

if TYPE_CHECKING:
    from plr.sidecar.core.stun.events import StunEvent
    from plr.sidecar.core.stun.family import StunClientConfig

A = ("192.0.2.1", 3478)
B = ("192.0.2.2", 3478)
C6 = ("2001:db8::3", 3478)
OUTSIDE = ("203.0.113.5", 61000)
MOVED = ("203.0.113.5", 61001)
OUTSIDE6 = ("2001:db8:ffff::5", 61000)

Address = tuple[str, int]


class Network:
    """Drives a client in simulated time; servers in `answers` reply with that address after `delay_s`."""

    def __init__(self, client: StunClient, answers: dict[Address, Address], delay_s: float = 0.05) -> None:
        self.client = client
        self.answers = answers
        self.delay_s = delay_s
        self.now = 100.0
        self.sent: list[tuple[float, bytes, Address]] = []
        self.events: list[tuple[float, StunEvent]] = []
        self._arriving: list[tuple[float, bytes, Address]] = []
        client.start(self.now)
        self._pump()

    def run(self, seconds: float) -> list[StunEvent]:
        """Let time pass; the events of that time."""
        end = self.now + seconds
        first = len(self.events)
        self._pump()
        while True:
            due = [t for t in (self.client.next_timer(), *(a[0] for a in self._arriving)) if t is not None]
            following = min(due, default=end)
            if following > end:
                break
            self.now = max(self.now, following)
            for arrival in [a for a in self._arriving if a[0] <= self.now]:
                self._arriving.remove(arrival)
                assert self.client.receive_datagram(arrival[1], arrival[2], self.now)
            self.client.handle_timer(self.now)
            self._pump()
        self.now = end
        return [event for _, event in self.events[first:]]

    def times_sent_to(self, server: Address) -> list[float]:
        return [round(when - 100.0, 6) for when, _, address in self.sent if address == server]

    def _pump(self) -> None:
        for data, server in self.client.datagrams_to_send():
            self.sent.append((self.now, data, server))
            if server in self.answers:
                self._arriving.append((self.now + self.delay_s, reply(data, self.answers[server]), server))
        while (event := self.client.next_event()) is not None:
            self.events.append((self.now, event))


def reply(request: bytes, address: Address) -> bytes:
    asked = decode(request)
    assert asked.message_class is MessageClass.REQUEST
    return encode(StunMessage(MessageClass.SUCCESS, asked.transaction_id, xor_mapped_address=address, fingerprint=True))


def refusal(request: bytes, code: int = 500) -> bytes:
    return encode(StunMessage(MessageClass.ERROR, decode(request).transaction_id, error_code=code, error_reason="Busy"))


def make(*servers: Address, seed: int = 1, config: StunClientConfig | None = None) -> StunClient:
    return StunClient(servers, random.Random(seed), config)


def start(client: StunClient, now: float = 0.0) -> bytes:
    """Start a client of one server; its request."""
    client.start(now)
    ((request, _),) = client.datagrams_to_send()
    return request
