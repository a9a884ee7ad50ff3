"""Paces the answers to each client, so that an ordinary client can keep up.

A ROS client with the default profile keeps the last 10 unread answers; the 11th pushes out the first, and that call
never returns. After an outage the network hands over many answers at once. So each client gets a few at once and the
rest spaced (docs/develop/adr/0008). A client that makes one request at a time is never held back: each request earns it
an answer.

Of the answers held back, those in time go before late ones: requests made before an outage do not delay the answers to
those made after it. Late ones are spaced wider, as they come in great numbers and are not urgent: a client held up by
a busy machine loses none.

This makes losses rare, not impossible: there is no way to ask how many answers lie unread.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Generic, TypeVar

BURST_ANSWERS = 8
"""Below rmw's default depth of 10, so that a few answers may still lie unread."""
SPACING_S = 0.002
"""Ten times what an rclpy client spends on an answer (0.15 to 0.3 ms): it may be held up for 20 ms without losses."""
LATE_COST = 5.0
"""Cost of a late answer, in answers in time: one goes every 10 ms, so a client may be held up for nearly 100 ms."""
MAX_CLIENTS = 1024
"""Clients remembered; the one quiet for longest is forgotten, and starts again with a full allowance."""

_ROUNDING = 1e-6  # of an allowance: at the time `next_due` names, the answer is due

T = TypeVar("T")


@dataclass(slots=True)
class _Client(Generic[T]):
    tokens: float
    updated_at: float
    in_time: deque[T] = field(default_factory=deque)
    late: deque[T] = field(default_factory=deque)

    def next_waiting(self) -> deque[T]:
        """Return the queue whose turn it is; it is empty when nothing waits."""
        return self.in_time or self.late


class ReplyPacer(Generic[T]):
    """A token bucket per client (writer guid). Holds no more answers than there are requests pending."""

    __slots__ = ("_burst", "_clients", "_late_cost", "_spacing_s", "_waiting", "queued")

    def __init__(self, burst: int = BURST_ANSWERS, spacing_s: float = SPACING_S) -> None:
        self._burst = float(burst)
        self._late_cost = min(LATE_COST, self._burst)
        self._spacing_s = spacing_s
        self._clients: dict[bytes, _Client[T]] = {}
        self._waiting: dict[bytes, _Client[T]] = {}
        self.queued = 0

    def request_taken(self, client: bytes, now: float) -> None:
        """Note that a request of `client` arrived, which earns it one answer without a wait."""
        state = self._refreshed(client, now)
        state.tokens = min(self._burst, state.tokens + 1.0)

    def admit(self, client: bytes, reply: T, now: float, *, late: bool) -> bool:
        """Return True if `reply` may go now; otherwise keep it for `take_due`."""
        state = self._refreshed(client, now)
        cost = self._late_cost if late else 1.0
        if state.tokens < cost or state.in_time or (late and state.late):
            (state.late if late else state.in_time).append(reply)
            self._waiting[client] = state
            self.queued += 1
            return False
        state.tokens -= cost
        return True

    def take_due(self, now: float) -> list[T]:
        """Return the kept answers that are due; for each client those in time first, each kind oldest first."""
        due: list[T] = []
        for client in list(self._waiting):
            state = self._refreshed(client, now)
            while (waiting := state.next_waiting()) and state.tokens >= (cost := self._cost_of_next(state)) - _ROUNDING:
                state.tokens -= cost
                due.append(waiting.popleft())
            if not state.next_waiting():
                del self._waiting[client]
        self.queued -= len(due)
        return due

    def next_due(self) -> float | None:
        """Return when `take_due` has something to give, or None."""
        if not self._waiting:
            return None
        return min(
            state.updated_at + max(0.0, self._cost_of_next(state) - state.tokens) * self._spacing_s
            for state in self._waiting.values()
        )

    def _cost_of_next(self, state: _Client[T]) -> float:
        return 1.0 if state.in_time else self._late_cost

    def _refreshed(self, client: bytes, now: float) -> _Client[T]:
        state = self._clients.pop(client, None)  # moved to the end: the first is the one quiet for longest
        if state is None:
            state = _Client(self._burst, now)
            if len(self._clients) >= MAX_CLIENTS:
                self._forget_quietest()
        self._clients[client] = state
        if now > state.updated_at:
            state.tokens = min(self._burst, state.tokens + (now - state.updated_at) / self._spacing_s)
            state.updated_at = now
        return state

    def _forget_quietest(self) -> None:
        for client, state in self._clients.items():
            if not state.next_waiting():
                del self._clients[client]
                return
