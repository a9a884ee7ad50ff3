"""Races connections to the control plane over several ways, good ones first; the first to connect wins. Sans-IO.

This is Happy Eyeballs (RFC 8305) over interfaces and addresses. Within a class of ways one attempt starts after the
other, STAGGER_S apart, or at once when the one before has failed. A class begins when the one before has had its head
start, or all of it has failed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.control.ways import STAGGER_S

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from plr.sidecar.core.control.ways import Way, WayClass


class ControlRace:
    """One race. The driver starts the attempts that are `due`, and reports their outcomes."""

    def __init__(self, classes: Sequence[WayClass], now: float, running: Collection[Way] = ()) -> None:
        """Begin a race; `running` are attempts of an earlier race, which go on."""
        self._waiting = [[way for way in one.ways if way not in running] for one in classes]
        self._head_starts = [one.head_start_s for one in classes]
        self._running = set(running)
        self._due = [now] * len(classes)
        """When each class may start its next attempt."""
        for index in range(1, len(classes)):
            self._due[index] = self._due[index - 1] + self._head_starts[index - 1]
        self._classes = [frozenset(one.ways) for one in classes]
        self.failures: dict[Way, str] = {}

    @property
    def over(self) -> bool:
        """Return whether every way has failed."""
        return not self._running and not any(self._waiting)

    def due(self, now: float) -> list[Way]:
        """Take the ways to try now."""
        started = []
        for index, waiting in enumerate(self._waiting):
            while waiting and now >= self._due[index]:
                started.append(waiting.pop(0))
                self._due[index] += STAGGER_S
                if self._due[index] <= now:
                    self._due[index] = now + STAGGER_S
        self._running.update(started)
        return started

    def failed(self, way: Way, why: str, now: float) -> None:
        """Note a failed attempt; the next one need not wait."""
        self._running.discard(way)
        self.failures[way] = why
        for index, ways in enumerate(self._classes):
            if way in ways:
                self._due[index] = min(self._due[index], now)
                if not self._waiting[index] and not ways & self._running:
                    self._begin_next(index, now)

    def _begin_next(self, index: int, now: float) -> None:
        """Bring the later classes forward, as a class has failed."""
        following = next((later for later in range(index + 1, len(self._due)) if self._waiting[later]), None)
        if following is not None:
            sooner = self._due[following] - now
            if sooner > 0.0:
                for later in range(following, len(self._due)):
                    self._due[later] -= sooner

    def next_timer(self) -> float | None:
        """Return when something is due; None if only running attempts are awaited."""
        return min((due for due, waiting in zip(self._due, self._waiting, strict=True) if waiting), default=None)

    def outcome(self) -> str:
        """Return the outcome of every way so far, in words."""
        told = [f"{way}: {why}" for way, why in self.failures.items() if way not in self._running]
        told += [f"{way}: no answer" for way in sorted(self._running, key=str)]
        return "; ".join(told) or "no interface or route leads to it"
