"""Schedules the probes of one path, and knows which of them may still be answered.

A path in use is probed twice a second. A resting one is probed ever less often, so that a thousand idle robots cost a
server next to nothing, but often enough that no NAT forgets it. One end leads: the robot, as the NAT is its own. The
other end asks in the datagram with which it answers, and by itself only if it was not asked for long.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from plr.sidecar.core.path.congestion.rtt import LONGEST_ANSWER_S

if TYPE_CHECKING:
    import random

    from plr.protos.model.ids import Address
    from plr.sidecar.core.base.values import PathId

IDLE_PROBE_S = 0.5
"""Interval of probes on a recently used path; it finds a dead one within a second, ..."""
IDLE_SHARE = 8.0
"""... on a resting path the interval is the time that it has rested divided by this, ..."""
MAX_IDLE_PROBE_S = 15.0
"""... but at most this. RFC 4787 asks NATs to remember for 2 minutes; some mobile networks forget after 30 s, which
leaves room for a lost probe."""
IDLE_SPREAD = 0.2
"""Share by which that interval varies either way, so that the paths of many robots that began together drift apart."""
WATCH_FACTOR = 2.5
"""The end that does not lead asks by itself after this many times the usual interval without being asked."""
FIRST_PROBE_S = 0.05
"""Initial interval of probes on a path that is not up ..."""
MAX_PROBE_S = 1.0
"""... which backs off to this, so that a path that comes back is seen within a second, ..."""
MAX_WATCH_PROBE_S = 15.0
"""... or to this at the end that does not lead: a thousand unreachable robots must not keep it busy."""
MAX_DORMANT_PROBE_S = 900.0
"""... or to this at the end that leads, if the peer is dormant (`engine/dormant.py`): it may be dead for good."""
FREE_ADDRESSES = 16
"""A peer that announces more addresses has all of them probed that much less often until they answer: it gets no more
datagrams out of us, wherever they lead. Those of a dormant peer that it has proven are exempt: they are few."""
PROBE_BACKOFF = 1.5
RETURN_BACKOFF = 1.02
"""A path that was up is likely to come back, and requests may wait for it: its probes are a fiftieth of its downtime
apart, 0.25 s after ten seconds. Both ends probe, so the wait is mostly half of that or less."""
DOWN_SPREAD = 0.1
"""As IDLE_SPREAD, for a path that is not up."""
LONGEST_GAP_S = MAX_DORMANT_PROBE_S / (1 + DOWN_SPREAD)
"""No two probes of a path are further apart, whatever the spread."""
MAX_PROBES_OUT = 1024
"""Unanswered probes of either kind that are remembered: those of LONGEST_ANSWER_S, spaced by FIRST_PROBE_S, to a few
addresses each."""


class AnsweredProbe(NamedTuple):
    """A probe that was answered."""

    sent_at: float
    to: Address | None
    """The only address that it went to: so the peer is there."""
    sealed: bool
    """Whether this path's keys sealed it, so that the answer confirms them."""


@dataclass(slots=True)
class SentPing:
    """A ping that waits to leave, or for its answer."""

    id: int
    """Id of its PROBE."""
    number: int
    path: PathId
    size: int
    """Bytes of its datagram's UDP payload."""
    sent_at: float | None = None


class Probing:
    """The schedule of one path's probes, and the memory of them. Times in seconds."""

    __slots__ = (
        "_asked_at",
        "_asked_every",
        "_back",
        "_gap",
        "_leads",
        "_out",
        "_proven_at",
        "_rng",
        "_round",
        "_used_at",
        "_was_up",
        "at",
        "crowd",
        "dormant",
        "last_at",
    )  # fmt: skip

    def __init__(self, now: float, rng: random.Random, *, leads: bool) -> None:
        """Create the schedule; `rng` must be unpredictable: who guesses an id could answer a probe he did not get."""
        self._rng = rng
        self.at = now
        """When the next probe leaves."""
        self.last_at = now - FIRST_PROBE_S
        """When the last probe left."""
        self.crowd = 0
        """Number of addresses that the peer announced, over all its interfaces."""
        self.dormant = False
        """Whether the peer is dormant; see MAX_DORMANT_PROBE_S."""
        self._leads = leads
        self._round = 0
        self._gap = FIRST_PROBE_S
        self._was_up = False
        self._used_at = now
        self._proven_at = now
        self._asked_at = now
        self._asked_every = MAX_IDLE_PROBE_S
        """Interval at which the peer asks."""
        self._out: dict[int, AnsweredProbe] = {}
        """Scheduled probes, the oldest first."""
        self._back: dict[int, AnsweredProbe] = {}
        """Probes sent in answer to introductions. They are kept apart, since each repeated introduction makes us send
        one."""

    # -- queries -----------------------------------------------------------------------------------------------------

    @property
    def proven_at(self) -> float:
        """When the path last proved that it lives, or when it was made (s)."""
        return self._proven_at

    @property
    def used_at(self) -> float:
        """When something other than probes last travelled, or when it was made (s)."""
        return self._used_at

    def pause(self, now: float) -> float:
        """Return the approximate interval of probes while the path is up (s)."""
        return self._pause(now)

    # -- asking and being answered --------------------------------------------------------------------------------

    def take_id(self) -> int:
        """Return the id of the next probe, of liveness or of MTU."""
        return self._rng.getrandbits(64)

    def ask(self, now: float, to: Address | None, *, sealed: bool) -> int:
        """Return the id of a scheduled probe that leaves now to this address."""
        self.last_at = now
        return self._note(self._out, AnsweredProbe(now, to, sealed))

    def ask_back(self, now: float, to: Address) -> int:
        """Return the id of a sealed probe that leaves now with the answer to an introduction, to its source."""
        return self._note(self._back, AnsweredProbe(now, to, sealed=True))

    def _note(self, out: dict[int, AnsweredProbe], probe: AnsweredProbe) -> int:
        while out:
            oldest = next(iter(out))
            if len(out) < MAX_PROBES_OUT and out[oldest].sent_at > probe.sent_at - LONGEST_ANSWER_S:
                break
            del out[oldest]
        probe_id = self.take_id()
        out[probe_id] = probe
        return probe_id

    def answered(self, probe_id: int, now: float) -> AnsweredProbe | None:
        """Return the probe that this answers, once and not too late; None if it answers nothing we asked."""
        probe = self._out.pop(probe_id, None) or self._back.pop(probe_id, None)
        return probe if probe is not None and probe.sent_at > now - LONGEST_ANSWER_S else None

    def forget(self) -> None:
        """Forget the probes so far: their answers prove nothing."""
        self._out.clear()
        self._back.clear()

    # -- planning -------------------------------------------------------------------------------------------------

    def plan_up(self, now: float) -> None:
        """Plan the next probe of a path that is up, after one left."""
        self.at = now + self._pause(now) * self._rng.uniform(1 - IDLE_SPREAD, 1 + IDLE_SPREAD)

    def plan_unstable(self, now: float, smoothed_rtt_s: float) -> None:
        """Do as `plan_up` for a path that is silent, or leads to an address that the peer has not proven."""
        self.at = now + max(FIRST_PROBE_S, smoothed_rtt_s) * self._rng.uniform(1 - DOWN_SPREAD, 1 + DOWN_SPREAD)

    def plan_down(self, now: float) -> None:
        """Do as `plan_up` for a path that is down."""
        self._round += 1
        gap = min(self._gap, LONGEST_GAP_S)
        self.at = now + gap * self._rng.uniform(1 - DOWN_SPREAD, 1 + DOWN_SPREAD)
        backoff = RETURN_BACKOFF if self._was_up else PROBE_BACKOFF
        longest = MAX_PROBE_S if self._leads else MAX_WATCH_PROBE_S
        if self.dormant and self._leads:
            longest = LONGEST_GAP_S
        self._gap = min(self._gap * backoff, self._patience * longest)

    def has_turn(self, number: int) -> bool:
        """Return whether an address that the peer has not proven, the one with this number, is asked this time.

        A dormant peer of many addresses is asked as often as any, but at each time only at some of them.
        """
        return (number + self._round) % math.ceil(self._gap / LONGEST_GAP_S) == 0

    @property
    def _patience(self) -> float:
        """Factor by which a path that is not up waits longer than usual between two probes."""
        return max(1.0, self.crowd / FREE_ADDRESSES)

    def _pause(self, now: float) -> float:
        pause = min(max(IDLE_PROBE_S, (now - self._used_at) / IDLE_SHARE), MAX_IDLE_PROBE_S)
        if self._leads:
            return pause
        return WATCH_FACTOR * min(pause, max(IDLE_PROBE_S, self._asked_every))

    def came_up(self, now: float) -> None:
        """Note that the path came up."""
        self._was_up = True
        self._gap = FIRST_PROBE_S
        self._proven_at = self._used_at = now
        self.at = now + self._pause(now)

    def proven(self, now: float) -> None:
        """Note that the path, already up, proved that it lives."""
        self._proven_at = now
        pause = self._pause(now)
        if not now + pause / 2 <= self.at <= now + pause * (1 + IDLE_SPREAD):
            self.at = now + pause

    def used(self, now: float) -> None:
        """Note that something other than probes travels: the path is in use."""
        self._used_at = now
        self.at = min(self.at, now + self._pause(now))

    def needed(self, now: float) -> None:
        """Note that the path, which is up, may be used any moment: what is known of it must be recent."""
        self.used(now)
        if now - self._proven_at > IDLE_PROBE_S:
            self.at = min(self.at, max(now, self.last_at + IDLE_PROBE_S))

    def asked(self, now: float) -> None:
        """Note that the peer probed the path, which is up: the end that does not lead asks back unless it just did."""
        if self._leads:
            return
        self._asked_every, self._asked_at = now - self._asked_at, now
        if now - self._proven_at > IDLE_PROBE_S / 2 and now - self.last_at > IDLE_PROBE_S / 2:
            self.at = now
        else:
            self.at = now + self._pause(now)

    def hasten(self, now: float, smoothed_rtt_s: float) -> None:
        """Ask again soon, but not within a round trip of the last probe: that one may still be answered."""
        self.at = min(self.at, max(now, self.last_at + max(self._patience * FIRST_PROBE_S, smoothed_rtt_s)))

    def challenge(self, now: float) -> None:
        """Ask at once, unless that was just done: the peer shows up at an address that it has not proven."""
        self.at = min(self.at, max(now, self.last_at + FIRST_PROBE_S))

    def ask_at_once(self, now: float) -> None:
        """Probe at once: the path is silent."""
        self.at = now

    def begin_again(self, now: float) -> None:
        """Probe at once, the first ones close together: the path may have come back."""
        self._gap = FIRST_PROBE_S
        self.at = now
