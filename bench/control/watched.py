"""Runs the real control plane, and notes how long each turn of its event loop held it.

`python -m bench.control.watched FILE --config ...` starts `plr-controlplane` with these arguments. On SIGUSR1 it writes
its notes since the last signal to FILE, as one JSON object: the longest turns, in seconds of the loop's processor time
and of the clock. A shared machine stretches the latter.
"""

from __future__ import annotations

import asyncio
import heapq
import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

from plr.controlplane.__main__ import main as controlplane_main

KEPT = 20
NOTED_FROM_S = 0.002
"""Shortest turn noted: shorter ones are of no interest, and naming them would cost more than they take."""
CLOCK_READ_S = 0.0005
"""How much longer than it is a turn may seem: by the turns before it since the processor's clock was read."""


class Turns:
    """The longest turns since they were last written."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._worst: list[tuple[float, float, str]] = []

    def note(self, cpu_s: float, wall_s: float, handle: Any) -> None:
        """Note the end of a turn."""
        item = (cpu_s, wall_s, describe(handle))
        if len(self._worst) < KEPT:
            heapq.heappush(self._worst, item)
        else:
            heapq.heappushpop(self._worst, item)

    def write(self) -> None:
        """Write them to the file, whole or not at all, and start over."""
        worst, self._worst = sorted(self._worst, reverse=True), []
        found = {
            "cpu_s": max((cpu for cpu, _, _ in worst), default=0.0),
            "wall_s": max((wall for _, wall, _ in worst), default=0.0),
            "turns": worst,
        }
        partial = self._file.with_suffix(".part")
        partial.write_text(json.dumps(found))
        os.replace(partial, self._file)


def describe(handle: Any) -> str:
    """Return the name of what a turn ran, for a task that of its coroutine."""
    callback = handle._callback
    owner = getattr(callback, "__self__", None)
    if isinstance(owner, asyncio.Task):
        return getattr(owner.get_coro(), "__qualname__", repr(owner))
    return getattr(callback, "__qualname__", repr(callback))


def watch(turns: Turns) -> None:
    """Measure every turn of this process's event loops from now on."""
    run = asyncio.events.Handle._run  # there is no public hook
    clock, processor = time.perf_counter, time.thread_time
    looked, spent = clock(), processor()
    """When the processor's clock was last read. It takes six times as long as the other, so not each turn reads it."""

    def timed(handle: Any) -> None:
        nonlocal looked, spent
        began = clock()
        if began - looked >= CLOCK_READ_S:
            looked, spent = began, processor()
        run(handle)
        wall_s = clock() - began
        if wall_s >= NOTED_FROM_S:
            turns.note(processor() - spent, wall_s, handle)

    setattr(asyncio.events.Handle, "_run", timed)  # noqa: B010 - mypy forbids to replace a method


def main() -> int:
    """Run the command line."""
    turns = Turns(Path(sys.argv[1]))
    watch(turns)
    signal.signal(signal.SIGUSR1, lambda *_: turns.write())
    return controlplane_main(sys.argv[2:])


if __name__ == "__main__":
    sys.exit(main())
