"""Holds the request to stop that the main thread waits for: after a signal, or when a thread died."""

from __future__ import annotations

import queue


class StopRequest:
    """A request to stop, set from any thread or a signal handler, with a reason in words.

    This is no `threading.Event`, as its lock is not reentrant. A handler that sets one while the main thread is just
    about to wait for it, or while a second signal interrupts the handler of the first, would deadlock with itself.
    """

    def __init__(self) -> None:
        self._reasons: queue.SimpleQueue[str] = queue.SimpleQueue()  # put is reentrant, by its documentation

    def set(self, reason: str) -> None:
        """Ask to stop; takes no lock that the caller could hold."""
        self._reasons.put(reason)

    def wait(self, timeout_s: float) -> str | None:
        """Wait at most `timeout_s` until it is set; return the first reason, or None. For one thread, until set."""
        try:
            return self._reasons.get(timeout=timeout_s)
        except queue.Empty:
            return None
