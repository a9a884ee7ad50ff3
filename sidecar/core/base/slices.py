"""Divides work that one event makes for many requests into slices.

A lost carrier takes a copy of every request with it, and a restarted server ends all that it had. Looking at thousands
of requests takes longer than anybody should wait for the engine's lock. So a turn of the engine, which is everything it
is told at one moment, does at most a slice of such work. The rest is due at once, at its next timer, and between the
two anyone who waits for the engine gets it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator
from functools import partial
from typing import TypeVar

SLICE = 16
"""Steps in one turn. A step moves one request to another path, chosen among those to fifty servers: up to 0.2 ms."""

GROUP = 16
"""Pieces of light work that count as one step."""

Target = TypeVar("Target")
Step = Callable[[float], None]
"""Does its part; takes the current time (s)."""


def in_groups(act: Callable[[Target], None], targets: Iterable[Target]) -> list[Step]:
    """Return steps that do for many targets what takes a few microseconds each."""
    found = list(targets)

    def do(first: int, _now: float) -> None:
        for target in found[first : first + GROUP]:
            act(target)

    return [partial(do, first) for first in range(0, len(found), GROUP)]


def rest(_now: float) -> None:
    """Use up one step of the turn: the job's generator itself looks at many things between steps."""


class Backlog:
    """Jobs of many steps each; the oldest first."""

    __slots__ = ("_jobs", "_left", "_now", "_since", "_unnamed")

    def __init__(self) -> None:
        self._jobs: OrderedDict[Hashable, _Job] = OrderedDict()
        self._now = float("-inf")
        self._left = SLICE
        self._since = 0.0
        self._unnamed = 0

    def __len__(self) -> int:
        """Return the number of jobs under way."""
        return len(self._jobs)

    def add(self, steps: Callable[[], Iterable[Step]], now: float, name: Hashable = None) -> None:
        """Do these steps, as many now as the turn has room for.

        A job with the name of one under way begins after that one has ended and all others had their turn. There is at
        most one such job: whatever happens meanwhile, nothing is looked at more than twice.
        """
        if name is None:
            self._unnamed += 1
            name = ("unnamed", self._unnamed)
        job = self._jobs.get(name)
        if job is not None:
            job.again = steps
            return
        if not self._jobs:
            self._since = now
        self._jobs[name] = _Job(steps)
        if len(self._jobs) == 1:
            self.run(now)

    def add_steps(self, steps: list[Step], now: float) -> None:
        """Do these steps, if there are any."""
        if steps:
            self.add(steps.copy, now)

    def allows(self, now: float) -> bool:
        """Return whether this turn has room for one more step, and take that step for the caller."""
        if now != self._now:
            self.begin_turn(now)
        if not self._left:
            return False
        self._left -= 1
        return True

    def begin_turn(self, now: float) -> None:
        """Begin a turn: the engine was left and is entered again."""
        self._now = now
        self._left = SLICE

    def run(self, now: float, leave: int = 0) -> None:
        """Do what the turn has room for, except for the last `leave` steps."""
        while self._jobs and (self._left > leave or now != self._now) and self.allows(now):
            name, job = next(iter(self._jobs.items()))
            step = next(job.steps, None)
            if step is not None:
                step(now)
            elif job.again is not None:
                job.begin_again()
                self._jobs.move_to_end(name)
            else:
                del self._jobs[name]

    def next_timer(self) -> float | None:
        """Return when `run` is wanted: in the past if there is work."""
        return self._since if self._jobs else None


class _Job:
    __slots__ = ("again", "steps")

    def __init__(self, steps: Callable[[], Iterable[Step]]) -> None:
        self.steps: Iterator[Step] = iter(steps())
        self.again: Callable[[], Iterable[Step]] | None = None

    def begin_again(self) -> None:
        assert self.again is not None
        self.steps, self.again = iter(self.again()), None
