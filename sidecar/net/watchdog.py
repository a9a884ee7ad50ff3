"""Notices interface threads that hang in their driver.

A hung thread cannot say that its paths are down: its link does not run. So the thread that waits for the engine's
timers looks, and the engine treats the interface as gone until its thread is back.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Collection

    from plr.sidecar.net.interface_thread import InterfaceThread

HUNG_AFTER_S = 0.25
"""Duration of a turn that counts as hung: a turn takes some milliseconds, and a path is doubted after 60 ms of silence
at the earliest."""
LOOK_EVERY_S = 0.1


class ThreadChanges(NamedTuple):
    """Threads that hung or came back since the last look."""

    hung: list[InterfaceThread]
    back: list[InterfaceThread]


class Watchdog:
    """Remembers the hung threads. Used under the data plane's lock."""

    def __init__(self, now: float) -> None:
        self._hung: set[InterfaceThread] = set()
        self._looked_at = now

    def hangs(self, thread: InterfaceThread) -> bool:
        """Return whether it hung at the last look."""
        return thread in self._hung

    def look(self, threads: Collection[InterfaceThread], now: float) -> ThreadChanges | None:
        """Look at these threads, which are all there are; return what changed, if anything did."""
        slept, self._looked_at = now - self._looked_at, now
        if slept > HUNG_AFTER_S:
            return None  # this thread did not run either: the machine stalled, not a driver
        before = self._hung
        # On a busy machine a thread may not run for as long; that is not the driver's fault, and ends by itself.
        self._hung = {
            thread
            for thread in threads
            if thread.in_turn_for(now) > HUNG_AFTER_S and (thread in before or thread.is_in_a_call())
        }
        changes = ThreadChanges(
            [thread for thread in threads if thread in self._hung and thread not in before],
            [thread for thread in threads if thread in before and thread not in self._hung],
        )
        return changes if changes.hung or changes.back else None
