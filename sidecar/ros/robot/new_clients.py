"""Keeps answers to clients that DDS has only half discovered.

A client's request may arrive before this side knows where its answers go: its writer is matched, but its reader is not.
rmw waits 0.1 s for that on the calling thread, then gives up. On a busy computer discovery takes longer. So the answer
is kept, later ones to the same client queue behind it, and it is tried again until the client is known.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Generic, TypeVar

FIRST_RETRY_S = 0.1
MAX_RETRY_S = 1.0
"""Longest interval between tries of one client, doubling from the first ..."""
REST_S = 0.2
"""... and the interval between tries of any clients: each may cost the ROS thread 0.1 s."""
GIVE_UP_S = 10.0
"""A client still unknown this long after its answer was ready is gone, or will never hear us."""
MAX_KEPT_ANSWERS = 4096
"""Answers kept for all clients together."""

T = TypeVar("T")


@dataclass(slots=True)
class _Client(Generic[T]):
    gives_up_at: float
    retry_at: float
    retry_s: float = FIRST_RETRY_S
    answers: deque[T] = field(default_factory=deque)


class NewClients(Generic[T]):
    """Waiting answers by client (writer guid)."""

    __slots__ = ("_clients", "_rests_until", "kept")

    def __init__(self) -> None:
        self._clients: dict[bytes, _Client[T]] = {}
        self._rests_until = 0.0
        self.kept = 0

    def waits(self, client: bytes) -> bool:
        """Return whether answers to this client wait: a further one must not be tried before them."""
        return client in self._clients

    def keep(self, client: bytes, answer: T, now: float) -> bool:
        """Keep an answer to a client that is not known yet; return False when there is no room."""
        if self.kept >= MAX_KEPT_ANSWERS:
            return False
        state = self._clients.get(client)
        if state is None:
            state = self._clients[client] = _Client(now + GIVE_UP_S, now + FIRST_RETRY_S)
            self._rests_until = now + REST_S
        state.answers.append(answer)
        self.kept += 1
        return True

    def next_due(self) -> float | None:
        """Return when `take_due` has something to give, or None."""
        if not self._clients:
            return None
        return max(self._rests_until, min(state.retry_at for state in self._clients.values()))

    def take_due(self, now: float) -> tuple[bytes, T] | None:
        """Return the client to try now and its oldest answer; the caller reports the result by `known` or `unknown`."""
        if now < self._rests_until or not self._clients:
            return None
        client, state = min(self._clients.items(), key=lambda one: one[1].retry_at)
        return (client, state.answers[0]) if state.retry_at <= now else None

    def known(self, client: bytes) -> list[T]:
        """Note that the oldest answer was sent; return the others, which may go as well."""
        answers = self._clients.pop(client).answers
        self.kept -= len(answers)
        answers.popleft()
        return list(answers)

    def unknown(self, client: bytes, now: float) -> list[T]:
        """Note that it was not sent; return the answers that are given up."""
        state = self._clients[client]
        self._rests_until = now + REST_S
        if now < state.gives_up_at:
            state.retry_s = min(2 * state.retry_s, MAX_RETRY_S)
            state.retry_at = now + state.retry_s
            return []
        del self._clients[client]
        self.kept -= len(state.answers)
        return list(state.answers)
