"""Awaits members from before the control plane's restart that are not back yet: no lease covers these.

Only robots know whether a server was stopped in order meanwhile. A robot may lie, to hide that a server died. So one
alone is believed only if no other could say it, and the operator is told by whom it is known.

Times are monotonic seconds.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from plr.protos.model.fleet_events import Why
from plr.protos.model.ids import Role

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable

    from plr.controlplane.core.explain.departed import Departure
    from plr.protos.model.ids import NodeName

TEXT = "it was there before the control plane was restarted, but did not come back"

ENOUGH_WITNESSES = 2
"""Robots that must say that a server said goodbye, if as many may call it."""

MAX_NAMED_WITNESSES = 8
"""Robots named; what further ones say is no news."""


class Returning:
    """Awaits members until a time."""

    def __init__(self) -> None:
        self._awaited: dict[NodeName, Departure] = {}
        self._given_up: set[NodeName] = set()
        """Servers that did not come back in time, and that are not believed to have been stopped."""
        self._witnesses: dict[NodeName, list[NodeName]] = {}
        """For awaited servers and those given up: robots that say that it said goodbye."""
        self._refused: dict[NodeName, tuple[Why, str]] = {}
        """Awaited members whose connection was refused for their certificate, why, and what was said of it."""
        self.until: float | None = None
        """When to ask who is `missing`; None while nobody is awaited."""

    def __len__(self) -> int:
        """Return how many are awaited."""
        return len(self._awaited)

    def expect(self, present: Iterable[Departure], until: float) -> None:
        """Expect those that were present; they are noted as departures if they are not back by then."""
        self._awaited = {one.name: one for one in present}
        self._given_up.clear()
        self._witnesses.clear()
        self._refused.clear()
        self.until = until if self._awaited else None

    def is_back(self, name: NodeName) -> None:
        """Note that it is registered."""
        self._awaited.pop(name, None)
        self._given_up.discard(name)
        self._witnesses.pop(name, None)
        self._refused.pop(name, None)

    def is_refused(self, name: NodeName, why: Why, text: str) -> None:
        """Note that it came back, but that its connection was refused for its certificate."""
        if name in self._awaited:
            self._refused[name] = why, text

    def said_goodbye(self, server: NodeName, robot: NodeName) -> bool:
        """Note that a robot says so of a server; return whether that is news of one that was given up."""
        awaited = self._awaited.get(server)
        if (awaited is None or awaited.role is not Role.CLOUD) and server not in self._given_up:
            return False
        witnesses = self._witnesses.setdefault(server, [])
        if robot in witnesses or len(witnesses) >= MAX_NAMED_WITNESSES:
            return False
        witnesses.append(robot)
        return server in self._given_up

    def judged(self, gone: Departure, could_say: Callable[[NodeName], int]) -> Departure:
        """Return a server's departure as it is to be noted, by what robots say of it.

        `could_say` counts the robots that may call a server.
        """
        witnesses = self._witnesses.get(gone.name, ())
        if witnesses and len(witnesses) >= min(could_say(gone.name), ENOUGH_WITNESSES):
            self._given_up.discard(gone.name)
            del self._witnesses[gone.name]
            text = f"{_named(witnesses)} reported that it said goodbye while the control plane was away"
            return replace(gone, why=Why.DRAINED, text=text)
        self._given_up.add(gone.name)
        doubt = f"; only {_named(witnesses)} reported that it said goodbye" if witnesses else ""
        return replace(gone, text=TEXT + doubt)

    def missing(self, now: float, who_could_say: Callable[[], Callable[[NodeName], int]]) -> list[Departure]:
        """Return those that did not come back in time, each once; `who_could_say` returns what `judged` needs."""
        if self.until is None or self.until > now:
            return []
        could_say = who_could_say()
        awaited, self._awaited = self._awaited, {}
        self.until = None
        refused, self._refused = self._refused, {}
        return [self._missed(replace(one, at=now), refused.get(one.name), could_say) for one in awaited.values()]

    def _missed(
        self, gone: Departure, refused: tuple[Why, str] | None, could_say: Callable[[NodeName], int]
    ) -> Departure:
        if refused is not None:
            why, text = refused
            return replace(gone, why=why, text=f"it tries to come back, and is refused: {text}")
        return self.judged(gone, could_say) if gone.role is Role.CLOUD else replace(gone, text=TEXT)


def _named(robots: Collection[NodeName]) -> str:
    return ", ".join(robots)
