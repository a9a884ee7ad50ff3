"""Decides which request of a service its fallback begins next, and when.

The fallback is modelled as a single server that runs one request after the other. For all to be in time, the request
with the k-th deadline has to begin k service times before its deadline. The service time is learned from the fallback's
own answers.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from plr.sidecar.core.base.values import RequestId
    from plr.sidecar.core.rules.service_rule import FallbackRule
    from plr.sidecar.core.seam.application import RequestFailed

WINDOW = 128
"""Answers remembered, however old: the robot's processor will be the same tomorrow."""
QUANTILE = 0.98
"""Share of the requests that should be answered within the expected time; known from 49 answers on."""
SPARE_UNTIL_KNOWN = 1.5
"""Until then the expected time is the longest one seen times this."""


class FallbackTimes:
    """Service times of a fallback in seconds: what a request waited for others is not counted."""

    __slots__ = ("_configured_s", "_free_since", "_seen_s")

    def __init__(self, configured_s: float | None) -> None:
        """Take the time that the user promises (`configured_s`), which replaces the measured one."""
        self._configured_s = configured_s
        self._seen_s: deque[float] = deque(maxlen=WINDOW)
        self._free_since = -math.inf

    def begun_at(self, called_at: float) -> float:
        """Return when a request called at that time begins to run, if the fallback has answered those before it."""
        return max(called_at, self._free_since)

    def note(self, called_at: float, answered_at: float) -> None:
        """Note an answer."""
        self._seen_s.append(answered_at - self.begun_at(called_at))
        self._free_since = answered_at

    def expected_s(self) -> float | None:
        """Return the seconds within which it will answer; None while nothing is known."""
        if self._configured_s is not None:
            return self._configured_s
        if not self._seen_s:
            return None
        rank = math.ceil(QUANTILE * (len(self._seen_s) + 1))
        if rank > len(self._seen_s):
            return max(self._seen_s) * SPARE_UNTIL_KNOWN
        return sorted(self._seen_s)[rank - 1]


MAX_CALLED = 2
"""Most requests at one fallback at once: one runs, the next is ready. With more, those that can still be in time would
queue behind those that cannot."""
SPARE = 0.05
"""Share of the deadline reserved for the way to the fallback and back to the application."""
LEAD_UNTIL_KNOWN = 0.5
"""Share of the deadline given to a fallback that has never answered."""
STALL_S = 1.0
STALL_FACTOR = 4.0
"""A fallback that is silent for this many times its expected time, and for STALL_S, has lost what it was asked: DDS
reports a crashed process only after some 20 s."""
PLANNED_AHEAD = 64
"""Requests looked at to see when the first has to begin."""


@dataclass(slots=True)
class FallbackRequest:
    """One request of an application."""

    id: RequestId
    payload: bytes | None
    deadline_at: float
    expires_at: float
    wanted: bool = False
    """Its fallback has to be asked now, or was asked."""
    over: bool = False
    """Its fallback will not be asked any more."""
    attempts: int = 0
    called_at: float = 0.0
    answered: bool = False
    """The application has its answer."""
    answered_locally: bool = False
    """The application has its answer from the fallback."""
    network_over: bool = False
    failure: RequestFailed | None = None
    """The network's failure, kept from the application as long as the fallback may answer."""


class FallbackQueue:
    """One service's fallback and the requests that may need it. Times are seconds."""

    def __init__(self, rule: FallbackRule, deadline_s: float, lifetime_s: float, *, drop_late: bool) -> None:
        self.rule = rule
        self.deadline_s = deadline_s
        self.lifetime_s = lifetime_s
        self.drop_late = drop_late
        """An answer after the deadline is worth nothing."""
        self.times = FallbackTimes(rule.takes_s)
        self.up = False
        """The fallback can be asked."""
        self.planned: dict[RequestId, FallbackRequest] = {}
        """Requests that the network may yet answer, in order of their deadlines, since all have the same deadline_s."""
        self.wanted: dict[RequestId, FallbackRequest] = {}
        """Requests that wait for room."""
        self.called: dict[RequestId, FallbackRequest] = {}
        """Requests at the fallback."""

    def remove(self, request: FallbackRequest) -> None:
        """Remove a request that is not to be asked any more; if it was asked, its answer is still to come."""
        self.planned.pop(request.id, None)
        self.wanted.pop(request.id, None)

    def begin_at(self) -> float | None:
        """Return when the first planned request has to be wanted; None: not before the network has missed."""
        lead_s = self._lead_s()
        if not self.rule.in_time or not self.planned or lead_s is None:
            return None
        # Requests that are already wanted run first, whatever is added behind them. More than fit into one deadline
        # cannot all be in time, however soon the first begins.
        fit = int((1 - SPARE) * self.deadline_s / lead_s)
        ahead = enumerate(islice(self.planned.values(), min(fit, PLANNED_AHEAD)), 1)
        latest = min(request.deadline_at - place * lead_s for place, request in ahead)
        return latest - SPARE * self.deadline_s

    def _lead_s(self) -> float | None:
        """Return the time one request takes; None if that is more than there is, so that beginning early is useless."""
        takes_s = self.times.expected_s()
        if takes_s is None:
            return LEAD_UNTIL_KNOWN * self.deadline_s
        return takes_s if takes_s < (1 - SPARE) * self.deadline_s else None

    def next_call(self, now: float) -> FallbackRequest | None:
        """Take the request with the earliest deadline, of those that can be in time if there are any."""
        if not self.up or len(self.called) >= MAX_CALLED or not self.wanted:
            return None
        done_at = now + (self.times.expected_s() or 0.0)
        request = min(self.wanted.values(), key=lambda one: (one.deadline_at < done_at, one.deadline_at))
        del self.wanted[request.id]
        self.called[request.id] = request
        request.called_at = now
        request.attempts += 1
        return request

    def is_worthless(self, request: FallbackRequest, now: float) -> bool:
        """Return whether an answer to it would not be delivered any more."""
        return request.answered or (self.drop_late and now >= request.deadline_at)

    def stalled_at(self, request: FallbackRequest) -> float:
        """Return when its answer is given up, although the fallback may still be there."""
        takes_s = self.times.expected_s()
        patience_s = self.deadline_s if takes_s is None else STALL_FACTOR * takes_s
        return self.times.begun_at(request.called_at) + max(STALL_S, patience_s)
