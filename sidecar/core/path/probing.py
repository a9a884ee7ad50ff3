"""When one path is probed, and which of its probes may still be answered.

A path in use is probed twice a second. One that rests is probed ever less often, so that a thousand robots that ask for
nothing cost a server next to nothing, but never so rarely that a NAT forgets it. One end leads: the robot, whose NAT it
is. The other end asks in the datagram with which it answers, and by itself only when it was not asked for long.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from sidecar.core.path.congestion.rtt import LONGEST_ANSWER_S

if TYPE_CHECKING:
    import random

    from protos.model.ids import Address
    from sidecar.core.base.values import PathId

IDLE_PROBE_S = 0.5
"""A path that was in use a moment ago is probed this often, which finds a dead one within a second, ..."""
IDLE_SHARE = 8.0
"""... one that rests as often as this fits into the time that it has rested, ..."""
MAX_IDLE_PROBE_S = 15.0
"""... and no path less often. RFC 4787 asks NATs to remember for 2 minutes; those of mobile networks forget after 30 s
at times, which leaves room for a probe that gets lost."""
IDLE_SPREAD = 0.2
"""Share of that by which it comes sooner or later: the paths of many robots that began together drift apart."""
WATCH_FACTOR = 2.5
"""The end that does not lead asks by itself when it was not asked for so many times as long as usual."""
FIRST_PROBE_S = 0.05
"""Probes to a path that is not up start this close together ..."""
MAX_PROBE_S = 1.0
"""... and back off to this, so that a path that comes back is seen within a second, ..."""
MAX_WATCH_PROBE_S = 15.0
"""... or to this at the end that does not lead: a thousand robots that are out of reach must not keep it busy."""
FREE_ADDRESSES = 16
"""A peer that announces more addresses has all of them probed that much less often until they answer: it gets no more
datagrams out of us, wherever they lead."""
PROBE_BACKOFF = 1.5
RETURN_BACKOFF = 1.02
"""A path that was up is likely to come back, and requests may wait for it: its probes are as far apart as a fiftieth of
the time that it is down, 0.25 s after ten seconds. Both ends probe, so that the wait is mostly half of that or less."""
DOWN_SPREAD = 0.1
"""As IDLE_SPREAD, for a path that is not up."""
MAX_PROBES_OUT = 1024
"""Unanswered probes of either kind that are remembered: those of LONGEST_ANSWER_S, no two within FIRST_PROBE_S, to some
addresses each."""


class Probe(NamedTuple):
    """One that was answered."""

    sent_at: float
    to: Address | None
    """Where it went, and nowhere else: so the peer is there."""
    sealed: bool
    """With this path's keys, so that the answer confirms those."""


@dataclass(slots=True)
class SentPing:
    """One that waits to leave, or for its answer."""

    id: int
    """Of its PROBE."""
    number: int
    path: PathId
    size: int
    """Of its datagram: bytes of UDP payload."""
    sent_at: float | None = None


class Probing:
    """The plan of one path's probes, and the memory of them. Times in seconds."""

    __slots__ = ("_asked_at", "_asked_every", "_back", "_gap", "_leads", "_out", "_proven_at", "_rng", "_used_at",
                 "_was_up", "at", "crowd", "last_at")  # fmt: skip

    def __init__(self, now: float, rng: random.Random, *, leads: bool) -> None:
        """`rng` must be one that nobody can foresee: who guesses an id could answer what he did not get."""
        self._rng = rng
        self.at = now
        """When the next one leaves."""
        self.last_at = now - FIRST_PROBE_S
        """When the last one left."""
        self.crowd = 0
        """How many addresses the peer announced, over all its interfaces."""
        self._leads = leads
        self._gap = FIRST_PROBE_S
        self._was_up = False
        self._used_at = now
        self._proven_at = now
        self._asked_at = now
        self._asked_every = MAX_IDLE_PROBE_S
        """How often the peer asks."""
        self._out: dict[int, Probe] = {}
        """What was asked by plan, the oldest first."""
        self._back: dict[int, Probe] = {}
        """What was asked of introductions. Apart, since whoever repeats those makes us ask as often."""

    # -- looking at it -----------------------------------------------------------------------------------------------

    @property
    def proven_at(self) -> float:
        """When the path last proved that it lives, or when it was made (s)."""
        return self._proven_at

    @property
    def used_at(self) -> float:
        """When something other than probes last travelled, or when it was made (s)."""
        return self._used_at

    def pause(self, now: float) -> float:
        """Return how far apart probes are while the path is up, about (s)."""
        return self._pause(now)

    # -- asking and being answered --------------------------------------------------------------------------------

    def take_id(self) -> int:
        """Return the id of the next probe, of liveness or of size."""
        return self._rng.getrandbits(64)

    def ask(self, now: float, to: Address | None, *, sealed: bool) -> int:
        """Return the id of a probe that leaves now to this address, by plan."""
        self.last_at = now
        return self._note(self._out, Probe(now, to, sealed))

    def ask_back(self, now: float, to: Address) -> int:
        """Return the id of a sealed probe that leaves now with the answer to an introduction, to where that was."""
        return self._note(self._back, Probe(now, to, sealed=True))

    def _note(self, out: dict[int, Probe], probe: Probe) -> int:
        while out:
            oldest = next(iter(out))
            if len(out) < MAX_PROBES_OUT and out[oldest].sent_at > probe.sent_at - LONGEST_ANSWER_S:
                break
            del out[oldest]
        probe_id = self.take_id()
        out[probe_id] = probe
        return probe_id

    def answered(self, probe_id: int, now: float) -> Probe | None:
        """Return the probe that this answers, once and not too late; None when it answers nothing we asked."""
        probe = self._out.pop(probe_id, None) or self._back.pop(probe_id, None)
        return probe if probe is not None and probe.sent_at > now - LONGEST_ANSWER_S else None

    def forget(self) -> None:
        """Answers to what was asked until now prove nothing."""
        self._out.clear()
        self._back.clear()

    # -- planning -------------------------------------------------------------------------------------------------

    def plan_up(self, now: float) -> None:
        """The path is up, and a probe left: plan the next one."""
        self.at = now + self._pause(now) * self._rng.uniform(1 - IDLE_SPREAD, 1 + IDLE_SPREAD)

    def plan_unstable(self, now: float, smoothed_rtt_s: float) -> None:
        """As `plan_up`, for a path that is silent, or leads to where the peer has not proven to be."""
        self.at = now + max(FIRST_PROBE_S, smoothed_rtt_s) * self._rng.uniform(1 - DOWN_SPREAD, 1 + DOWN_SPREAD)

    def plan_down(self, now: float) -> None:
        """As `plan_up`, for a path that is down."""
        self.at = now + self._gap * self._rng.uniform(1 - DOWN_SPREAD, 1 + DOWN_SPREAD)
        backoff = RETURN_BACKOFF if self._was_up else PROBE_BACKOFF
        self._gap = min(self._gap * backoff, self._patience * (MAX_PROBE_S if self._leads else MAX_WATCH_PROBE_S))

    @property
    def _patience(self) -> float:
        """How many times longer than usual a path that is not up waits between two probes."""
        return max(1.0, self.crowd / FREE_ADDRESSES)

    def _pause(self, now: float) -> float:
        pause = min(max(IDLE_PROBE_S, (now - self._used_at) / IDLE_SHARE), MAX_IDLE_PROBE_S)
        if self._leads:
            return pause
        return WATCH_FACTOR * min(pause, max(IDLE_PROBE_S, self._asked_every))

    def came_up(self, now: float) -> None:
        """The path is up."""
        self._was_up = True
        self._gap = FIRST_PROBE_S
        self._proven_at = self._used_at = now
        self.at = now + self._pause(now)

    def proven(self, now: float) -> None:
        """The path, up before, proved that it lives."""
        self._proven_at = now
        pause = self._pause(now)
        if not now + pause / 2 <= self.at <= now + pause * (1 + IDLE_SPREAD):
            self.at = now + pause

    def used(self, now: float) -> None:
        """Something other than probes travels: a path in use is not at rest."""
        self._used_at = now
        self.at = min(self.at, now + self._pause(now))

    def needed(self, now: float) -> None:
        """The path, up, may be used any moment: what is known of it must not be old."""
        self.used(now)
        if now - self._proven_at > IDLE_PROBE_S:
            self.at = min(self.at, max(now, self.last_at + IDLE_PROBE_S))

    def asked(self, now: float) -> None:
        """The peer probed the path, which is up: who does not lead asks in the same datagram, unless it just did."""
        if self._leads:
            return
        self._asked_every, self._asked_at = now - self._asked_at, now
        if now - self._proven_at > IDLE_PROBE_S / 2 and now - self.last_at > IDLE_PROBE_S / 2:
            self.at = now
        else:
            self.at = now + self._pause(now)

    def hasten(self, now: float, smoothed_rtt_s: float) -> None:
        """It is time to ask again: but what was asked a round trip ago may still be answered, whoever wishes it."""
        self.at = min(self.at, max(now, self.last_at + max(self._patience * FIRST_PROBE_S, smoothed_rtt_s)))

    def challenge(self, now: float) -> None:
        """Ask at once, unless that was done a moment ago: the peer shows up where it has not proven to be."""
        self.at = min(self.at, max(now, self.last_at + FIRST_PROBE_S))

    def begin_again(self, now: float) -> None:
        """The path may have come back: probe at once, and the first ones close together."""
        self._gap = FIRST_PROBE_S
        self.at = now
