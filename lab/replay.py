"""Decides when each step of a trace applies, without IO."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lab.errors import LabConfigError

if TYPE_CHECKING:
    from lab.traces import TraceStep


class Replay:
    """Steps of a trace laid on the monotonic clock, once or repeatedly.

    Args:
        steps: in order of time, the first at 0.
        start: the monotonic second at which the trace's clock reads 0. If it has passed, missed steps
            are skipped and the one in force applies.
        repeat_s: start over after this many seconds (the trace's duration); None keeps the last step.

    Raises:
        LabConfigError: no steps, or `repeat_s` not beyond the last step.
    """

    def __init__(self, steps: tuple[TraceStep, ...], *, start: float, repeat_s: float | None = None) -> None:
        if not steps:
            raise LabConfigError("trace: no steps")
        if repeat_s is not None and repeat_s <= steps[-1].at_s:
            raise LabConfigError(f"repeat_s: {repeat_s} does not lie beyond the last step at {steps[-1].at_s}")
        self._steps = steps
        self._repeat_s = repeat_s
        self._start = start
        self._next = 0

    def next_change(self) -> float | None:
        """Return the monotonic second of the next step; None if the last one is in force."""
        if self._next == len(self._steps):
            return None
        return self._start + self._steps[self._next].at_s

    def due(self, now: float) -> list[tuple[float, TraceStep]]:
        """Return (time it was due, step) for the newest step due by `now` and not yet returned; or nothing."""
        newest: list[tuple[float, TraceStep]] = []
        while (at := self.next_change()) is not None and at <= now:
            newest = [(at, self._steps[self._next])]
            self._next += 1
            if self._next == len(self._steps) and self._repeat_s is not None:
                self._next = 0
                self._start += self._repeat_s
        return newest
