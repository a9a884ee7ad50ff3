"""Says for each redundancy mode when a request gets which further copies (docs/use/redundancy.md).

A mode is a class here, found by its `RedundancyMode` in MODES. It decides; `Dispatching`, whose verbs it calls, sends.
What holds for all modes is not here: refusals, dead paths, budgets and requests that must not run twice.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from plr.protos.model.redundancy_mode import RedundancyMode
from plr.sidecar.core.robot.request.request import HEDGE_AT

if TYPE_CHECKING:
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.robot.dispatch.adaptive import Adaptive
    from plr.sidecar.core.robot.dispatch.pair_history import PathRecords
    from plr.sidecar.core.robot.request.request import Request


class Sender(Protocol):
    """What a mode may ask for. Times are monotonic seconds."""

    @property
    def records(self) -> PathRecords:
        """Outcomes of recent copies by pair."""

    @property
    def adaptive(self) -> Adaptive:
        """Forecasts for requests under way."""

    def next_withheld(self, request: Request, now: float) -> PathId | None:
        """Return the best mapped path that is up and carries no copy, to a server that may run it."""

    def next_over_another_interface(self, request: Request, now: float) -> PathId | None:
        """Return the same, if none of the copies relied on uses its interface."""

    def hedge(self, request: Request, path: PathId, now: float) -> bool:
        """Send a copy because another one is slow; return whether a budget allowed it."""

    def rescue(self, request: Request, now: float, *, insist: bool = False) -> None:
        """Send one more copy if no copy that is relied on is on a path that is up (or if `insist`)."""

    def ask_another_server(self, request: Request, now: float) -> None:
        """Ask another server, also over the same interface, if the only one asked has the request and is silent."""


class Mode:
    """Sends one copy over the best mapped pair; a further one only if its path or server is in trouble (`single`)."""

    at_once = False
    """Whether every mapped pair carries a copy from the start."""
    replaces_lost = False
    """Whether a copy of which nothing is heard is replaced before its path is known to be down."""
    shares = False
    """Whether paths of several interfaces carry one copy together."""

    def slowness(self, sender: Sender, request: Request, path: PathId, now: float) -> float:
        """Return what the mapped paths that are up are sorted by, the best with the least."""
        return sender.records.miss_share(request.service, path, now)

    def begun(self, sender: Sender, request: Request, now: float) -> None:
        """Act after the first copy has left alone."""
        sender.rescue(request, now)

    def first_look(self, _sender: Sender, _request: Request, _now: float) -> float | None:
        """Return when to look at a request that is awaited; None: never. Not called after its deadline."""
        return None

    def look_again(self, _sender: Sender, _request: Request, _now: float) -> float | None:
        """Act at that moment; return when to look once more."""
        return None

    def watches(self, _sender: Sender, _request: Request, _now: float) -> bool:
        """Return whether the mode itself acts on a path that is unstable, and did so now."""
        return False


class Backup(Mode):
    """Sends the next copy when the path of the first is in trouble or loses it, or when its server is silent."""

    replaces_lost = True

    def first_look(self, _sender: Sender, request: Request, _now: float) -> float | None:
        """Look at half the deadline if one server has the request alone and another one may run it."""
        if request.rule.idempotent and len(request.asked()) == 1:
            return _half(request)
        return None

    def look_again(self, sender: Sender, request: Request, now: float) -> float | None:
        """Ask another server: the only one asked may have died unnoticed."""
        sender.ask_another_server(request, now)
        return None


class Hedge(Backup):
    """Sends the next copy when the answer takes longer than it mostly does (Dean and Barroso 2013)."""

    replaces_lost = False

    def first_look(self, sender: Sender, request: Request, now: float) -> float | None:
        """Look when the pair's quantile has passed, at half the deadline at the latest."""
        path, quantile = request.relied_on()[0].path, request.rule.hedge_quantile
        delay_s = sender.records.quantile_s(request.service, path, quantile, now)
        half = _half(request)
        return half if delay_s is None else min(now + delay_s, half)

    def look_again(self, sender: Sender, request: Request, now: float) -> float | None:
        """Send a copy over another interface, or ask another server if there is none.

        Not over the same interface while the request has not arrived: that path is slow, another copy would delay it.
        """
        waiting = request.relied_on()
        path = sender.next_withheld(request, now)
        if path is None or path.interface == waiting[0].path.interface:
            return super().look_again(sender, request, now)
        if len(waiting) == 1:
            sender.hedge(request, path, now)
        return None


class AdaptiveMode(Mode):
    """Sends each further copy as late as keeps the target miss probability (`adaptive`)."""

    def slowness(self, sender: Sender, request: Request, path: PathId, now: float) -> float:
        """Prefer the currently fastest path: what is missed or rescued makes a pair slow as well."""
        return sender.adaptive.expected_s(request, path, now)

    def begun(self, sender: Sender, request: Request, now: float) -> None:
        """Leave everything to the first look."""

    def first_look(self, sender: Sender, request: Request, now: float) -> float | None:
        """Send the further copies that the target requires; return when to look again, None if that is pointless."""
        while True:
            miss = sender.adaptive.miss_probability(request, now)
            path = sender.next_over_another_interface(request, now)
            if path is None or not sender.adaptive.needs(request, path, miss, now):
                break
            if not sender.hedge(request, path, now):
                return None  # no budget: asking again and again would only add refusals to the count
        if path is None and now >= _half(request):
            sender.ask_another_server(request, now)
        look_at = sender.adaptive.next_look(request, now)
        return look_at if look_at < request.deadline_at else None

    def look_again(self, sender: Sender, request: Request, now: float) -> float | None:
        """Do the same again."""
        return self.first_look(sender, request, now)

    def watches(self, sender: Sender, request: Request, now: float) -> bool:
        """Forecast again instead of waiting for the path to recover."""
        self.first_look(sender, request, now)
        return True


class Share(Backup):
    """Sends one copy to one server over all mapped interfaces together; spare capacity repeats a share of it.

    Full races go over every mapped pair at once, so that each is measured.
    """

    at_once = True
    replaces_lost = False
    shares = True


class Replicate(Backup):
    """Sends a copy over every mapped pair at once (paper, section IV)."""

    at_once = True
    replaces_lost = False


def _half(request: Request) -> float:
    return request.submitted_at + HEDGE_AT * request.rule.deadline_s


MODES: dict[RedundancyMode, Mode] = {
    RedundancyMode.SINGLE: Mode(),
    RedundancyMode.BACKUP: Backup(),
    RedundancyMode.HEDGE: Hedge(),
    RedundancyMode.ADAPTIVE: AdaptiveMode(),
    RedundancyMode.SHARE: Share(),
    RedundancyMode.REPLICATE: Replicate(),
}
