"""Remembers where the peer of one path introduced itself from, and which introductions wait for their answer."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.core.path.congestion.rtt import LONGEST_ANSWER_S

if TYPE_CHECKING:
    from plr.protos.model.ids import Address
    from plr.sidecar.core.wire.frame import KeyAnswer

MAX_INTRODUCTIONS = 4
"""Introductions on one path that wait for their answer; an honest peer repeats its own."""
INTRODUCER_S = 5.0
"""How long a peer that introduced itself twice from an address may still be found there."""


class Waiting(NamedTuple):
    """An introduction that waits for its answer."""

    source: Address
    probe_id: int
    answer: KeyAnswer | None
    """The answer to its offer of keys."""


class Introductions:
    """Introductions that came over one path."""

    __slots__ = ("_at", "_source", "waiting")

    def __init__(self) -> None:
        self.waiting: list[Waiting] = []
        self._at = -NEVER
        self._source: Address | None = None

    @property
    def is_full(self) -> bool:
        """Whether so many wait that a further one is dropped."""
        return len(self.waiting) >= MAX_INTRODUCTIONS

    def note(self, source: Address, probe_id: int, answer: KeyAnswer | None) -> None:
        """Keep an introduction from `source` until it is answered there."""
        self.waiting.append(Waiting(source, probe_id, answer))

    def take(self) -> list[Waiting]:
        """Remove and return those that wait."""
        taken, self.waiting = self.waiting, []
        return taken

    def found_down(self, source: Address, now: float) -> None:
        """Note that an introduction from `source` found the path down.

        A peer that repeats it although it was answered cannot read the answer: it does not know yet that we restarted.
        Behind a NAT it may be reachable there only, so our own introduction has to go there too.
        """
        again = now < self._at + INTRODUCER_S
        self._source, self._at = source if again else None, now

    def introducer(self, now: float) -> Address | None:
        """Return the address at which the peer may be because it introduced itself from there more than once."""
        return self._source if now < self._at + INTRODUCER_S else None

    def awaits_proof(self, now: float) -> bool:
        """Return whether an introduction that found the path down may still lead to an answer that brings it up."""
        return now < self._at + LONGEST_ANSWER_S

    def forget_introducer(self) -> None:
        """Forget where the peer introduced itself from: the path is up."""
        self._at, self._source = -NEVER, None
