"""Robot side, RedundancyMode.ADAPTIVE: decides when a request needs another copy to keep its target miss probability.

A request that is awaited is looked at repeatedly. For each copy under way, the remaining time is forecast from how much
of it was acknowledged, how fast, and how long ago. The ratio of the actual to the forecast time is taken to be
lognormal: rates of radio links vary by factors. Another copy is sent as soon as waiting for the next look would make it
too late: when the probability that all copies under way miss, times that of the new one if it were sent at the next
look, exceeds the target.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from plr.sidecar.core.base.values import PathState

if TYPE_CHECKING:
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.robot.dispatch.pair_history import PathPaces
    from plr.sidecar.core.robot.request.request import Copy, Request
    from plr.sidecar.core.transfer.routes import Routes

LOOKS = 20
"""Number of looks at a request until its deadline ..."""
LEAST_STEP_S = 0.005
"""... but not closer together than this (s): a busy host is no more exact."""
SPREAD = 0.7
"""Standard deviation of the logarithm of the remaining time over its forecast."""
UNFORESEEN = 0.01
"""Probability that a copy misses although its forecast is good."""
PATIENCE_ROUNDS = 2.0
"""Round trips without any progress that are no sign of a stall."""
STALL_FACTOR = 4.0
"""A copy that made no progress for longer is expected to make none for this many times as long again: most outages of
a radio link that outlast a few round trips last for a second or more."""
WAITING = 1.0
"""Where the target cannot be kept any more, waiting for the next look may add this many times the target."""
UNKNOWN_PART = 0.5
"""Share of the deadline that an answer is expected to take while nothing is known about a service."""


def late_probability(needs_s: float, left_s: float) -> float:
    """Return the probability that what is forecast to need `needs_s` takes longer than `left_s`."""
    if left_s <= 0 or math.isinf(needs_s):
        return 1.0
    if needs_s <= 0:
        return UNFORESEEN
    beyond = 0.5 * math.erfc(math.log(left_s / needs_s) / (SPREAD * math.sqrt(2)))
    return UNFORESEEN + (1 - UNFORESEEN) * beyond


class Adaptive:
    """Judges requests under way."""

    def __init__(self, routes: Routes, paces: PathPaces) -> None:
        self._routes = routes
        self._paces = paces

    def next_look(self, request: Request, now: float) -> float:
        """Return when to look at the request again."""
        return now + self._step(request)

    def _step(self, request: Request) -> float:
        return max(request.rule.deadline_s / LOOKS, LEAST_STEP_S)

    def expected_s(self, request: Request, path: PathId, now: float) -> float:
        """Return the seconds that an answer to this request is expected to take over this path."""
        expected_s = self._paces.expected_s(request.service, path, now)
        return UNKNOWN_PART * request.rule.deadline_s if expected_s is None else expected_s

    def miss_probability(self, request: Request, now: float) -> float:
        """Return the probability that all copies under way miss the deadline, if paths fail independently."""
        left_s = request.deadline_at - now
        return math.prod(late_probability(self._left_to_do(request, copy, now), left_s) for copy in request.relied_on())

    def needs(self, request: Request, path: PathId, miss: float, now: float) -> bool:
        """Return whether the request needs one more copy now, over this path; `miss` is for the copies under way."""
        target = request.rule.adaptive_target
        left_s = request.deadline_at - now
        if miss <= target or left_s <= self._routes.rtt(path):
            return False  # not needed, or never in time
        takes_s = self.expected_s(request, path, now)
        at_once = miss * late_probability(takes_s, left_s)
        later = miss * late_probability(takes_s, left_s - self._step(request))
        return later > target and (at_once <= target or later - at_once > WAITING * target)

    def _left_to_do(self, request: Request, copy: Copy, now: float) -> float:
        """Return the forecast seconds until the copy is answered."""
        state = self._routes.state(copy.path)
        if state is PathState.DOWN:
            return math.inf
        if copy.forecast_s is None:
            copy.forecast_s = self.expected_s(request, copy.path, now)
        symbols = copy.message.newest.symbols
        arrived = symbols.count if symbols.over else min(symbols.arrived, symbols.count)
        if arrived > copy.arrived:
            copy.arrived, copy.progress_at = arrived, now
        # The last round trip measured may be out of date: answers show it first.
        rtt_s = min(self._routes.rtt(copy.path), copy.forecast_s)
        answer_s = min(rtt_s + self._paces.processing_s(request.service, copy.path), copy.forecast_s)
        silence_s = now - copy.progress_at
        patience_s = PATIENCE_ROUNDS * rtt_s + self._step(request)
        if symbols.over:
            left_s = max(answer_s - silence_s, 0.0)
            patience_s += answer_s
        elif copy.arrived:
            sending_s = max(copy.progress_at - copy.sent_at - rtt_s, LEAST_STEP_S) * symbols.count / copy.arrived
            # The first symbols show little: an idle path starts slowly.
            believed = min(1.0, (now - copy.sent_at) / copy.forecast_s)
            sending_s = believed * sending_s + (1.0 - believed) * max(copy.forecast_s - answer_s, 0.0)
            left_s = sending_s * (1.0 - copy.arrived / symbols.count) + answer_s
        else:
            left_s = max(copy.forecast_s - (now - copy.sent_at), answer_s)
        if state is PathState.UNSTABLE:
            patience_s = 0.0
        left_s += STALL_FACTOR * max(0.0, silence_s - patience_s)
        awaited_s = min(now - copy.sent_at + left_s, request.rule.deadline_s)
        self._paces.takes_at_least(request.service, copy.path, awaited_s, now)
        return left_s
