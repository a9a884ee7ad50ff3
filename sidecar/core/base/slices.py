"""Work that one event makes for many requests, in slices.

A carrier that goes takes a copy of every request with it, and a server that restarts ends all that it had. To look at
thousands of requests takes longer than anybody should wait for the engine's lock. So a turn of the engine, which is
all that it is told at one moment, does no more than a slice of such work. The rest is due at once, at its next timer,
and between the two whoever waits for the engine has it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator
from functools import partial
from typing import TypeVar

SLICE = 16
"""Steps in one turn. A step brings one request to another path, among those to fifty servers: up to 0.2 ms."""

GROUP = 16
"""Light work that counts as one step."""

Target = TypeVar("Target")
Step = Callable[[float], None]
"""Does its part; takes the present moment (s)."""


def in_groups(act: Callable[[Target], None], targets: Iterable[Target]) -> list[Step]:
    """Return steps that do what takes a few microseconds for each of many."""
    found = list(targets)

    def do(first: int, _now: float) -> None:
        for target in found[first : first + GROUP]:
            act(target)

    return [partial(do, first) for first in range(0, len(found), GROUP)]


def rest(_now: float) -> None:
    """Take a step's time from the turn: what makes the steps looks at many things itself."""


class Backlog:
    """Jobs, each of many steps; the oldest first."""

    __slots__ = ("_jobs", "_left", "_now", "_since", "_unnamed")

    def __init__(self) -> None:
        self._jobs: OrderedDict[Hashable, _Job] = OrderedDict()
        self._now = float("-inf")
        self._left = SLICE
        self._since = 0.0
        self._unnamed = 0

    def __len__(self) -> int:
        """Jobs under way."""
        return len(self._jobs)

    def add(self, steps: Callable[[], Iterable[Step]], now: float, name: Hashable = None) -> None:
        """Do these steps, as many of them now as the turn has room for.

        A job that has the name of one under way begins when that one has ended and all others had their turn, and there
        is one such job at most: whatever happens meanwhile, nothing is looked at more than twice.
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
        """Do these, if there are any."""
        if steps:
            self.add(steps.copy, now)

    def allows(self, now: float) -> bool:
        """Whether this turn has room for one more step, which is the caller's then."""
        if now != self._now:
            self.begin_turn(now)
        if not self._left:
            return False
        self._left -= 1
        return True

    def begin_turn(self, now: float) -> None:
        """The engine was left and is entered again."""
        self._now = now
        self._left = SLICE

    def run(self, now: float, leave: int = 0) -> None:
        """Do what the turn has room for, but for the last `leave` steps."""
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
        """When `run` is wanted: it has passed if there is work."""
        return self._since if self._jobs else None


class _Job:
    __slots__ = ("again", "steps")

    def __init__(self, steps: Callable[[], Iterable[Step]]) -> None:
        self.steps: Iterator[Step] = iter(steps())
        self.again: Callable[[], Iterable[Step]] | None = None

    def begin_again(self) -> None:
        assert self.again is not None
        self.steps, self.again = iter(self.again()), None
