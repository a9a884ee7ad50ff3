"""Pings of one link: probes that somebody on this host asked for, to see how long a path takes.

A ping is a PROBE, padded to the size that was asked for, so that a peer of any version answers it. Its answer is told
to who asked and to nobody else: it is no sample of the round-trip time, proves no life and plans no probe, so that what
a curious user does changes nothing of what the path is believed to be. The budget is the link's, not the user's.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from protos.base.token_bucket import TokenBucket
from sidecar.core.base.values import PathState
from sidecar.core.crypto.aead import TAG_BYTES
from sidecar.core.path.congestion.rtt import LONGEST_ANSWER_S
from sidecar.core.path.probing import SentPing
from sidecar.core.wire.frame import HEADER_BYTES

if TYPE_CHECKING:
    from sidecar.core.base.values import PathId
    from sidecar.core.path.path import Path
    from sidecar.core.seam.links import Ping

PINGS_PER_S = 20.0
"""Of one link, however many ask: some 30 kB a second of the longest that Ethernet carries, ..."""
PINGS_AT_ONCE = 40.0
"""... and so many at once."""
COST_BYTES = 1500
"""A longer one counts as several."""
MAX_PINGS_OUT = 64
"""Unanswered pings of one link that are remembered; the oldest goes first."""
LEAST_BYTES = HEADER_BYTES + 9 + TAG_BYTES
"""A PROBE without padding: 45 bytes of UDP payload."""


@dataclass(frozen=True, slots=True)
class Pong:
    """What became of a ping."""

    number: int
    """Of the ping."""
    path: PathId
    rtt_s: float = 0.0
    """From the datagram that left to the one that came, in seconds; 0 with a problem."""
    problem: str = ""
    """Why it was not sent; empty: it was answered."""


class Pings:
    """Which pings are out, and what became of them."""

    __slots__ = ("_budget", "_out", "done")

    def __init__(self) -> None:
        self._budget: TokenBucket | None = None
        self._out: dict[int, SentPing] = {}
        self.done: deque[Pong] = deque()
        """For the driver, oldest first: one for each ping at most."""

    def ask(self, path: Path | None, ping: Ping, now: float) -> bool:
        """Take a ping; whether it leaves over `path` (None: there is no such path)."""
        problem = "there is no such path" if path is None else self._problem(path, ping, now)
        if problem or path is None:
            self.done.append(Pong(ping.number, ping.path, problem=problem))
            return False
        self._forget_old(now)
        sent = SentPing(path.probing.take_id(), ping.number, path.id, max(ping.size, LEAST_BYTES))
        self._out[sent.id] = sent
        path.pings.append(sent)
        return True

    def _problem(self, path: Path, ping: Ping, now: float) -> str:
        if path.state is PathState.DOWN or path.remote is None:
            return "the path is down"
        if not path.address.is_proven:
            return "the peer has just moved: its new address is not proven yet"
        if ping.size > path.mtu.size:
            return f"the path is known to carry {path.mtu.size} bytes at most"
        if self._budget is None:
            self._budget = TokenBucket(rate=PINGS_PER_S, burst=PINGS_AT_ONCE, now=now)
        if not self._budget.take(now, max(1.0, ping.size / COST_BYTES)):
            return f"too many pings: the interface sends {PINGS_PER_S:.0f} a second"
        return ""

    def _forget_old(self, now: float) -> None:
        while self._out:
            oldest = next(iter(self._out.values()))
            if len(self._out) < MAX_PINGS_OUT and (oldest.sent_at is None or oldest.sent_at > now - LONGEST_ANSWER_S):
                break
            del self._out[oldest.id]

    def answered(self, path: Path, probe_id: int, now: float) -> bool:
        """A PROBE_REPLY came over `path`; False when it answers no ping."""
        sent = self._out.get(probe_id)
        if sent is None or sent.path != path.id or sent.sent_at is None:
            return False
        del self._out[probe_id]
        self.done.append(Pong(sent.number, sent.path, max(0.0, now - sent.sent_at)))
        return True
