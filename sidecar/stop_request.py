"""What the main thread waits for: a signal, or a thread that died."""

from __future__ import annotations

import queue


class StopRequest:
    """Set once, from any thread and from a signal handler, with a word on why.

    Not a `threading.Event`: its lock is not reentrant. A handler that sets one while the main thread is just about to
    wait for it, or while a second signal interrupts the handler of the first, waits for itself for good.
    """

    def __init__(self) -> None:
        self._reasons: queue.SimpleQueue[str] = queue.SimpleQueue()  # put is reentrant, by its documentation

    def set(self, reason: str) -> None:
        """Ask to stop; takes no lock that the caller could hold."""
        self._reasons.put(reason)

    def wait(self) -> str:
        """Wait until it is set; returns the first reason. For one thread, once."""
        return self._reasons.get()
