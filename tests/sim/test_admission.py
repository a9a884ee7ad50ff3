"""A fleet at the gate of a control plane that lets in so many a second and no more: real sessions, simulated time."""

from __future__ import annotations

import heapq
import random
from collections import deque
from dataclasses import dataclass
from itertools import count
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.core.overload.admission import Admission
from plr.controlplane.core.overload.pacing import Pacing
from plr.controlplane.serve import tls_gate
from plr.protos.model.ids import PROTOCOL_VERSION, NodeName, Role, SessionId
from plr.protos.model.members import Registration
from plr.protos.model.stream import Welcome
from plr.sidecar.core.control.session import ControlSession, ControlState

if TYPE_CHECKING:
    from collections.abc import Callable

RATE = 100.0
"""Registrations a second that the server can do."""

HANDSHAKE_PART = 0.35
"""Of the work of one registration; a handshake that a stranger begins costs as much."""

ROUND_TRIP_S = 0.05
GIVE_UP_S = 5.0
"""After which a stranger's handshake is ended."""


@dataclass(eq=False)
class Attempt:
    """One connection of a client, or of a stranger."""

    client: int | None
    gone: bool = False


class World:
    """Clients behind one NAT, one server with one processor; strangers at another address."""

    def __init__(self, clients: int, seed: int = 1) -> None:
        self.now = 0.0
        self.wasted = 0
        """Handshakes done for clients that did not wait for their end."""
        self.sessions = [ControlSession(_registration(n), random.Random(seed * 100_000 + n)) for n in range(clients)]
        self.registered_at: list[float] = []
        self.up = True
        self._attempts: dict[int, Attempt] = {}
        self._gate: Admission[Attempt] = Admission(
            most_waiting=tls_gate.MAX_WAITING_CONNECTIONS,
            most_on_the_way=tls_gate.MAX_ON_THE_WAY,
            stranger_s=tls_gate.ON_THE_WAY_S,
            member_s=tls_gate.HANDSHAKE_TIMEOUT_S,
        )
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._number = count()
        self._work: deque[tuple[Attempt, float, Callable[[], None]]] = deque()
        self._working = False
        self._again_at = 0.0

    def at(self, when: float, what: Callable[[], None]) -> None:
        heapq.heappush(self._events, (when, next(self._number), what))

    def run(self, until: float) -> None:
        """Until then, or until all are in."""
        while self._events and self._events[0][0] <= until and len(self.registered_at) < len(self.sessions):
            self.now, _, what = heapq.heappop(self._events)
            what()

    # ── clients ──

    def start(self, client: int) -> None:
        session = self.sessions[client]
        session.opened(self.now)
        if not self.up:
            self.at(self.now + session.closed(self.now), lambda: self.start(client))
            return
        attempt = self._attempts[client] = Attempt(client)
        self.at(self.now + ROUND_TRIP_S, lambda: self._arrive(attempt, "fleet"))
        self.at(session.next_timer(), lambda: self._overdue(client, attempt))

    def _overdue(self, client: int, attempt: Attempt) -> None:
        session = self.sessions[client]
        if not attempt.gone and self._attempts[client] is attempt and session.welcome_overdue(self.now):
            self._leave(attempt)
            self.at(self.now + session.closed(self.now), lambda: self.start(client))

    def _leave(self, attempt: Attempt) -> None:
        attempt.gone = True
        self._gate.leave(attempt)
        self._gate.over(attempt, None if attempt.client is None else str(attempt.client))

    def attack(self, rate: float, until: float) -> None:
        """A ClientHello each 1/rate seconds from one address, with nothing after it."""
        stranger = Attempt(None)
        self._arrive(stranger, "stranger")
        self.at(self.now + GIVE_UP_S, lambda: self._leave(stranger))
        if self.now < until:
            self.at(self.now + 1.0 / rate, lambda: self.attack(rate, until))

    # ── the server ──

    def _arrive(self, attempt: Attempt, source: str) -> None:
        if attempt.gone:
            return
        pushed_out = self._gate.wait(attempt, source)
        if pushed_out is not None and pushed_out.client is not None:
            pushed_out.gone = True
            client = pushed_out.client
            self.at(self.now + self.sessions[client].closed(self.now), lambda: self.start(client))
        self._turn()

    def _turn(self) -> None:
        while (attempt := self._gate.next(self.now)) is not None:
            self._do(attempt, HANDSHAKE_PART, lambda attempt=attempt: self._shaken(attempt))  # type: ignore[misc]
        again_at = self._gate.next_at()
        if again_at is not None and not self.now < self._again_at <= again_at:
            self._again_at = again_at
            self.at(again_at, self._turn)

    def _do(self, attempt: Attempt, part: float, then: Callable[[], None]) -> None:
        self._work.append((attempt, part, then))
        if not self._working:
            self._next_work()

    def _next_work(self) -> None:
        self._working = False
        while self._work:
            attempt, part, then = self._work.popleft()
            if attempt.gone:
                self.wasted += part != HANDSHAKE_PART
                continue
            self._working = True

            def done(then: Callable[[], None] = then) -> None:
                then()
                self._next_work()

            self.at(self.now + part / RATE, done)
            return

    def _shaken(self, attempt: Attempt) -> None:
        if attempt.client is None or attempt.gone:
            return
        self._gate.proven(attempt, str(attempt.client), self.now)
        register = 1.0 - HANDSHAKE_PART
        self.at(self.now + ROUND_TRIP_S, lambda: self._do(attempt, register, lambda: self._register(attempt)))

    def _register(self, attempt: Attempt) -> None:
        if attempt.gone or attempt.client is None:
            return
        self._gate.over(attempt, str(attempt.client))
        self.sessions[attempt.client].receive(_welcome(len(self.sessions)), self.now)
        attempt.gone = True  # its timer has no meaning any more
        self.registered_at.append(self.now)
        self._turn()


def _registration(number: int) -> Registration:
    return Registration(
        protocol_version=PROTOCOL_VERSION,
        name=NodeName(f"robot-{number}"),
        role=Role.ROBOT,
        session=SessionId(number),
        token=bytes(16),
        incarnation=1,
        software_version="test",
        credential=b"",
    )


def _welcome(clients: int) -> Welcome:
    pacing = Pacing(interval_s=0.5, lease_s=3.0)
    pacing.follow(clients, 0.0)
    return Welcome(lease_s=pacing.lease_s, report_interval_s=pacing.interval_s, reconnect_max_s=pacing.reconnect_max_s)


def held(world: World, began: float, capacity: float = 1.0) -> None:
    """All are in within 1.5 times of what the work takes, and the server was of use nearly all the time."""
    clients = len(world.sessions)
    assert len(world.registered_at) == clients
    assert all(session.state is ControlState.ONLINE for session in world.sessions)
    assert world.registered_at[-1] - began <= 1.5 * clients / (RATE * capacity)
    # While far more come than it can let in: the last tenth is spread by its backoff.
    busy = world.registered_at[: int(0.9 * clients)]
    assert len(busy) / (busy[-1] - began) >= 0.8 * RATE * capacity
    assert world.wasted <= 0.05 * clients


@pytest.mark.audit("ops-16")
@pytest.mark.parametrize("clients", [500, 4000])
def test_a_fleet_that_starts_at_once_gets_in_as_fast_as_the_server_can(clients: int) -> None:
    """Its sidecars have never been told anything: each gives up after five seconds."""
    world = World(clients)
    for client in range(clients):
        world.at(0.0, lambda client=client: world.start(client))  # type: ignore[misc]
    world.run(1000.0)
    held(world, 0.0)


@pytest.mark.audit("ops-16")
def test_a_fleet_comes_back_after_a_restart_as_fast_as_the_server_can() -> None:
    clients, down_s = 2000, 3.0
    world = World(clients)
    for client, session in enumerate(world.sessions):
        session.opened(-100.0)
        session.receive(_welcome(clients), -99.0)
        world.at(session.closed(0.0), lambda client=client: world.start(client))  # type: ignore[misc]
    world.up = False
    world.at(down_s, lambda: setattr(world, "up", True))
    world.run(1000.0)
    held(world, down_s)


@pytest.mark.audit("ops-16")
def test_who_sends_ten_client_hellos_for_each_that_the_server_can_serve_keeps_no_fleet_out() -> None:
    clients = 1000
    world = World(clients)
    world.at(0.0, lambda: world.attack(10 * RATE, 60.0))
    for client in range(clients):
        world.at(1.0, lambda client=client: world.start(client))  # type: ignore[misc]
    world.run(1000.0)
    # Every other turn is the stranger's, and he keeps his place on the way for a second.
    assert len(world.registered_at) == clients
    assert world.registered_at[-1] <= 1.0 + 1.5 * clients / (0.5 * RATE)
    assert world.wasted <= 0.05 * clients
