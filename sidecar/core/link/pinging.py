"""Runs the pings of one link: probes that somebody on this host asked for, to see how long a path takes.

A ping is a PROBE, padded to the requested size, so a peer of any version answers it. Its answer goes to the one who
asked and to nobody else: it is no sample of the round-trip time, proves no life and plans no probe. So a curious user
changes nothing of what the path is believed to be. The budget is the link's, not the user's.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.protos.base.token_bucket import TokenBucket
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.crypto.aead import TAG_BYTES
from plr.sidecar.core.path.congestion.rtt import LONGEST_ANSWER_S
from plr.sidecar.core.path.probing import SentPing
from plr.sidecar.core.wire.frame import HEADER_BYTES

if TYPE_CHECKING:
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.path.path import Path
    from plr.sidecar.core.seam.links import Ping

PINGS_PER_S = 20.0
"""Rate of one link, however many ask: some 30 kB a second of the longest that Ethernet carries, ..."""
PINGS_AT_ONCE = 40.0
"""... and its burst."""
COST_BYTES = 1500
"""A longer ping counts as several."""
MAX_PINGS_OUT = 64
"""Unanswered pings of one link that are remembered; the oldest goes first."""
LEAST_BYTES = HEADER_BYTES + 9 + TAG_BYTES
"""Size of a PROBE without padding: 45 bytes of UDP payload."""


@dataclass(frozen=True, slots=True)
class Pong:
    """Result of a ping."""

    number: int
    """Number of the ping."""
    path: PathId
    rtt_s: float = 0.0
    """From the datagram that left to the one that came, in seconds; 0 with a problem."""
    problem: str = ""
    """Why it was not sent; empty if it was answered."""


class Pings:
    """Outstanding pings, and results."""

    __slots__ = ("_budget", "_out", "done")

    def __init__(self) -> None:
        self._budget: TokenBucket | None = None
        self._out: dict[int, SentPing] = {}
        self.done: deque[Pong] = deque()
        """For the driver, oldest first; at most one for each ping."""

    def ask(self, path: Path | None, ping: Ping, now: float) -> bool:
        """Take a ping; return whether it leaves over `path` (None: there is no such path)."""
        problem = "there is no such path" if path is None else self._problem(path, ping, now)
        if problem or path is None:
            self.done.append(Pong(ping.number, ping.path, problem=problem))
            return False
        self._forget_old(now)
        sent = SentPing(path.probing.take_id(), ping.number, path.id, max(ping.size, LEAST_BYTES))
        self._out[sent.id] = sent
        path.ping(sent)
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
        """Take a PROBE_REPLY that came over `path`; return False if it answers no ping."""
        sent = self._out.get(probe_id)
        if sent is None or sent.path != path.id or sent.sent_at is None:
            return False
        del self._out[probe_id]
        self.done.append(Pong(sent.number, sent.path, max(0.0, now - sent.sent_at)))
        return True
