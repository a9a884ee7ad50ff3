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

    def wait(self, timeout_s: float) -> str | None:
        """Wait until it is set, `timeout_s` at most; returns the first reason, or None. For one thread, until set."""
        try:
            return self._reasons.get(timeout=timeout_s)
        except queue.Empty:
            return None
